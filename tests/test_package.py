"""The package as a whole: what importing it does, and where its heavy dependencies may stand."""

import ast
import importlib.metadata
import pathlib
import subprocess
import sys

import pytest

import vojax
from vojax._jax_version import check_jaxlib_version

PACKAGE = pathlib.Path(vojax.__file__).parent

# The one folder (or module) that may import each of these; None: no part of the package may.
HOME = {
    "cv2": "features",
    "jaxopt": "robust",
    "matplotlib": "viz",
    "optimistix": "ba",
    "rich": "cli",
    "tyro": "cli",
    "evo": None,
    "jaxlie": None,
    "poselib": None,
}


def imported_modules(source: str) -> set[str]:
    """Names of the top-level packages that `source` imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def misplaced(relative_path: pathlib.PurePath, source: str) -> list[str]:
    """Imports of `source` that belong in another folder than that of `relative_path`."""
    return sorted(
        f"{relative_path}: {name} belongs in {HOME[name] or 'tests and benchmarks only'}"
        for name in imported_modules(source) & HOME.keys()
        if relative_path.parts[0] != HOME[name]
    )


def test_heavy_imports_stand_in_their_one_home():
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 10
    assert [line for path in files for line in misplaced(path.relative_to(PACKAGE), path.read_text("utf-8"))] == []


def test_a_misplaced_import_is_found():
    assert misplaced(pathlib.PurePath("ba/_solve.py"), "import optimistix as optx\nfrom optimistix import root\n") == []
    assert len(misplaced(pathlib.PurePath("robust/_engine.py"), "def f():\n    from optimistix import root\n")) == 1
    assert len(misplaced(pathlib.PurePath("lie/_so3.py"), "import cv2.aruco, jaxlie.utils\n")) == 2


@pytest.mark.parametrize("version", ["0.10.2", "0.10.2+cuda12", "0.10.2.dev20260101", "0.10.2rc1"])
def test_the_miscompiling_jaxlib_is_refused_in_one_sentence(version):
    with pytest.raises(ImportError, match=r"wrong results.*pip install") as caught:
        check_jaxlib_version(version)
    message = str(caught.value)
    assert version in message
    assert "\n" not in message


@pytest.mark.parametrize("version", ["0.10.1", "0.10.3", "0.10.20", "0.11.0", "0.12.0.1", "1.0.10.2"])
def test_other_jaxlibs_are_accepted(version):
    check_jaxlib_version(version)


def run_fresh(code: str) -> subprocess.CompletedProcess:
    """Run `code` in a new interpreter that finds this copy of the package."""
    preamble = f"import sys; sys.path.insert(0, {str(PACKAGE.parent)!r})\n"
    return subprocess.run([sys.executable, "-c", preamble + code], capture_output=True, text=True, timeout=120)


def test_importing_vojax_refuses_the_miscompiling_jaxlib():
    result = run_fresh("import jaxlib; jaxlib.__version__ = '0.10.2'; import vojax")
    assert result.returncode != 0
    assert "ImportError: jaxlib 0.10.2" in result.stderr.splitlines()[-1]


def test_importing_vojax_is_light_quiet_and_leaves_jax_alone():
    heavy = ["cv2", "jaxopt", "matplotlib", "rich", "tyro"]
    result = run_fresh(
        "import jax\n"
        "before = dict(jax.config.values)\n"
        "import vojax\n"
        "changed = [name for name, value in jax.config.values.items() if before.get(name, value) != value]\n"
        f"print(changed, [name for name in {heavy} if name in sys.modules], jax.config.jax_enable_x64)\n"
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[] [] False"
    assert result.stderr == ""


def test_no_module_computes_when_it_is_imported():
    # A JAX that has computed takes no more settings: no platform, no number of devices.
    result = run_fresh(
        "import importlib, pkgutil, jax, vojax\n"
        "names = [m.name for m in pkgutil.walk_packages(vojax.__path__, 'vojax.') if not m.name.endswith('__main__')]\n"
        "for name in names: importlib.import_module(name)\n"
        "jax.config.update('jax_num_cpu_devices', 3)\n"
        "print(len(names) > 200, len(jax.devices('cpu')))\n"
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "True 3"


def test_version_is_that_of_the_installed_package():
    try:
        installed = importlib.metadata.version("vojax")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("vojax runs from the source tree and is not installed")
    assert vojax.__version__ == installed


def public_map() -> dict[str, object]:
    return {name: getattr(vojax, name) for name in dir(vojax) if not name.startswith("_")}


def test_every_public_name_is_there_and_no_other():
    assert {"SE3", "estimate_absolute_pose", "solvers"} <= public_map().keys()
    # What type checkers read and what is loaded on first use are two lists of the same names.
    (block,) = [
        node for node in ast.parse(pathlib.Path(vojax.__file__).read_text("utf-8")).body if isinstance(node, ast.If)
    ]
    declared = {alias.asname for node in block.body for alias in node.names}
    assert declared == public_map().keys()
    with pytest.raises(AttributeError, match="no_such_name"):
        vojax.no_such_name  # noqa: B018


def test_the_command_line_explains_itself_without_jax():
    result = run_fresh("import vojax.cli; vojax.cli.main(['--help']); print('jax' in sys.modules)")
    assert "Visual odometry" in result.stdout
    assert result.stdout.splitlines()[-1] == "False"


def test_public_map_lets_no_dependency_through():
    def origin(value) -> str:
        return getattr(value, "__module__", None) or getattr(value, "__name__", "vojax")

    foreign = {name: origin(value) for name, value in public_map().items() if not origin(value).startswith("vojax")}
    assert foreign == {}


def test_public_names_are_documented():
    assert [name for name, value in public_map().items() if callable(value) and not (value.__doc__ or "").strip()] == []
