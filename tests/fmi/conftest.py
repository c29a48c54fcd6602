"""FMUs that the tests use, built once: our export, and the same plant written by pythonfmu and pythonfmu3."""

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

from cosim.fmi.export import export
from tests.fmi.plant import model

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def exported(tmp_path_factory) -> Path:
    return export(model(), tmp_path_factory.mktemp("export") / "academic.fmu", name="academic").path


def _build(tool: str, script: str, folder: Path) -> Path:
    subprocess.run(
        [sys.executable, "-m", tool, "build", "-f", str(HERE / script), "-d", str(folder)], check=True, capture_output=True
    )
    return next(folder.glob("*.fmu"))


@pytest.fixture(scope="session")
def foreign2(tmp_path_factory) -> Path:
    """FMI 2, co-simulation, by pythonfmu."""
    return _build("pythonfmu", "foreign2.py", tmp_path_factory.mktemp("foreign2"))


@pytest.fixture(scope="session")
def foreign3(tmp_path_factory) -> Path:
    """FMI 3, model exchange and co-simulation, by pythonfmu3."""
    return _build("pythonfmu3", "foreign3.py", tmp_path_factory.mktemp("foreign3"))


@pytest.fixture
def edited(exported, tmp_path):
    """Write a copy of the exported FMU with its modelDescription.xml or its members changed."""

    def edit(*replacements: tuple[str, str], without: str = "no such member", extra: dict[str, bytes] | None = None) -> Path:
        path = tmp_path / "edited.fmu"
        with zipfile.ZipFile(exported) as source, zipfile.ZipFile(path, "w") as target:
            for name in source.namelist():
                content = source.read(name)
                if name == "modelDescription.xml":
                    for before, after in replacements:
                        assert before.encode() in content
                        content = content.replace(before.encode(), after.encode())
                if not name.startswith(without):
                    target.writestr(name, content)
            for name, content in (extra or {}).items():
                target.writestr(name, content)
        return path

    return edit


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    """Give the folder where temporary folders are made; it must be empty again at the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder
