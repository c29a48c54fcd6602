"""What takes the place of the example's plant."""

import pytest

import cosim
from cosim.scenario.exporting import export_component
from tests.scenario.swapping.renamed import packed, renamed


@pytest.fixture(scope="package")
def folder(tmp_path_factory):
    """Write the plant as it is, with other names, with a vector of outputs, and as a log."""
    folder = tmp_path_factory.mktemp("plants")
    export_component("academic", "plant", folder / "plant.fmu")
    export_component("academic", "plant", folder / "plant3.fmu", fmi="3")
    renamed(folder / "other.fmu")
    packed(folder / "packed.fmu")
    cosim.run("academic", set={"scenario.stop": 0.1}, out=folder / "log.mcap")
    return folder
