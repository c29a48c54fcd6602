"""Models from elsewhere: a MAT-file, a StateSpace of another package."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io
import scipy.signal
import scipy.sparse

import cosim
from cosim.errors import AssumptionError, ScenarioError, UsageError
from cosim.scenario.data_files.mat_file import OtherVariable, read_variables
from cosim.theory import descriptor_system, reduce
from tests.scenario.general_plant import GENERAL, X0, A, B, C, E, write
from tests.scenario.refusals import check_refused

FROM_FILE = 'file = "plant.mat"\ndisturbances = [0]\n'
INITIAL = f"x0 = {X0.tolist()}"
MATRICES = {"E": E, "A": A, "B": B, "C": C}


def saved(folder, **matrices):
    """Write a scenario, and the matrices of its model to a file beside it."""
    scipy.io.savemat(folder / "plant.mat", {**MATRICES, **matrices})
    return write(folder / "file.toml", FROM_FILE, INITIAL)


def test_a_model_in_a_file_is_that_of_its_matrices(tmp_path):
    """The same bits as the table with the same numbers; sparse ones, and D, among them."""
    table = cosim.run(write(tmp_path / "table.toml", GENERAL, INITIAL))
    log = cosim.run(
        saved(tmp_path, E=scipy.sparse.csc_array(E), D=np.zeros((1, 2)), Bu=[], other="text")
    )
    np.testing.assert_array_equal(log["plant.x"], table["plant.x"])


def test_a_replay_needs_no_file(tmp_path):
    """The log has the matrices and the file's hash; another file is opened where it is named."""
    observer = (
        '"observer.u" = "u.y"\n"observer.y" = "plant.y"\n[components.observer]\n'
        'kind = "unknown-input-observer"\nmodel = "m"\npoles = [-4.0]\nfilter_rate = 1e3\n'
    )
    path = saved(tmp_path)
    path.write_text(path.read_text() + observer)
    log = cosim.run(path, out=tmp_path / "run.mcap")
    (tmp_path / "plant.mat").unlink()
    again = cosim.replay(log, out=tmp_path / "again.mcap")
    assert cosim.diff(log, again).equal
    assert cosim.diff(again, cosim.replay(again)).equal
    (record,) = json.loads(log.metadata["cosim.run"]["models"]).values()
    assert record["file"] == "plant.mat"
    assert len(record["sha256"]) == 64
    faster = cosim.replay(log, set={"observer.poles": [-8.0]})
    assert not np.array_equal(faster["observer.x"], log["observer.x"])
    with pytest.raises(ScenarioError, match=r"models\.m: file .*plant\.mat' cannot be read"):
        cosim.run(path)


def test_a_file_without_a_model_is_refused(tmp_path):
    """The variable is named, with what is expected."""
    cases = [
        ({"A": np.eye(3) * 1j}, r"plant\.mat: A: expected .*real numbers, got .*complex"),
        ({"A": "text"}, r"plant\.mat: A: expected .*real numbers, got text"),
        ({"C": np.array([[1.0, np.nan, 0.0]])}, r"models\.m: C\[0, 1\].*nan"),
        ({"D": np.zeros((2, 2))}, r"models\.m: D: expected shape \(1, 2\), .*\(2, 2\)"),
        ({"Bu": np.eye(3)}, r"models\.m: Bu: not allowed with B"),
        ({"B": np.zeros((3, 0))}, r"models\.m: disturbances: .*got 0"),
    ]
    check_refused(cases, lambda matrices: cosim.run(saved(tmp_path, **matrices)), ScenarioError)


def test_an_unreadable_file_is_refused_with_the_cure(tmp_path):
    """HDF5, Octave's text, nothing at all."""
    path = saved(tmp_path)
    hdf5 = b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n"

    def run(content):
        (tmp_path / "plant.mat").write_bytes(content)
        cosim.run(path)

    cases = [
        (hdf5, r"7\.3 \(HDF5\); .*save -v7$"),
        (b"# Created by Octave\n# name: A\n# type: matrix\n", r"plant\.mat: .*save -v7"),
        (b"", r"plant\.mat: not a valid MAT-file"),
    ]
    check_refused(cases, run, ScenarioError)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_is_read_as_scipy_reads_it(tmp_path, compressed):
    """Every type of numbers, sparse and empty matrices; other variables are known by name."""
    rng = np.random.default_rng(0)
    variables = {f"A{kind}": rng.integers(0, 100, (3, 2)).astype(kind) for kind in "bBhHiIlLfd?"}
    sparse = scipy.sparse.random_array((4, 5), density=0.3, rng=rng, format="csc")
    variables |= {"S": sparse, "Z": np.zeros((2, 0)), "one": 3.5, "L": [[1.0, 2.0]]}
    others = {
        "s": {"a": 1},
        "c": np.array([[1], ["x"]], object),
        "t": "x",
        "N": np.zeros((2, 2, 2)),
    }
    path = tmp_path / "all.mat"
    scipy.io.savemat(path, variables | others, do_compression=compressed)
    found = read_variables("", path.read_bytes())
    expected = scipy.io.loadmat(path)
    for name in variables:
        value = expected[name]
        dense = value.toarray() if scipy.sparse.issparse(value) else value
        np.testing.assert_array_equal(found[name], dense.astype(np.float64))
    for name in others:
        assert isinstance(found[name], OtherVariable), name


