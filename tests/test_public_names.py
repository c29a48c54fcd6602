"""The public names of the packages: what they export, and that README and docstrings keep to it."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import get_origin

import pytest

import cosim

ROOT = Path(cosim.__file__).parent
PACKAGES = [
    "cosim",
    "cosim.core",
    "cosim.blocks",
    "cosim.theory",
    "cosim.fmi",
    "cosim.log",
    "cosim.live",
]
TESTING = {
    "cosim.testing": ["check_component", "check_estimator", "check_rollback"],
    "cosim.gym": ["Env"],
}  # modules of their own
SHOWN = r" *from (cosim[\w.]*) import ([\w, ]+)"


def imported_names(package):
    """Return the names that a package imports for type checkers."""
    path = Path(import_module(package).__file__)
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.startswith(f"{package}."):
            names |= {alias.asname or alias.name for alias in node.names}
    return names - {"__version__", "lazy_names"}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_and_says_what_it_is(package):
    """``__all__`` is what type checkers see, every name loads, and has a docstring."""
    module = import_module(package)
    names = [name for name in module.__all__ if name != "__version__"]
    assert set(names) == imported_names(package)
    assert set(dir(module)) >= set(names)
    for name in names:
        found = getattr(module, name)
        is_alias = get_origin(found) is not None
        assert found.__doc__ or is_alias, f"{package}.{name}"
        assert not isinstance(found, type(cosim)), f"{package}.{name} is a module"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_name_that_is_not_there_is_an_error(package):
    """As of any other module."""
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        getattr(import_module(package), "nothing")  # noqa: B009


@pytest.mark.slow
def test_importing_the_packages_loads_no_library():
    """Names load what they need when they are first used."""
    heavy = "numpy scipy mcap pydantic fmpy rich typer matplotlib"
    code = f"import sys, {', '.join(PACKAGES)}; print(*set(sys.modules) & set('{heavy}'.split()))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == ""


def test_shown_imports_are_public():
    """README, pages and docstrings import public names from their packages only."""
    shown = []
    for path in [ROOT.parent / "README.md", *ROOT.parent.glob(".readme/*.md")]:
        shown += re.findall(f"(?m)^{SHOWN}", path.read_text(encoding="utf-8"))
    for path in ROOT.rglob("*.py"):
        shown += re.findall(f">>>{SHOWN}", path.read_text(encoding="utf-8"))
    assert len(shown) > 5
    for module, names in shown:
        assert module in {*PACKAGES, *TESTING}, f"from {module} import {names}"
        expected = TESTING.get(module) or import_module(module).__all__
        assert {name.strip() for name in names.split(",")} <= set(expected), module
