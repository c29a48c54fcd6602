"""The layers point one way: who may import whom, proved from the imports of every module."""

import ast
from collections.abc import Collection, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import cosim

ROOT = Path(cosim.__file__).parent
BASE = {
    "errors",
    "arguments",
    "arrays",
    "digests",
    "files",
    "documents",
    "filters",
    "instants",
    "interrupts",
    "processes",
    "temporary",
    "units",
    "version",
    "lazy",
    "options",
}
ALLOWED = {
    "errors": set(),
    "arguments": {"errors", "files"},
    "arrays": set(),
    "digests": {"files"},
    "documents": {"errors"},
    "files": set(),
    "filters": set(),
    "instants": set(),
    "interrupts": set(),
    "processes": {"errors", "temporary"},
    "temporary": set(),
    "units": set(),
    "version": set(),
    "lazy": set(),
    "options": {"errors"},
    "native": BASE,
    "theory": BASE | {"native"},
    "core": BASE | {"native"},
    "blocks": BASE | {"native", "theory", "core"},
    "fmi": BASE | {"native", "core"},
    "log": BASE | {"core"},
    "testing": BASE | {"native", "theory", "core", "blocks"},
    "scenario": BASE | {"native", "theory", "core", "blocks", "fmi", "log"},
    "live": BASE | {"core", "log", "scenario"},
    "gym": BASE | {"core", "scenario"},
    "report": BASE | {"theory", "core", "fmi", "log", "scenario"},
    "studies": BASE | {"native", "core", "fmi", "log", "scenario", "report"},
    "completion": {"errors", "files", "scenario"},
    "terminal": {"interrupts", "scenario"},
    "unanswered": {"interrupts"},
    "cli": {
        "arguments",
        "errors",
        "files",
        "lazy",
        "options",
        "processes",
        "version",
        "scenario",
        "studies",
        "log",
        "report",
        "live",
        "fmi",
        "completion",
        "terminal",
        "unanswered",
    },
    "__main__": {"cli"},
    "__init__": {"errors", "scenario", "studies", "log", "fmi", "report", "version", "lazy"},
}
OUTSIDE = {
    "fmpy": {"fmi"},
    "mcap": {"log"},
    "google": {"log"},
    "isal": {"log"},
    "zstandard": {"log"},
    "lz4": {"log"},
    "gymnasium": {"gym"},
    "foxglove": {"live"},
    "pandas": {"core", "studies"},
    "polars": {"core", "studies"},
    "xarray": {"core"},
    "dask": {"studies"},
    "distributed": {"studies"},
    "optuna": {"studies"},
    "pydantic": {"documents", "scenario", "studies"},
    "matplotlib": {"report", "studies"},
    "typer": {"cli", "completion", "report"},
    "rich": {"report", "studies", "terminal"},
}
ROOMS = {
    "native": [
        "build",
        "library",
        "memory",
        "step",
        "numerics",
        "blocks",
        "estimation",
        "fmi",
        "stages",
    ],
    "fmi": [
        "variable",
        "references",
        "description",
        "platforms",
        "bundled",
        "describing",
        "instance",
        "generated",
        "reading",
        "cache",
        "trial_cache",
        "compiling",
        "child_process",
        "binary",
        "driving",
        "options",
        "unpacked",
        "component",
        "exporting",
        "building",
        "linearizing",
        "checking",
    ],
    "log": [
        "metadata",
        "mcap_records",
        "chunks",
        "live_file",
        "files",
        "places",
        "layout",
        "messages",
        "viewer_layout",
        "preamble",
        "container",
        "rows",
        "foreign",
        "reader",
        "text",
        "conversion",
        "following",
        "difference",
        "between",
        "pairs",
        "diff",
        "background",
        "store",
        "pieces",
        "spans",
        "recovering",
        "recorder",
    ],
    "studies": [
        "contracts",
        "variations",
        "study_file",
        "cases",
        "metrics",
        "measuring",
        "members",
        "worker",
        "workers",
        "identity",
        "storage",
        "dataset",
        "study",
        "layout",
        "design",
        "sweeping",
        "statistics",
        "sensitivity",
        "checking",
        "search",
        "plan",
        "kept_logs",
        "cluster",
        "studying",
        "residual",
        "standard_errors",
        "tuning_result",
        "tuning",
        "verifying",
        "show",
        "panels",
        "plots",
    ],
    "scenario": [
        "document",
        "data_files",
        "record",
        "session",
        "kinds",
        "building",
        "recordings",
        "running",
        "exporting",
        "assumptions",
        "experiment_design",
    ],
}
MODULES = sorted(ROOT.rglob("*.py"))


def part(path: Path) -> str:
    """Name the layer of a module: its folder, or its own name at the top."""
    inside = path.relative_to(ROOT)
    return inside.parts[0] if len(inside.parts) > 1 else inside.stem


