"""The commands on FMUs."""

import dataclasses
import json

import pytest

from cosim.fmi.variable import Variable
from tests.fmi.archives import write
from tests.fmi.descriptions import FMI1, FMI2, FMI3

INFO = {
    FMI1.replace("{implementation}", ""): (
        "N 1.0 kg.m.s-2",
        "u input continuous Float64 N 1 -1..2",
        "z output continuous Float64 unknown",
        "v output continuous Float64 nothing",
        "1 off, 2 on",
        "n states 2",
        "exchange identifier one",
    ),
    FMI2: (
        "degC 1.0 K + 273.15",
        "kN 1000.0 kg.m.s-2",
        "approx 1.5 state",
        "-3 off, 7 on",
        "0..50 u, x",
        "der x u, x",
        "initial dependencies",
        "rise unknown",
        "default step 0.01",
    ),
    FMI3: (
        "Float64[n][2] mm 6 x 0.5",
        "second input continuous Float64[n][2] mm 6 x 0.5 alias u",
        "Float32[n] u, x",
        "clocks tick",
        "fixed step 0.5, event mode, early return",
        "String[2] a b c",
    ),
}


@pytest.mark.parametrize("xml", INFO, ids=["FMI 1", "FMI 2", "FMI 3"])
def test_info_of_an_fmu_has_what_its_description_has(call, tmp_path, xml):
    """Units in SI, ranges, items, sizes, states, dependencies and clocks; JSON has every field."""
    write(tmp_path / "x.fmu", [], xml=xml.encode())
    shown = " ".join(call("info", "x.fmu")[1].split())
    assert [text for text in INFO[xml] if text not in shown] == []
    found = json.loads(call("info", "x.fmu", "--json")[1])
    fields = {field.name for field in dataclasses.fields(Variable)}
    assert all(set(variable) == fields for variable in found["variables"])
    assert {"units", "dependencies", "initial_dependencies", "capabilities"} <= found.keys()


@pytest.mark.slow
def test_check_reports_every_problem_and_exits_1_at_an_error(call, tmp_path, files):
    """With --strict also at a warning; JSON says the same."""
    assert call("check", "plant.fmu", "--strict") == (0, "plant.fmu: no problems found\n", "")
    write(tmp_path / "x.fmu", [], xml=FMI3.replace('start="1 2 3"', 'start="1 2"').encode())
    code, out, _ = call("check", "x.fmu")
    assert code == 1
    text = "variable 'x': has 2 start values for 3 elements"
    assert f"error: XML: {text}\n" in out
    assert "warning: initial unknowns: not listed: mode\n" in out
    assert out.endswith("x.fmu: 2 errors, 1 warning\n")
    code, out, _ = call("check", "x.fmu", "--json")
    found = json.loads(out)
    assert (code, found["errors"], found["warnings"]) == (1, 2, 1)
    assert {"level": "error", "where": "XML", "text": text} in found["findings"]


def test_an_export_has_a_place_by_default(call, tmp_path):
    """It is not replaced unless that is asked for."""
    arguments = ("export", "academic", "--component", "plant")
    path = "fmus/academic-plant.fmu"
    code, out, _ = call(*arguments)
    assert code == 0
    assert out.startswith(f"{path}: FMI 2.0")
    assert (tmp_path / path).is_file()
    code, _, err = call(*arguments)
    assert code == 2
    assert f"{path} exists" in err
    assert call(*arguments, "--force")[0] == 0


@pytest.mark.usefixtures("files")
def test_linearize_gives_matrices_poles_and_gain(call):
    """The reduced plant (28): A, its poles -1.5 +- 0.866i, the static gain -4/3 and 2/3.

    ``delta`` alone, by differences, has the last column.
    """
    code, out, err = call("linearize", "plant.fmu", "--output", "y", "--set", "x_a[0]=0.5")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert {"der(x_a[0])\t-1\t1", "der(x_a[1])\t-1\t-2"} <= set(lines)
    assert "poles\t-1.5-0.866025j, -1.5+0.866025j" in lines
    assert lines[lines.index("static gain D - C A^-1 B") + 2] == "y\t-1.33333\t0.666667"
    options = "--input delta --output y --differences --at 2 --json"
    found = json.loads(call("linearize", "plant.fmu", *options.split())[1])
    assert (found["t"], found["inputs"]) == (2.0, ["delta"])
    assert found["made"]["delta"] == "central differences"
    assert found["static_gain"][0] == pytest.approx([2.0 / 3.0], rel=1e-9)


@pytest.mark.slow
def test_linearize_says_where_there_is_no_gain(call, tmp_path):
    """An integrator."""
    (tmp_path / "i.toml").write_text(
        'scenario = { name = "i", stop = 0.1, step = 0.01 }\n[components]\n'
        'u = { kind = "constant", value = 1.0 }\n'
        'c = { kind = "controller", A = [[0.0]], B = [[1.0]], C = [[2.0]] }\n'
        '[connections]\n"c.u" = "u.y"\n'
    )
    call("export", "i.toml", "--component", "c", "--out", "i.fmu")
    assert "static gain\tnone, as A is singular" in call("linearize", "i.fmu")[1]


@pytest.mark.usefixtures("files")
def test_linearize_prints_a_table_for_a_scenario(call):
    """Ready for [models]; what --disturbance names is an unknown input in it."""
    toml = ("linearize", "plant.fmu", "--output", "y", "--toml")
    code, out, _ = call(*toml, "--disturbance", "delta")
    assert code == 0
    assert out.startswith("[models.academic_plant]")
    assert {"Bd = [[1.0], [0.0]]", "Du = [[-1.0]]"} <= set(out.splitlines())
    assert "Dd" not in out
    assert "Bu = [[-1.0, 1.0], [1.0, 0.0]]" in call(*toml)[1].splitlines()
