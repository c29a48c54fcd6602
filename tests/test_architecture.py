"""The layers point one way: who may import whom, proved from the imports of every module."""

import ast
from pathlib import Path

import pytest

import cosim

ROOT = Path(cosim.__file__).parent
BASE = {"errors", "arrays", "units", "version"}
ALLOWED = {
    "errors": set(),
    "arrays": set(),
    "units": set(),
    "version": set(),
    "native": BASE,
    "theory": BASE | {"native"},
    "core": BASE | {"native"},
    "blocks": BASE | {"native", "theory", "core"},
    "fmi": BASE | {"native", "core"},
    "log": BASE | {"core"},
    "testing": BASE | {"core"},
    "scenario": BASE | {"native", "theory", "core", "blocks", "fmi", "log"},
    "report": BASE | {"theory", "core", "fmi", "log", "scenario"},
    "cli": {"errors", "scenario", "log", "report", "fmi"},
    "__main__": {"cli"},
    "__init__": {"scenario", "log", "fmi", "report", "version"},
}
OUTSIDE = {
    "fmpy": {"fmi"},
    "mcap": {"log"},
    "google": {"log"},
    "zstandard": {"log"},
    "lz4": {"log"},
    "pydantic": {"scenario"},
    "matplotlib": {"report"},
    "typer": {"cli", "report"},
    "rich": {"cli", "report"},
}
MODULES = sorted(ROOT.rglob("*.py"))


def part(path: Path) -> str:
    """Name the layer of a module: its folder, or its own name at the top."""
    inside = path.relative_to(ROOT)
    return inside.parts[0] if len(inside.parts) > 1 else inside.stem


def imports(path: Path) -> set[str]:
    """Give every module that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            assert node.module is not None
            found |= {
                f"{node.module}.{alias.name}" if node.module == "cosim" else node.module
                for alias in node.names
            }
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_lower_layers_never_import_upper_ones(path):
    """Every import inside the package goes to the same layer or to an allowed lower one."""
    layer = part(path)
    for module in imports(path):
        parts = module.split(".")
        if parts[0] == "cosim" and len(parts) > 1:
            assert parts[1] == layer or parts[1] in ALLOWED[layer], (
                f"{path}: {layer} imports {module}"
            )


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_outside_libraries_have_one_home(path):
    """fmpy is imported in fmi only, mcap in log only, and so on."""
    for module in imports(path):
        homes = OUTSIDE.get(module.split(".")[0])
        assert homes is None or part(path) in homes, (
            f"{path} imports {module}, which belongs to {homes}"
        )


def test_theory_and_core_do_not_know_each_other():
    """Who wants the estimator imports theory, who wants a master imports core."""
    assert "core" not in ALLOWED["theory"]
    assert "theory" not in ALLOWED["core"]


def test_the_master_is_the_smallest_file_of_the_core():
    """The kernel stays small: no module of the core with code of its own is shorter."""
    lengths = {
        path.name: sum(1 for line in path.read_text().splitlines() if line.strip())
        for path in (ROOT / "core").glob("*.py")
    }
    del lengths["__init__.py"]
    assert min(lengths, key=lambda name: lengths[name]) == "master.py"


def test_the_top_level_holds_what_it_should():
    """pyproject.toml, cosim, fmus, tests, logs, README.md and dot-files."""
    top = ROOT.parent
    found = {
        entry.name
        for entry in top.iterdir()
        if not entry.name.startswith(".") and entry.name not in ("build", "dist")
    }
    assert found == {"pyproject.toml", "cosim", "fmus", "tests", "logs", "README.md"}


def test_every_folder_of_the_package_has_tests():
    """The tests mirror the package."""
    folders = {
        path.name for path in ROOT.iterdir() if path.is_dir() and (path / "__init__.py").exists()
    }
    assert folders <= {path.name for path in (ROOT.parent / "tests").iterdir()}
