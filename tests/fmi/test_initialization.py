"""Start values of every type reach the FMU, and what is none is refused, all of it at once."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, FmuError
from cosim.fmi.component import load
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import StartValues, check_start, resized
from cosim.fmi.options import FmuOptions
from cosim.fmi.variable import Variable
from cosim.report.tables.console import print_shown
from cosim.report.tables.preparation import show_dry_run
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.recordings.swap_comparison import compare_swaps
from cosim.scenario.running.execution import load as load_scenario
from tests.fmi import small
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import got, xml3
from tests.fmi.rogues import STATELESS, compile_rogue

PARAMETER = {"causality": "parameter", "variability": "fixed", "initial": "exact"}
VARIABLES = (
    Variable("gain", 0, minimum=0.0, maximum=10.0, **PARAMETER),
    Variable("amplification", 0, alias_of="gain", **PARAMETER),
    Variable("count", 1, type="UInt8", **PARAMETER),
    Variable("far", 2, type="Int64", **PARAMETER),
    Variable("on", 3, type="Boolean", **PARAMETER),
    Variable("mode", 4, type="Int32", items={"idle": 1, "running": 3}, **PARAMETER),
    Variable("large", 12, type="Int64", items={"odd": 2**53 + 1, "low": -(2**63)}, **PARAMETER),
    Variable("file", 5, type="String", **PARAMETER),
    Variable("key", 6, type="Binary", **PARAMETER),
    Variable("tick", 7, type="Clock", causality="input", variability="discrete"),
    Variable("table", 8, size=6, dimensions=(2, "n"), **PARAMETER),
    Variable(
        "n", 9, type="UInt64", start=(3.0,), **(PARAMETER | {"causality": "structuralParameter"})
    ),
    Variable("y", 10, causality="output", initial="calculated"),
    Variable("g", 11, causality="local", variability="constant", initial="exact"),
)
MODEL = Description("model", "", "3.0", VARIABLES)


def test_values_of_every_type():
    values = {
        "gain": 2,
        "count": 255.0,
        "far": -(2**63),
        "large": "low",
        "on": True,
        "mode": "running",
        "file": "a b",
        "key": "00fF",
        "table": [[1, 2, 3], [4, 5, 6]],
        "n": 3,
    }
    numbers = {
        "gain": (2.0,),
        "count": (255.0,),
        "far": (-(2.0**63),),
        "large": (-(2.0**63),),
        "on": (1.0,),
        "mode": (3.0,),
    }
    table = {"table": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)}
    texts = {"file": ("a b",), "key": ("00fF",)}
    assert check_start(MODEL, values) == StartValues({"n": (3.0,)}, numbers | table, texts)


def test_numbers_stand_for_booleans_and_items(subtests):
    for name, value, number in [
        ("mode", 3, 3.0),
        ("on", 1.0, 1.0),
        ("on", 0, 0.0),
        ("on", False, 0.0),
    ]:
        with subtests.test(name=name, value=value):
            assert check_start(MODEL, {name: value}).numbers == {name: (number,)}


def test_arrays_may_be_flat():
    assert check_start(MODEL, {"table": range(6)}).numbers == {
        "table": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    }


def test_wrong_start_values_are_refused(subtests):
    for name, value, message in [
        ("gian", 1.0, r"model: no variable 'gian'; did you mean 'gain'"),
        ("gain", float("nan"), r"start value of 'gain': expected a finite number, got nan"),
        ("gain", float("-inf"), "expected a finite number, got -inf"),
        ("gain", 10.5, r"expected 0.0 to 10.0, got 10.5"),
        ("gain", True, "expected a number, got true"),
        ("gain", "2", "expected a number, got '2'"),
        ("gain", [1.0], "expected one value of type Float64, got a list"),
        ("count", 1.5, r"expected an integer, got 1.5"),
        ("count", 256, r"expected 0 to 255 \(UInt8\), got 256"),
        (
            "far",
            2**53 + 1,
            r"float64 represents exactly, got 9007199254740993; nearest: 9007199254740992",
        ),
        ("on", 2, "expected true or false, got 2"),
        ("on", "yes", "expected true or false, got 'yes'"),
        ("mode", "runing", "no item 'runing'; did you mean 'running'"),
        ("large", "odd", "item 'odd' is 9007199254740993, which no float64 represents exactly"),
        ("mode", 2, r"expected one of: 1 \(idle\), 3 \(running\); got 2"),
        ("file", 1.0, r"expected a string, got 1.0"),
        ("file", "a\0b", "expected a string without the character 0"),
        ("key", 12, "expected a string of hexadecimal digits, got 12"),
        ("key", "123", "expected hexadecimal digits, two for each byte, got '123'"),
        ("tick", True, r"'tick' has no start value that can be set \(causality input"),
        (
            "y",
            1.0,
            r"'y' has no start value that can be set \(causality output, "
            r"variability continuous, initial calculated\)",
        ),
        (
            "g",
            1.0,
            r"'g' has no start value that can be set \(causality local, variability constant",
        ),
        ("table", 1.0, "expected a list of 6 values, got one value"),
        ("table", [1.0] * 5, "expected a list of 6 values, got 5 values"),
        (
            "table",
            [[1.0, 2.0], [3.0, 4.0]],
            "expected a list of 6 values, got lists of shape 2 x 2",
        ),
        ("table", [[[1.0] * 6]], "expected a list of 6 values, got lists of shape 1 x 1 x 6"),
        ("table", [[1.0] * 3, [2.0] * 2], "expected lists of equal lengths"),
        ("table", [1.0, float("nan"), 1.0, 1.0, 1.0, 1.0], "expected a finite number, got nan"),
    ]:
        with subtests.test(name=name, value=value), pytest.raises(FmuError, match=message):
            check_start(MODEL, {name: value})


def test_two_names_of_one_variable():
    with pytest.raises(
        FmuError, match="'amplification': it is another name of 'gain', which is given too"
    ):
        check_start(MODEL, {"gain": 1.0, "amplification": 1.0})


def test_all_problems_are_one_error():
    with pytest.raises(FmuError) as error:
        check_start(MODEL, {"gian": 1.0, "y": 1.0, "on": 2, "gain": 1.0})
    assert len(str(error.value).splitlines()) == 3


def test_structural_parameters_resize_what_depends_on_them():
    larger = resized(MODEL, {"n": 4, "gain": 1.0, "nothing": 2})
    assert (larger["table"].size, larger["n"].start) == (8, (4.0,))
    assert resized(MODEL, {"gain": 1.0}) is MODEL
    with pytest.raises(FmuError, match=r"'n': expected an integer, got 2.5"):
        resized(MODEL, {"n": 2.5})


def test_start_values_reach_the_fmu(tmp_path):
    """Of every type, before the initialization; the structural parameter in configuration mode."""
    n = (
        '<UInt64 name="n" valueReference="540" causality="structuralParameter" '
        'variability="fixed" start="2"/>'
    )
    xml = xml3().replace("<ModelVariables>", f"<ModelVariables>{n}")
    xml = xml.replace(
        'start="0 0 0"><Dimension start="3"/></Float64>',
        'start="0"><Dimension valueReference="540"/></Float64>',
    )
    path = compile_fmu(tmp_path / "x.fmu", xml, "probe3.c")
    start = {
        "n": 3,
        "Float64s": [1.5, 2.5, 3.5],
        "UInt8": 200,
        "Booleans": [True, False, True],
        "Int64s": [-1, 0, 2**53],
        "texts": ["a", "b"],
        "binaries": ["", "ff00"],
        "x": 0.5,
    }
    with load(path, FmuOptions(interface_type="cs", start=start)) as fmu:
        assert fmu.description["Float64s"].size == 3
        assert fmu.component.initialize(0.0, np.zeros(1)).tolist() == [0.5]
        instance = fmu._instance
        assert got(instance, "n", "configured", "Float64s") == [3.0, 2.0, 1.5, 2.5, 3.5]
        assert got(instance, "UInt8") == [200.0]
        assert got(instance, "Booleans") == [1.0, 0.0, 1.0]
        assert got(instance, "Int64s") == [-1.0, 0.0, 2.0**53]
        assert instance.get_text(fmu.description["texts"]) == ("a", "b")
        assert instance.get_text(fmu.description["binaries"]) == ("", "ff00")


def test_values_of_a_scenario(tmp_path, probe3):
    """TOML's numbers, Booleans, strings and arrays."""
    scenario = tmp_path / "one.toml"
    scenario.write_text(f"""
[scenario]
name = "one"
stop = 0.1
step = 0.1
[components.plant]
kind = "fmu"
path = "{probe3}"
interface_type = "cs"
[components.plant.start]
x = 2
Boolean = true
texts = ["a", "b"]
Int8s = [1, 2, 3]
[components.u]
kind = "constant"
value = 3.0
[connections]
"plant.u" = "u.y"
""")
    log = cosim.run(scenario, out=tmp_path / "one.mcap")
    np.testing.assert_allclose(log["plant.x"], [2.0, 2.3], rtol=1e-15)
    broken = tmp_path / "broken.toml"
    broken.write_text(
        scenario.read_text().replace("x = 2", "x = [2]").replace("Boolean = true", "Boolean = 2")
    )
    with pytest.raises(
        CosimError, match=r"(?s)'x': expected one value.*'Boolean': expected true or false, got 2"
    ):
        cosim.run(broken, out=tmp_path / "broken.mcap")


