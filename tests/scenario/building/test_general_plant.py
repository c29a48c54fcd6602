"""Models in the general form: E, A, B, C, D as MATLAB's dss has them."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, ScenarioError
from cosim.scenario.exporting import export_component
from tests.scenario.general_plant import GENERAL, MIXING_Q, PARTITIONED, X0, write
from tests.scenario.refusals import check_refused

GENERAL_X0 = f"x0 = {X0.tolist()}"


@pytest.fixture
def general(tmp_path):
    """Return the path of a scenario with a plant in the general form."""
    return write(tmp_path / "general.toml", GENERAL, GENERAL_X0)


def test_a_plant_in_other_coordinates_is_the_same_plant(general, tmp_path):
    """Its y is that of the paper's form, and its x are the user's: Q x = (x_a, x_b)."""
    paper = cosim.run(write(tmp_path / "paper.toml", PARTITIONED, "x_a0 = [1.0, -1.0]"))
    log = cosim.run(general)
    # 400 steps of a matrix exponential, each of a few roundings of numbers up to 3
    np.testing.assert_allclose(log["plant.y"], paper["plant.y"], rtol=0, atol=1e-12)
    x = np.column_stack([paper["plant.x_a"], paper["plant.x_b"]])
    np.testing.assert_allclose(log["plant.x"] @ MIXING_Q.T, x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(log["plant.x"][0], X0, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_general_plant_replays_and_is_its_fmu(general, tmp_path):
    """The log alone replays it; exported and swapped in, it runs alike."""
    log = cosim.run(general, out=tmp_path / "general.mcap")
    assert cosim.diff(log, cosim.replay(log, out=tmp_path / "again.mcap")).equal
    export_component(str(general), "plant", tmp_path / "plant.fmu")
    fmu = cosim.run(general, swap={"plant": f"{tmp_path / 'plant.fmu'}#me"})
    assert fmu["plant.x"].shape == log["plant.x"].shape
    # the solver of model exchange has the tolerance 1e-9
    np.testing.assert_allclose(fmu["plant.x"], log["plant.x"], rtol=0, atol=1e-6)
    with pytest.raises(CosimError, match=r"residual form .*n_a"):
        export_component(str(general), "plant", tmp_path / "dae.fmu", dae=True)


FEEDTHROUGH = """\
A = [[-1.0]]
B = [[1.0, 0.0]]
C = [[1.0]]
D = [[0.5, 2.0]]
disturbances = [1]
"""


def test_a_direct_path_is_in_y(tmp_path):
    """D's columns are those of B: y = x + 0.5 u + 2 delta at every row."""
    log = cosim.run(write(tmp_path / "direct.toml", FEEDTHROUGH, "x0 = [0.0]"))
    expected = log["plant.x"] + 0.5 * log["u.y"] + 2.0 * log["delta.y"]
    np.testing.assert_allclose(log["plant.y"], expected, rtol=0, atol=1e-15)
    step = cosim.load(tmp_path / "direct.toml")
    split = {"Bu": [[1.0]], "Bd": [[0.0]], "Du": [[0.5]], "Dd": [[2.0]]}
    table = {"A": [[-1.0]], "C": [[1.0]], **split}
    again = cosim.run(step, set={"models.m": table})
    np.testing.assert_array_equal(again["plant.y"], log["plant.y"])


def test_a_plant_without_disturbance_has_no_such_port(tmp_path):
    """Nothing is left open, and what is connected to it is refused by name."""
    model = "A = [[-1.0, 0.0], [1.0, -2.0]]\nB = [[1.0], [0.0]]\nC = [[0.0, 1.0]]"
    path = write(tmp_path / "calm.toml", model, "x0 = [1.0, 0.0]")
    with pytest.raises(ScenarioError, match=r"'plant' has no input 'delta'"):
        cosim.run(path)
    text = path.read_text().replace('"plant.delta" = "delta.y"\n', "")
    path.write_text(text)
    log = cosim.run(path)
    assert [signal.name for signal in log.channels["plant"].interface.inputs] == ["u"]
    autonomous = text.replace("B = [[1.0], [0.0]]\n", "").replace('"plant.u" = "u.y"\n', "")
    path.write_text(autonomous)
    free = cosim.run(path)
    t = free.time("plant.x")
    np.testing.assert_allclose(free["plant.x"][:, 0], np.exp(-t), rtol=0, atol=1e-13)