@cache
def parsed(path: Path) -> tuple[list[ast.Import | ast.ImportFrom], set[str]]:
    """Return the imports of a file, anywhere in it, and the names of the types it defines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = [node for node in statements(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    return imported, type_names(tree)


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements below a node: what takes long to walk are expressions."""
    for name in ("body", "orelse", "handlers", "finalbody", "cases"):
        for child in getattr(node, name, []):
            yield child
            yield from statements(child)


@cache
def imports(path: Path) -> set[str]:
    """Return every module that a file imports, anywhere in it."""
    found = set()
    for node in parsed(path)[0]:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}: imports are absolute"
            assert node.module is not None
            found |= {
                f"{node.module}.{alias.name}" if node.module == "cosim" else node.module
                for alias in node.names
            }
    return found


def test_lower_layers_never_import_upper_ones():
    """Every import inside the package goes to the same layer or to an allowed lower one."""
    violations = []
    for path in MODULES:
        layer = part(path)
        allowed = ALLOWED[layer] | {layer}
        for module in imports(path):
            parts = module.split(".")
            if parts[0] == "cosim" and len(parts) > 1 and parts[1] not in allowed:
                violations.append(f"{path.relative_to(ROOT)} imports {module}")
    assert violations == []


def test_outside_libraries_have_one_home():
    """fmpy is imported in fmi only, mcap in log only, and so on."""
    violations = []
    for path in MODULES:
        for module in imports(path):
            homes = OUTSIDE.get(module.split(".")[0])
            if homes is not None and part(path) not in homes:
                violations.append(f"{path.relative_to(ROOT)} imports {module} of {homes}")
    assert violations == []


def modules() -> dict[str, Path]:
    """Return every module of the package by its name."""
    found = {}
    for path in MODULES:
        parts = ("cosim", *path.relative_to(ROOT).with_suffix("").parts)
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


def imported_modules(path: Path, known: Collection[str]) -> set[str]:
    """Return the modules of the package that a file imports, anywhere in it, for types too."""
    found = set()
    for node in parsed(path)[0]:
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("cosim"):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name if name in known else str(node.module) for name in names}
    return found


def test_no_import_runs_upwards_between_files():
    """The files have an order in which every import, lazy or for types only, goes down.

    The public names of a package stand in its ``__init__``, above everything in it: nothing in the
    package may import them, but the command line, which nothing else imports.
    """
    known = modules()
    imports_of = {name: imported_modules(path, known) - {name} for name, path in known.items()}
    try:
        TopologicalSorter(imports_of).prepare()
    except CycleError as error:
        pytest.fail(f"a cycle of imports: {' <- '.join(error.args[1])}")


def test_the_rooms_of_a_layer_stand_in_one_order():
    """A folder or file of a layer in ROOMS imports only those that stand before it."""
    known = modules()
    violations = []
    for path in MODULES:
        layer, *inside = path.relative_to(ROOT).parts
        if layer not in ROOMS or inside == ["__init__.py"]:
            continue
        rooms = ROOMS[layer]
        number = rooms.index(inside[0].removesuffix(".py"))
        for module in imported_modules(path, known):
            parts = module.split(".")
            if parts[:2] == ["cosim", layer] and rooms.index(parts[2]) > number:
                violations.append(f"{path.relative_to(ROOT)} imports {module}")
    assert violations == []


def type_names(tree: ast.Module) -> set[str]:
    """Return the classes and type aliases that a module defines."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.AnnAssign) and "TypeAlias" in ast.dump(node.annotation):
            found.add(ast.unparse(node.target))
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name[0].isupper() and not name.isupper():
                found.add(name)
    return found


def test_a_type_name_has_one_meaning():
    """No class or type alias is defined twice in the package."""
    homes: dict[str, list[str]] = {}
    for name, path in modules().items():
        for type_name in parsed(path)[1]:
            homes.setdefault(type_name, []).append(name)
    assert {name: places for name, places in homes.items() if len(places) > 1} == {}


def test_theory_and_core_do_not_know_each_other():
    """Who wants the estimator imports theory, who wants a master imports core."""
    assert "core" not in ALLOWED["theory"]
    assert "theory" not in ALLOWED["core"]


def code_length(path: Path) -> int:
    """Return the number of lines of a file without docstrings, comments and blank lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        documented = ast.Module | ast.ClassDef | ast.FunctionDef
        if isinstance(node, documented) and ast.get_docstring(node) is not None:
            del node.body[0]
    return len(ast.unparse(tree).splitlines())


def test_the_master_is_the_smallest_file_of_the_core():
    """The kernel stays small: no module of the core with code of its own has fewer lines of code.

    Docstrings and comments do not count, so that nobody saves on them.
    """
    paths = [path for path in (ROOT / "core").rglob("*.py") if path.name != "__init__.py"]
    lengths = {path.name: code_length(path) for path in paths}
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