@pytest.fixture(scope="module")
def forgetful(tmp_path_factory):
    """y = 3 x + u from x = 2, of an FMU that forgets in SetupExperiment what was set before."""
    folder = tmp_path_factory.mktemp("forgetful")
    path = small.compiled(folder, "FORGETS")
    return small.able(path, folder / "able.fmu", "state", "steps", A=-1.0, x=2.0)


def test_start_values_are_set_when_the_experiment_is_set_up(forgetful):
    """FMI 2.0.4 section 4.2.4 allows both orders; FMUs of 20-sim keep values in this one only."""
    start = {"A": -1.0, "B": 1.0, "C": 3.0, "D": 1.0, "x": 2.0}
    with load(forgetful, FmuOptions(start=start)) as fmu:
        for t in (0.0, 5.0):  # the second one after a reset
            assert fmu.component.initialize(t, np.array([1.0])).tolist() == [2.0, 7.0]
        fmu.component.prepare(0.1, np.zeros(1, np.bool_), {})
        linearized = fmu.component.linearized(5.0, np.array([1.0]))
        assert linearized.C[1] == pytest.approx(3.0 * linearized.C[0])
        assert fmu.drain() == []


@pytest.mark.slow
def test_trials_set_start_values_in_the_same_order(forgetful):
    """x starts at the declared 2, which the FMU itself forgot."""
    start = {"A": -1.0, "B": 1.0, "C": 3.0, "D": 1.0, "x": 2.0}
    assert [f for f in cosim.fmi.check(forgetful, start=start) if "trial" in f.where] == []


