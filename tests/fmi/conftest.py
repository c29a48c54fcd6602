"""The FMU that these tests use, built once, and edited copies of it."""

import tempfile
import zipfile
from pathlib import Path

import pytest

from cosim.fmi.exporting.export import export
from tests.fmi.compiled import compile_fmu, write_archive
from tests.fmi.plant import model
from tests.fmi.probes import xml1, xml2, xml3


@pytest.fixture(scope="session")
def exported(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("export") / "academic.fmu"
    return export(model(), path, name="academic").path


@pytest.fixture
def edited(exported, tmp_path):
    """Write a copy of the exported FMU with its modelDescription.xml or its members changed."""

    def edit(
        *replacements: tuple[str, str],
        without: str = "no such member",
        extra: dict[str, bytes] | None = None,
    ) -> Path:
        members: dict[str, bytes] = {}
        with zipfile.ZipFile(exported) as source:
            for name in source.namelist():
                content = source.read(name)
                if name == "modelDescription.xml":
                    for before, after in replacements:
                        assert before.encode() in content
                        content = content.replace(before.encode(), after.encode())
                if not name.startswith(without):
                    members[name] = content
        return write_archive(tmp_path / "edited.fmu", {**members, **(extra or {})})

    return edit


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    """Return the folder where temporary folders are made; it must be empty again at the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture(scope="session")
def probe2(tmp_path_factory) -> Path:
    return compile_fmu(
        tmp_path_factory.mktemp("probe") / "probe2.fmu", xml2(indicators=1), "probe2.c"
    )


@pytest.fixture(scope="session")
def probe3(tmp_path_factory) -> Path:
    return compile_fmu(tmp_path_factory.mktemp("probe") / "probe3.fmu", xml3(), "probe3.c")


@pytest.fixture(scope="session", params=["me", "cs"])
def probe1(request, tmp_path_factory) -> Path:
    return compile_fmu(
        tmp_path_factory.mktemp("probe") / "probe1.fmu",
        xml1(interface_type=request.param),
        "probe1.c",
    )


@pytest.fixture(scope="session")
def slave1(tmp_path_factory) -> Path:
    return compile_fmu(tmp_path_factory.mktemp("probe") / "slave1.fmu", xml1(), "probe1.c")


@pytest.fixture(scope="session")
def model1(tmp_path_factory) -> Path:
    return compile_fmu(
        tmp_path_factory.mktemp("probe") / "model1.fmu", xml1(interface_type="me"), "probe1.c"
    )
