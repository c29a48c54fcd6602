"""Local variables and parameters become outputs where the user asks for them."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, FmuError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read
from tests.fmi.archives import write
from tests.fmi.compiled import compile_fmu
from tests.fmi.descriptions import FMI2, FMI3

SCENARIO = """
[scenario]
name = "locals"
stop = 0.2
step = 0.01
[components]
u = {{ kind = "sine", amplitude = 1.0, rate = 3.0 }}
gain = {{ kind = "gain", K = 2.0 }}
[components.plant]
kind = "fmu"
path = "{path}"
interface_type = "{interface_type}"
outputs = ["der(x_a[0])"]
[connections]
"plant.u" = "u.y"
"plant.delta" = "u.y"
"gain.u" = "plant.der(x_a[0])"
"""


@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_a_local_variable_is_recorded_and_connected(exported, tmp_path, interface_type):
    """The derivative of the first state is -x1 + x2 - u + delta; it drives a gain."""
    scenario = tmp_path / "locals.toml"
    scenario.write_text(SCENARIO.format(path=exported, interface_type=interface_type))
    log = cosim.run(scenario)
    x = log["plant.x_a"]
    slope = -x[:, 0] + x[:, 1]  # u and delta are the same
    # Three roundings of numbers of size 1.
    assert abs(log["plant.der(x_a[0])"] - slope).max() < 4 * 2.0**-53
    assert log["gain.y"].tobytes() == (2.0 * log["plant.der(x_a[0])"]).tobytes()


def test_outputs_of_a_description(tmp_path):
    """A vector is asked for by its name; outputs that are outputs anyway change nothing."""
    description = read(write(tmp_path / "x.fmu", [], xml=FMI2.encode())).description
    more = description.recording(["late", "hidden", "der(x)", "mode"]).interface
    assert [signal.name for signal in more.outputs] == [
        "rise",
        "x",
        "late",
        "hidden",
        "der(x)",
        "mode",
    ]
    # What it depends on is declared for a derivative, nothing for a parameter.
    assert more.feedthrough["der(x)"] == ("u",)
    assert more.feedthrough["mode"] == ()
    h = '<ScalarVariable name="v[{}]" valueReference="{}"><Real unit="kN"/></ScalarVariable>'
    rows = "".join(h.format(i, 90 + i) for i in (1, 2, 3))
    xml = FMI2.replace("</ModelVariables>", f"{rows}</ModelVariables>").encode()
    vector = read(write(tmp_path / "x.fmu", [], xml=xml)).description.recording(["v"]).interface
    (v,) = [signal for signal in vector.outputs if signal.name == "v"]
    assert (v.size, v.unit) == (3, "kN")
    assert vector.feedthrough["v"] is None  # not declared of a local variable


def test_arrays_of_fmi_3_as_outputs(tmp_path):
    """An alias too, and the independent variable."""
    description = read(write(tmp_path / "x.fmu", [], xml=FMI3.encode())).description
    interface = description.recording(["dx", "time"]).interface
    sizes = {signal.name: signal.size for signal in interface.outputs}
    assert sizes["dx"] == 3
    assert sizes["time"] == 1


def test_patterns_stand_for_what_can_be_recorded(tmp_path, subtests):
    """As in other places; inputs and strings, which cannot, are passed over, names kept once."""
    description = read(write(tmp_path / "x.fmu", [], xml=FMI2.encode())).description
    plain = [signal.name for signal in description.recording([]).interface.outputs]
    for names, more in [
        (["mo*"], ["mode"]),
        (["mode", "m?de", "x"], ["mode"]),
        (["der(*"], ["der(x)"]),
    ]:
        with subtests.test(names=names):
            shown = [signal.name for signal in description.recording(names).interface.outputs]
            assert shown == [*plain, *more]
    everything = description.recording(["*"]).interface
    assert {"hidden", "der(x)", "mode"} < {signal.name for signal in everything.outputs}
    assert everything.inputs == description.interface.inputs


@pytest.mark.filterwarnings("ignore::cosim.CosimWarning")
def test_all_variables_of_an_fmu_can_be_recorded(exported, tmp_path):
    scenario = tmp_path / "locals.toml"
    text = SCENARIO.format(path=exported, interface_type="me")
    scenario.write_text(text.replace('["der(x_a[0])"]', '["*"]'))
    x = cosim.run(scenario)
    assert x["plant.der(x_a[0])"].shape == x["plant.y"].shape == (21,)


def test_variables_that_cannot_be_outputs_are_refused(tmp_path, subtests):
    for names, text in [
        (["d?z*"], r"no variable that can be recorded matches 'd.z.'; available: time"),
        (["nothing"], "no variable 'nothing'; "),
        (["u"], "outputs: 'u' is an input, and recorded as one"),
        (["words"], "outputs: 'words' has the type String, which is not recorded"),
        (["bytes"], "outputs: 'bytes' has the type Binary, which is not recorded"),
        (["dx", "dx"], "outputs: 'dx' is named twice"),
    ]:
        with subtests.test(names=names):
            description = read(write(tmp_path / "x.fmu", [], xml=FMI3.encode())).description
            with pytest.raises(FmuError, match=text):
                description.recording(names)


def test_parameters_are_constant_columns(probe2):
    """They keep what was set."""
    options = FmuOptions(interface_type="cs", start={"flag": True}, outputs=["flag"])
    with load(probe2, options) as fmu:
        component = fmu.component
        component.prepare(0.1, np.zeros(1, np.bool_), {})
        names = [signal.name for signal in component.interface.outputs]
        column = names.index("flag")
        assert component.initialize(0.0, np.zeros(1))[column] == 1.0
        rows = component.advance(np.array([0.0, 0.1]), 0.1, np.zeros((2, 1)))
        assert rows[0, column] == 1.0


def test_a_wrong_output_is_one_problem_of_the_scenario(exported, tmp_path):
    scenario = tmp_path / "locals.toml"
    text = SCENARIO.format(path=exported, interface_type="cs").replace('["der(', '["motor", "der(')
    scenario.write_text(text)
    with pytest.raises(CosimError, match=r"components.plant: .*no variable 'motor'"):
        cosim.run(scenario)


TEXTS = """<fmiModelDescription fmiVersion="2.0" modelName="texts" guid="t">
<CoSimulation modelIdentifier="model"/>
<ModelVariables>
<ScalarVariable name="status" valueReference="1" causality="output"><String/></ScalarVariable>
<ScalarVariable name="command" valueReference="2" causality="input"><String start=""/>
</ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure></fmiModelDescription>"""


def test_texts_are_not_dropped_without_a_word(tmp_path):
    """A run says that no signal carries them; so does info."""
    path = compile_fmu(tmp_path / "texts.fmu", TEXTS, "many2.c", defines=("N=1",))
    with load(path) as fmu:
        notes = "\n".join(fmu.notes)
    assert "texts: outputs that are strings are not recorded: status" in notes
    assert "keep their start values, the FMU's or those of 'start': command" in notes


@pytest.mark.parametrize("probe", ["probe2", "model1", "slave1"])
def test_strings_are_start_values(probe, request):
    """Of FMI 1 and 2; FMI 3 has arrays of them."""
    path = request.getfixturevalue(probe)
    with load(path, FmuOptions(start={"text": "abc"})) as fmu:
        component = fmu.component
        n = component.interface.n_u
        component.prepare(0.1, np.zeros(n, np.bool_), {})
        component.initialize(0.0, np.zeros(n))
        instance = fmu._instance
        assert instance.get_text(instance.description["text"]) == ("abc",)


def test_texts_of_fmi_3_are_start_values(probe3):
    """A Binary in hexadecimal."""
    start = {"texts": ["a b", "c"], "binaries": ["00ff", ""]}
    with load(probe3, FmuOptions(interface_type="cs", start=start)) as fmu:
        component = fmu.component
        component.prepare(0.1, np.zeros(1, np.bool_), {})
        component.initialize(0.0, np.zeros(1))
        instance = fmu._instance
        assert instance.get_text(instance.description["texts"]) == ("a b", "c")
        assert instance.get_text(instance.description["binaries"]) == ("00ff", "")