@pytest.mark.slow
@pytest.mark.parametrize("compressed", [False, True])
def test_a_damaged_file_is_refused_or_read(tmp_path, compressed):
    """Whatever a byte becomes: no other error, no crash."""
    path = tmp_path / "good.mat"
    scipy.io.savemat(path, {"A": A, "S": scipy.sparse.csc_array(E)}, do_compression=compressed)
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(150):
        damaged = bytearray(path.read_bytes())
        for _ in range(3):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        end = rng.integers(len(damaged)) if trial % 5 == 0 else len(damaged)
        try:
            read_variables("", bytes(damaged[:end]))
        except UsageError:
            refused += 1
    assert refused > 20


def test_what_a_file_lacks_or_repeats_is_refused(tmp_path):
    """A file with other names; matrices beside a file."""
    path = saved(tmp_path)
    scipy.io.savemat(tmp_path / "plant.mat", {"Ap": A, "B": B})
    with pytest.raises(ScenarioError, match=r"plant\.mat: .*no A and C; available: Ap, B"):
        cosim.run(path)
    path = write(tmp_path / "both.toml", 'file = "plant.mat"\nn_a = 1\nA = [[1]]', INITIAL)
    with pytest.raises(ScenarioError, match=r"models\.m\.A: not allowed with file"):
        cosim.run(path)


def control_system(**changes):
    """Return what a StateSpace of python-control has."""
    values = {
        "A": np.array([[-1.0, 1.0], [-1.0, -2.0]]),
        "B": np.array([[-1.0, 1.0], [1.0, 0.0]]),
        "C": np.array([[1.0, 0.0]]),
        "D": np.array([[-1.0, 0.0]]),
        "dt": 0,
        "input_labels": ["u", "delta"],
    }
    return SimpleNamespace(**(values | changes))


def test_a_state_space_is_a_table_and_a_descriptor_system(tmp_path):
    """Inputs by name or by column; the same numbers either way."""
    table = cosim.model_table(control_system(), disturbances=["delta"])
    assert table["disturbances"] == [1]
    path = write(tmp_path / "control.toml", GENERAL, "x0 = [1.0, -1.0]")
    log = cosim.run(path, set={"models.m": table})
    system = descriptor_system(control_system(), [1])
    np.testing.assert_array_equal(reduce(system).C4, [[-1.0]])
    np.testing.assert_array_equal(system.Bd, [[1.0], [0.0]])
    y = log["plant.x"][:, 0] - log["u.y"]
    np.testing.assert_allclose(log["plant.y"], y, rtol=0, atol=1e-15)
    of_scipy = scipy.signal.StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    assert cosim.model_table(of_scipy) == {"A": [[-1]], "B": [[1]], "C": [[1]], "D": [[0]]}


def test_another_model_than_one_in_continuous_time_is_refused():
    """Discrete time, transfer functions, unknown inputs."""
    cases = [
        ((control_system(dt=0.1), []), r"dt = 0\.1"),
        ((control_system(dt=True), []), r"dt = True"),
        ((control_system(D=None), []), r"SimpleNamespace.* D\b"),
        ((scipy.signal.TransferFunction([1], [1, 1]), []), r" A\b.*transfer function"),
        ((control_system(A=np.eye(2) * 1j), []), r"\.A: .*complex128.*\(2, 2\)"),
        ((control_system(), ["wind"]), r"disturbance.*'wind'.*u, delta"),
        ((control_system(), [2]), r"disturbance.* 2\b.*0 to 1|disturbance.*0 to 1.* 2\b"),
        ((control_system(), "delta"), r"disturbances: .*'delta'"),
        ((control_system(), [1, "delta"]), r"disturbances: 'delta' is given twice"),
    ]

    def table(case):
        system, disturbances = case
        cosim.model_table(system, disturbances=disturbances)

    check_refused(cases, table, AssumptionError)