def test_values_that_are_not_kept_are_named_once(tmp_path):
    """The FMU has x = 1 for whatever is no input, also for the parameter k, and keeps no string."""
    text = '<ScalarVariable name="file" valueReference="5" causality="parameter"'
    text += ' variability="fixed"><String start=""/></ScalarVariable></ModelVariables>'
    xml = STATELESS.replace("</ModelVariables>", text)
    path = compile_rogue(tmp_path / "good.fmu", "GOOD", xml)
    with load(path, FmuOptions(start={"k": 3.0, "file": "a.csv"})) as fmu:
        for _ in range(2):
            fmu.component.initialize(0.0, np.array([0.5]))
            fmu.component.outputs(0.0, np.array([0.5]))
        (message,) = fmu.drain()
        assert message.level == "warning"
        assert "k is 1.0, was set to 3.0" in message.text
        assert "file is ('',), was set to ('a.csv',)" in message.text
        assert "u is" not in message.text
        fmu.discard()  # after trials the run says it again
        fmu.component.initialize(0.0, np.array([0.5]))
        fmu.component.outputs(0.0, np.array([0.5]))
        assert fmu.drain() == [message]


def test_values_that_are_not_kept_are_named_before_the_run(tmp_path, capsys):
    """By the check of a scenario, and by its dry run, which do what a run begins with."""
    path = compile_rogue(tmp_path / "good.fmu", "GOOD", STATELESS)
    scenario = tmp_path / "one.toml"
    scenario.write_text(f"""
scenario = {{ name = "one", stop = 0.2, step = 0.1 }}
[components]
plant = {{ kind = "fmu", path = "{path}", start = {{ k = 3.0, u = 1.0 }} }}
""")
    text = "k is 1.0, was set to 3.0"
    (warning,) = check_assumptions(scenario).warnings
    assert warning[0] == "plant"
    assert text in warning[1]
    reports = compare_swaps(load_scenario(scenario))
    assert reports.of_run == (warning,)
    print_shown(show_dry_run(reports), as_json=False)
    out, err = capsys.readouterr()
    assert (out, err) == (
        "dry run: the scenario can run; warnings: 1\n",
        f"warning: plant: {warning[1]}\n",
    )


def test_values_in_single_precision_are_kept(tmp_path):
    """0.1 reads back as 0.10000000149, of a variable that is declared as double precision."""
    path = small.compiled(tmp_path, "NUMBER=float")
    start = {"A": -0.1, "B": 1e-3, "C": 1.0 / 3.0, "x": 0.7}
    with load(path, FmuOptions(start=start)) as fmu:
        assert fmu.component.initialize(0.0, np.array([0.1]))[0] == float(np.float32(0.7)) != 0.7
        fmu.component.outputs(0.0, np.array([0.1]))
        assert fmu.drain() == []


def test_an_input_that_cannot_be_read_is_no_fault(tmp_path):
    """It is asked for, no more: nothing is said, and the end of the run is as ever."""
    path = compile_rogue(tmp_path / "hides.fmu", "HIDES", STATELESS)
    with load(path) as fmu:
        y = fmu.component.initialize(0.0, np.array([3.0]))
        rows = fmu.component.advance(np.array([0.0, 0.5]), 0.5, np.full((2, 1), 3.0))
        assert (y.tolist(), rows.tolist()) == ([1.0, 1.0], [[2.0, 2.0]])
        assert fmu.drain() == []
        assert not fmu._instance._library.failed
