"""Takes into the site what stands beside docs/, and turns links out of docs/ into links within the site."""

import json
import pathlib
import posixpath
import re

from mkdocs.structure.files import File

ROOT = pathlib.Path(__file__).parents[1]
PAGES = {"benchmarks/RESULTS.md": "results.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
INSTEAD = {"README.md": "index.md", "benchmarks": "results.md", "notebooks": "notebooks.md"}
AS_THEY_ARE = ("notebooks/*.ipynb", "benchmarks/*.py", "LICENSE")


def on_files(files, config):
    """Add the pages and files of `PAGES` and `AS_THEY_ARE`."""
    for source, uri in PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / source).read_text("utf-8")))
    for pattern in AS_THEY_ARE:
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Relink the page, and list the notebooks where it asks for them."""
    uri = page.file.src_uri
    source = next((path for path, name in PAGES.items() if name == uri), f"docs/{uri}")
    if uri == "notebooks.md":
        markdown += "\n\n" + "\n".join(_notebooks())
    return _outside_code(markdown, lambda text: _relink(text, source, uri))


def _outside_code(markdown, change):
    """Apply `change` to what is not a fenced block."""
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else change(part) for part in parts)


def _relink(text, source, uri):
    def target(match):
        link, anchor = match.group(1), match.group(2) or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
        inside = PAGES.get(path) or INSTEAD.get(path) or path.removeprefix("docs/")
        return f"]({posixpath.relpath(inside, posixpath.dirname(uri) or '.')}{anchor})"

    return re.sub(r"\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)", target, text)


def _notebooks():
    """One line a notebook, by number: its title, linked, and what it begins with."""
    paths = (ROOT / "notebooks").glob("*.ipynb")
    for path in sorted(paths, key=lambda path: (int(re.match(r"\d*", path.name).group() or 0), path.name)):
        cells = json.loads(path.read_text("utf-8"))["cells"]
        text = next("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        title, *rest = text.strip().split("\n\n")
        first = re.split(r"(?<=[.:]) ", " ".join(rest[0].split()))[0].rstrip(":") if rest else ""
        yield f"- [{title.lstrip('# ')}](../notebooks/{path.name}): {first}"
