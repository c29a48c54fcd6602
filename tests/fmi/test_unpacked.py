"""FMUs that are opened again and again in one process are unpacked once, and loaded once."""

import pickle
import shutil
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from cosim.errors import FmuError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read
from cosim.fmi.unpacked import UnpackedFmus
from tests.fmi.small import able, compiled


@pytest.fixture(scope="module")
def counting(tmp_path_factory):
    """Return a binary whose y has how many instances of it there were before."""
    return compiled(tmp_path_factory.mktemp("counting"), "COUNTS")


def mapped():
    """Return the binaries of FMUs that are in memory."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("the system does not list what is in memory")
    lines = maps.read_text().splitlines()
    return {line.split()[5] for line in lines if "cosim.fmu-" in line}


@contextmanager
def opened(path, fmus, **start):
    with load(path, FmuOptions(start=start), unpacked=fmus) as fmu:
        yield fmu


def first_y(path, fmus, **start):
    """Return y of a new instance when it is initialized."""
    with opened(path, fmus, **start) as fmu:
        outputs = fmu.component.interface.output_columns()
        y = fmu.component.initialize(0.0, np.zeros(1))
        return float(y[outputs["y"]][0])


def test_an_fmu_is_unpacked_and_loaded_once(counting, tmp_path, temporary):
    """The instances are counted in its binary, which stays in memory until all is closed."""
    path = able(counting, tmp_path / "x.fmu", A=-1.0, C=0.0)
    before = mapped()
    with closing(UnpackedFmus()) as fmus:
        assert [first_y(path, fmus) for _ in range(3)] == [0.0, 1.0, 2.0]
        assert len(list(temporary.iterdir())) == 1
        assert len(mapped() - before) == 1
    assert list(temporary.iterdir()) == []
    assert mapped() <= before


def test_every_opening_has_an_instance_of_its_own(counting, tmp_path):
    """Start values are those of the one opening."""
    path = able(counting, tmp_path / "x.fmu", A=-1.0)
    with closing(UnpackedFmus()) as fmus:
        assert first_y(path, fmus, x=2.0, C=1.0) == 2.0
        assert first_y(path, fmus) == 0.0 + 1.0
        with opened(path, fmus) as one, opened(path, fmus, x=3.0) as other:
            assert one.component is not other.component


def test_a_binary_for_one_instance_is_loaded_for_each(counting, tmp_path, temporary):
    """What it knows of the one before is gone with it; those at one time have copies of it."""
    path = able(counting, tmp_path / "x.fmu", "once", A=-1.0, C=0.0)
    with closing(UnpackedFmus()) as fmus:
        assert [first_y(path, fmus) for _ in range(3)] == [0.0, 0.0, 0.0]
        with opened(path, fmus):
            assert first_y(path, fmus) == 0.0
            with opened(path, fmus):
                assert first_y(path, fmus) == 0.0
                assert len(list(temporary.iterdir())) == 2
        assert first_y(path, fmus) == 0.0
        assert len(list(temporary.iterdir())) == 1


def test_files_of_equal_content_are_one_fmu_by_two_names(counting, tmp_path, temporary):
    """The metadata name the file that was opened."""
    path = able(counting, tmp_path / "x.fmu", A=-1.0)
    copy = tmp_path / "copy.fmu"
    shutil.copy(path, copy)
    with closing(UnpackedFmus()) as fmus:
        with opened(path, fmus) as one:
            assert one.metadata["path"] == str(path)
        with opened(copy, fmus) as other:
            assert other.metadata["path"] == str(copy)
        assert one.metadata["sha256"] == other.metadata["sha256"]
        assert len(list(temporary.iterdir())) == 1


def test_a_file_that_was_changed_is_another_fmu(counting, tmp_path):
    """It is known by its content."""
    path = able(counting, tmp_path / "x.fmu", A=-1.0)
    with closing(UnpackedFmus()) as fmus:
        with opened(path, fmus) as one:
            assert one.description["x"].start == (0.0,)
        path.unlink()
        able(counting, path, A=-1.0, x=7.0)
        with opened(path, fmus) as other:
            assert other.description["x"].start == (7.0,)


def test_of_many_fmus_the_oldest_are_removed_but_never_an_open_one(counting, tmp_path, temporary):
    """Those that stay are loaded still; one that was removed is unpacked again."""
    before = mapped()
    paths = [able(counting, tmp_path / f"{n}.fmu", A=-1.0, C=0.0, x=float(n)) for n in range(6)]
    with closing(UnpackedFmus(most=2)) as fmus, opened(paths[0], fmus) as held:
        for path in paths[1:]:
            assert first_y(path, fmus) == 0.0
            assert first_y(path, fmus) == 1.0
            assert len(list(temporary.iterdir())) <= 4  # two, the one that came, the open one
            assert len(mapped() - before) <= 4
        assert held.component.initialize(0.0, np.zeros(1)).size
        assert first_y(paths[0], fmus) == 1.0  # still the binary with the open instance
        assert first_y(paths[4], fmus) == 2.0
        assert first_y(paths[1], fmus) == 0.0  # another binary: its count begins anew
    assert list(temporary.iterdir()) == []
    assert mapped() <= before


def test_unpacked_fmus_have_a_bounded_size(counting, tmp_path, temporary):
    """The bytes of the files: here no FMU may stay while it is not open."""
    paths = [able(counting, tmp_path / f"{n}.fmu", A=-1.0, C=0.0, x=float(n)) for n in range(3)]
    with closing(UnpackedFmus(most_bytes=1)) as fmus:
        for path in paths:
            first_y(path, fmus)
            assert len(list(temporary.iterdir())) == 1


def test_a_refused_archive_leaves_no_folder(tmp_path, temporary):
    """As where it is opened alone."""
    (tmp_path / "x.fmu").write_bytes(b"no zip")
    with closing(UnpackedFmus()) as fmus:
        with pytest.raises(FmuError, match="is no zip archive"):
            load(tmp_path / "x.fmu", unpacked=fmus)
        with pytest.raises(FmuError, match="there is no such file"):
            load(tmp_path / "y.fmu", unpacked=fmus)
        assert list(temporary.iterdir()) == []


def test_a_description_goes_to_another_process_without_addresses(counting, tmp_path):
    """Its references were asked for here, and stand elsewhere in memory there."""
    description = read(able(counting, tmp_path / "x.fmu", A=-1.0)).description
    own = description.references("output")
    assert description.references("output") is own
    other = pickle.loads(pickle.dumps(description)).references("output")
    assert other.ungrouped.references.tolist() == own.ungrouped.references.tolist()
    assert other.ungrouped.address == other.ungrouped.references.ctypes.data
