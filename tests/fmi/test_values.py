"""Values, messages and statuses on their way between an FMU and us."""

import numpy as np
import pytest

import cosim
from cosim.errors import RunError
from cosim.fmi.binary.loaded import from_fmu_type, to_fmu_type
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import opened
from tests.fmi.test_native_co_simulation import typed_xml

WHOLE = [
    *((value, "Int64") for value in (0, 2**53, -(2**53), 2**53 + 2, -(2**63), 2**63 - 1024)),
    *((value, "UInt64") for value in (2**53, 2**64 - 2048)),
]
ROUNDED = [
    *((value, "Int64") for value in (2**53 + 1, -(2**53) - 1, 1 - 2**63, 2**63 - 1)),
    *((value, "UInt64") for value in (2**53 + 1, 2**64 - 1)),
]


def test_integers_are_carried_exactly_or_not_at_all():
    """float64 holds every one up to 2**53, beyond it those with 53 significant bits."""
    for value, variable_type in WHOLE:
        dtype = np.dtype(variable_type.lower())
        received = from_fmu_type("m", np.array([value], dtype))
        assert [int(number) for number in received] == [value]
        assert to_fmu_type("m", variable_type, dtype, received).tolist() == [value]
    for value, variable_type in ROUNDED:
        text = rf"m: an integer beyond 2\*\*53 cannot be carried exactly: \[{value}\]"
        with pytest.raises(RunError, match=text):
            from_fmu_type("m", np.array([value], variable_type.lower()))


def test_numbers_outside_a_type_are_refused(subtests):
    """Without a warning of numpy."""
    for variable_type, value in [
        ("Int32", 1e300),
        ("Int64", 2.0**63),
        ("UInt64", 2.0**64),
        ("Int64", -(2.0**63) - 2048.0),
        ("UInt8", -1.0),
        ("Boolean", 2.0),
        ("Int32", np.nan),
    ]:
        with subtests.test(variable_type=variable_type, value=value):
            dtype = np.bool_ if variable_type == "Boolean" else np.dtype(variable_type.lower())
            with pytest.raises(RunError, match=f"expected numbers of type {variable_type}"):
                to_fmu_type("m", variable_type, dtype, np.array([value]))


@pytest.mark.parametrize(
    ("status", "label", "freed"),
    [(3, "error", 1), (4, "fatal", 0), (5, "pending", 1), (9, "no status of the standard", 1)],
)
def test_only_a_fatal_status_forbids_freeing(probe2, status, label, freed):
    """FMI 2.0.4 section 2.1.3: after fmi2Fatal no call is allowed.

    After any other status the instance can be freed.
    """
    with opened(probe2, interface_type="cs") as (fmu, instance):
        references = instance.description.references_of(["answer"])
        instance.set_float64(references, np.array([float(status)]))
        with pytest.raises(RunError, match=rf"probe2.fmu: fmi2Reset returned {status} \({label}\)"):
            instance._calls.reset()
        if status == 4:
            with pytest.raises(
                RunError, match=r"fmi2Reset cannot be called: fmi2Reset returned 4 \(fatal\) before"
            ):
                instance._calls.reset()
    assert [text for *_, text in fmu.drain()].count("freed") == freed


# --- what an FMU allows of its inputs ---


@pytest.fixture(scope="module")
def valve(tmp_path_factory):
    """Build ``c/typed2.c`` with u from -1 to 1, and n an enumeration of 0 and 2."""
    xml = typed_xml(interpolates=False)
    number = '<Real start="0"/>'
    assert xml.index(number) == xml.index(number, xml.index('name="u"'))
    xml = xml.replace(number, '<Real start="0" min="-1" max="1"/>', 1)
    n = xml.index('name="n"')
    begin = xml.index("<Integer", n)
    enumeration = '<Enumeration declaredType="Mode" start="0"/>'
    xml = xml[:begin] + enumeration + xml[xml.index("/>", begin) + 2 :]
    types = (
        '<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="off" value="0"/>'
        '<Item name="on" value="2"/></Enumeration></SimpleType></TypeDefinitions>'
    )
    xml = xml.replace("<ModelVariables>", f"{types}<ModelVariables>")
    folder = tmp_path_factory.mktemp("valve")
    defines = ("CALL=NEVER", "AT=0", "STATUS=fmi2OK")
    return compile_fmu(folder / "valve.fmu", xml, "typed2.c", defines=defines)


def driven(folder, components, connections, **options):
    """Run a scenario for 1 s in steps of 0.1 s; return what it warns of inputs, with times [s]."""
    path = folder / "valve.toml"
    text = ["[scenario]", 'name = "valve"', "stop = 1.0", "step = 0.1", "[components]"]
    path.write_text("\n".join([*text, *components, "[connections]", *connections]))
    log = cosim.run(path, **options)
    return [(w.time_ns / 1e9, w.text) for w in log.warnings if "is driven with" in w.text]


def by_expressions(valve, folder, u="0", n="0"):
    components = (
        f'u = {{ kind = "expression", y = "{u}" }}',
        f'n = {{ kind = "expression", y = "{n}", discrete = true }}',
        f'plant = {{ kind = "fmu", path = "{valve}" }}',
    )
    return driven(folder, components, ('"plant.u" = "u.y"', '"plant.n" = "n.y"'))


@pytest.mark.filterwarnings("ignore::cosim.CosimWarning")
def test_a_value_beyond_what_an_input_allows_is_warned_of_once(valve, tmp_path, subtests):
    """With the first such value and its time."""
    ((time, text),) = by_expressions(valve, tmp_path, u="2*t")
    assert time == 0.6
    assert "input 'u' is driven with 1.2; expected -1.0 to 1.0 (min, max)" in text
    ((time, text),) = by_expressions(valve, tmp_path, n="step(t - 0.2) + step(t - 0.4)")
    assert time == 0.2
    assert "input 'n' is driven with 1.0; expected 0 (off), 2 (on)" in text
    for allowed in ("1 + 2*1e-16", "-1", "0"):
        with subtests.test(u=allowed):
            assert by_expressions(valve, tmp_path, u=allowed, n="2*step(t - 0.2)") == []


@pytest.mark.filterwarnings("ignore::cosim.CosimWarning")
def test_what_an_input_allows_is_known_behind_other_names(valve, tmp_path):
    """In the place of another component, whose input has another name."""
    components = (
        'source = { kind = "ramp", slope = 2.0 }',
        'plant = { kind = "sum", signs = [1.0] }',
    )
    swapped = {"swap": {"plant": str(valve)}, "map": {"plant.u1": "u"}}
    ((time, _),) = driven(tmp_path, components, ('"plant.u1" = "source.y"',), **swapped)
    assert time == 0.6