NO_FORMS = [
    ("C = [[1]]", r"models\.m: 'A' is missing"),
    ("n_a = 1\nA = [[1]]\nC = [[1]]\nBu = [[1]]", r"models\.m: 'Bd' is missing"),
    (PARTITIONED + "D = [[0, 0]]", r"models\.m\.D: not allowed with n_a"),
    (PARTITIONED + "E = [[1]]", r"models\.m\.E: not allowed with n_a"),
    (GENERAL + "Bu = [[1]]", r"models\.m\.Bu: not allowed with B; .*remove Bu"),
    ("A = [[1]]\nC = [[1]]\nD = [[1]]", r"models\.m\.D: not allowed without B"),
    ("A = [[1]]\nC = [[1]]\ndisturbances = [0]", r"disturbances: not allowed without B"),
    ("A = [[1]]\nC = [[1]]\nDu = [[1]]", r"models\.m\.Du: not allowed without Bu"),
    (FEEDTHROUGH.replace("[1]\n", "[2]\n"), r"models\.m\.disturbances: .* 0 to 1, got 2"),
    (FEEDTHROUGH.replace("[1]\n", "[1, 1]\n"), r"models\.m\.disturbances: .*\[1, 1\]"),
    (
        FEEDTHROUGH.replace("D = [[0.5, 2.0]]", "D = [[0.5]]"),
        r"models\.m: D: expected shape \(1, 2\), .*got \(1, 1\)",
    ),
    ("A = [[1]]\nC = [[1]]\nB = [[1], [1]]", r"models\.m: B: expected 1 rows"),
    ("A = [[1, 2]]\nC = [[1]]", r"models\.m: A.*\(1, 2\)"),
    (
        "E = [[0, 1], [0, 0]]\nA = [[1, 0], [0, 1]]\nC = [[1, 0]]",
        r"components\.plant: .*Assumption 2\); INDEX_2: .*no dynamics at all",
    ),
    (
        "E = [[0, 0], [0, 0]]\nA = [[1, 0], [0, 1]]\nC = [[1, 0]]",
        r"components\.plant: E = 0 \(2 x 2\): .*Assumption 1",
    ),
]


def test_a_model_of_no_form_is_refused_at_its_key(tmp_path):
    """Mixed forms, missing matrices, wrong shapes, no dynamics: before any run."""

    def run(model):
        cosim.run(write(tmp_path / "wrong.toml", model, "x0 = [0.0, 0.0]"))

    check_refused(NO_FORMS, run, ScenarioError)


def test_initial_states_are_those_of_the_form(tmp_path):
    """x_a0 with n_a, x0 without; neither is guessed."""
    cases = [
        ((GENERAL, ""), r"components\.plant: x0 is missing.*3 numbers.*'m'"),
        ((GENERAL, "x_a0 = [1, 2]"), r"x_a0: the model 'm' .*x0$"),
        ((GENERAL, "x0 = [1, 2]"), r"x0.*\(3,\)"),
        ((PARTITIONED, ""), r"x_a0 is missing.*2 numbers.*'m'"),
        ((PARTITIONED, "x0 = [1, 2, 3]"), r"x0: the model 'm' .*x_a0$"),
    ]
    check_refused(cases, lambda case: cosim.run(write(tmp_path / "wrong.toml", *case)))


RIGID = """
scenario = { name = "rigid", stop = 2.0, step = 0.01 }
connections."plant.u" = "u.y"

[models.masses]  # positions, velocities, and the force that keeps the positions equal
E = [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 2, 0, 0], [0, 0, 0, 3, 0], [0, 0, 0, 0, 0]]
A = [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-10, 0, 0, 0, 1], [0, 0, 0, 0, -1], [1, -1, 0, 0, 0]]
B = [[0], [0], [1], [0], [0]]
C = [[0, 0, 0, 0, 1]]

[components]
u = { kind = "step", time = 0.0, before = 0.0, after = 1.0 }
plant = { kind = "descriptor", model = "masses", x0 = [0.3, 0.3, 0.0, 0.0, 0.0] }
"""


def test_a_rigid_constraint_of_index_3_runs(tmp_path):
    """Two masses are one of 5 kg on the spring of 10 N/m: x is 0.1 + 0.2 cos(sqrt(2) t).

    The force accelerates the second mass; its initial value follows from the input at the start.
    """
    (tmp_path / "rigid.toml").write_text(RIGID)
    with pytest.warns(cosim.CosimWarning, match=r"E x0 is kept, and x\[4\] = 0 is 1\.2$"):
        run = cosim.run(tmp_path / "rigid.toml")
    t = run.time("plant.x")
    cosine, sine = np.cos(np.sqrt(2.0) * t), np.sin(np.sqrt(2.0) * t)
    position = 0.1 + 0.2 * cosine
    velocity = -0.2 * np.sqrt(2.0) * sine
    force = 3.0 * 0.4 * cosine
    expected = np.column_stack([position, position, velocity, velocity, force])
    np.testing.assert_allclose(run["plant.x"], expected, rtol=0.0, atol=1e-13)
