"""The documentation: every public name has its place, and what the pages show as Python runs."""

import ast
import pathlib
import re

import jax
import pytest

import vojax

ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "vojax"
NAMESPACES = sorted(path.parent.name for path in PACKAGE.glob("[a-z]*/__init__.py"))
BLOCK = re.compile(r"(?P<reason><!-- not run: [^>]+ -->\n)?^```python\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
# Seconds of compilation each.
SLOW = {"bundle_adjustment.md", "calibration.md", "choosing.md", "migration.md", "model_selection.md"}
PAGES = [
    path
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if BLOCK.search(path.read_text("utf-8"))
]


def public_names(namespace: str) -> set[str]:
    """What the folder's `__init__.py` re-exports."""
    tree = ast.parse((PACKAGE / namespace / "__init__.py").read_text("utf-8"))
    names = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    return {name for name in names if name and not name.startswith("_")}


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_is_on_its_page_once(namespace):
    text = (ROOT / "docs" / "api" / f"{namespace}.md").read_text("utf-8")
    generated = re.findall(rf"^::: vojax\.{namespace}\.(\w+)$", text, re.MULTILINE)
    # Constants have no docstring; they stand in headings.
    written = [name for line in re.findall("^### (`.*)$", text, re.MULTILINE) for name in re.findall(r"`(\w+)`", line)]
    assert sorted(generated + written) == sorted(public_names(namespace))


def test_every_namespace_and_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2].partition("\nvalidation:")[0]
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if f" {page}\n" not in navigation] == []


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] if path.name in SLOW else []) for path in PAGES],
    ids=lambda path: path.stem,
)
def test_python_on_the_page_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    text, namespace = path.read_text("utf-8"), {}
    for block in BLOCK.finditer(text):
        if not block["reason"]:
            line = text.count("\n", 0, block.start("code"))
            # Empty lines in front, so that a traceback has the page's line numbers.
            with jax.numpy_rank_promotion("allow"):  # as users have it
                exec(compile("\n" * line + block["code"], str(path), "exec"), namespace)


def test_the_citation_names_the_version():
    assert f"\nversion: {vojax.__version__}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


@pytest.mark.parametrize("page", ["claims", "errata"])
def test_what_is_named_as_evidence_exists(page):
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    for file, name in re.findall(r"`(tests/\S+\.py)::(\w+)`", text):
        assert f"def {name}(" in (ROOT / file).read_text("utf-8"), name
    for files, part in re.findall(r"`pytest (?:-m slow )?(tests/[^`]+?)(?: -k (\w+))?`", text):
        for file in files.split():
            names = " ".join(re.findall(r"def (test_\w+)", (ROOT / file).read_text("utf-8")))
            assert part in names, f"{file}: no test has {part!r} in its name"
    for script in re.findall(r"`((?:study|bench)_\w+\.py)", text):
        assert (ROOT / "benchmarks" / script).is_file(), script
