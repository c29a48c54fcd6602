"""Every bad input gets one clear error before the first step.

The error has the place, what was expected, what was found, and the nearest name.
"""

import re
from pathlib import Path

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.document.document import find
from cosim.scenario.document.schema import File
from tests.scenario.refusals import check_refused

TEXT = find("academic").text


def run_edited(tmp_path, edits):
    """Edit the shipped text, and run it."""
    text = TEXT
    for before, after in edits:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    cosim.run(path, out=tmp_path / "mine.mcap")


def refused(tmp_path, *edits):
    """Edit the shipped text, run it, and give the message of the refusal."""
    with pytest.raises(UsageError) as caught:
        run_edited(tmp_path, edits)
    return str(caught.value).replace(str(tmp_path), "")


REGRESSOR_TERMS = """terms = [
  { alpha = "1.35 + 0.25*sin(1.7*t)", family = "exponential" },
  { alpha = "1.10 + 0.20*cos(2.3*t)", family = "exponential" },
]"""
CASES = {
    "unknown key": (
        [("filter_rate = 1e3", "filter_rat = 1e3")],
        r"/mine\.toml:40: components\.observer\.filter_rat: unknown key 'filter_rat'; did you "
        r"mean 'filter_rate'\? Available: L, ",
    ),
    "missing key": (
        [("rate = 1.0  ", "# ")],
        r"/mine\.toml:18: components\.u: 'rate' is missing .*angular rate \[rad/s\]",
    ),
    "unknown kind": (
        [('kind = "sine"', 'kind = "sin"')],
        r"/mine\.toml:19: components\.u\.kind: unknown kind 'sin'; did you mean 'sine'\?",
    ),
    "missing kind": ([('kind = "sine"', "")], r"/mine\.toml:18: components\.u: 'kind' is missing"),
    "wrong type": (
        [("amplitude = 1.0", 'amplitude = "1"')],
        r"components\.u\.amplitude: expected a number, got '1'",
    ),
    "unknown component": (
        [('"plant.u" = "u.y"', '"plant.u" = "w.y"')],
        r"/mine\.toml:56: connections\.plant\.u: 'w\.y': .*component 'w'",
    ),
    "one wrong entry alone": (
        [(REGRESSOR_TERMS, "terms = [{ alpha = 2.0, family = 'sine' }]")],
        r"\A/mine\.toml:\d+: components\.regressor\.terms\[0\]\.alpha: "
        r"expected a string or a table, got 2\.0\Z",
    ),
    "list without an entry": (
        [(REGRESSOR_TERMS, "terms = []")],
        r"components\.regressor\.terms: expected at least 1, got \[\]",
    ),
    "start before the run": (
        [("period = 0.1 ", "start = -1.0 ")],
        r"identifier: start: .*longest delay, 3\.0 s, got -1\.0 s",
    ),
    "bound that is not positive": (
        [("period = 0.1 ", "irregular = 0.0 ")],
        r"identifier\.irregular: expected a number > 0, got 0\.0$",
    ),
    "element beyond the most": (
        [(REGRESSOR_TERMS, "terms = [{ family = 'sine', element = 64 }]")],
        r"regressor\.terms\[0\]\.element: expected a number < 64, got 64$",
    ),
    "delay off the clock": (
        [("delays = [1.0, 2.0, 3.0]", "delays = [1.0, 2.0, 3.0000000000000004]")],
        r"components\.regressor: delays\[2\]: .*3\.0000000000000004 s",
    ),
    "connection that is none": (
        [('"plant.u" = "u.y"', '"plant.u" = 3')],
        r"connections\.plant\.u: expected a string or a list or a table, got 3",
    ),
    "connection with an unknown key": (
        [('"plant.u" = "u.y"', '"plant.u" = { from = "u.y", gian = 2.0 }')],
        r"connections\.plant\.u\.gian: unknown key 'gian'; did you mean 'gain'\? Available: "
        r"from, gain, offset, unit",
    ),
    "connection without a source": (
        [('"plant.u" = "u.y"', '"plant.u" = { gain = 2.0 }')],
        r"connections\.plant\.u: 'from' is missing",
    ),
    "ragged gain": (
        [("L = [4.0, 0.0]", "L = [[4.0], [0.0, 1.0]]")],
        r"L: .*\[1, 2\]",
    ),
    "unknown signal": (
        [('"plant.u" = "u.y"', '"plant.u" = "u.x"')],
        r"connections\.plant\.u: 'u\.x': .*'x'.*: y",
    ),
    "unknown input": (
        [('"plant.u" =', '"plant.uu" =')],
        r"'plant\.uu': .*'uu'.*'u'.*: u, delta",
    ),
    "unconnected input": (
        [('"plant.delta" = "delta.y"\n', "")],
        r"'plant\.delta' .*\[connections\]",
    ),
    "input driven twice": (
        [('"plant.u" = "u.y"', '"plant.u" = "u.y"\n"plant.u" = "delta.y"')],
        r'/mine\.toml:57: "plant\.u" is given twice',
    ),
    "table given twice": (
        [('"plant.u" = "u.y"', '"plant.u" = "u.y"\n[connections]')],
        r"/mine\.toml:57: \[connections\] is given twice; put its keys below one",
    ),
    "setting given twice": (
        [("step = 1e-3", "step = 1e-3\nstep = 2e-3")],
        r"/mine\.toml:\d+: step is given twice; remove one$",
    ),
    "truth given twice": (
        [('"observer.delta" =', '"observer.delta" = "plant.x_b"\n"observer.delta" =')],
        r'/mine\.toml:\d+: "observer\.delta" is given twice',
    ),
    "truth given twice in two spellings": (
        [('"observer.delta" =', 'observer.delta = "plant.x_b"\n"observer.delta" =')],
        r"truth\.observer\.delta: 'observer\.delta' is given twice",
    ),
    "port mapped twice in two spellings": (
        [
            (
                "[truth]",
                '[swap.plant]\npath = "x.fmu"\nmap = { "plant.u" = "a", plant.u = "b" }\n[truth]',
            )
        ],
        r"swap\.plant\.map\.plant\.u: 'plant\.u' is given twice; remove one\n",
    ),
    "input driven twice in two spellings": (
        [('"plant.u" = "u.y"', '"plant.u" = "u.y"\nplant.u = "delta.y"')],
        r"connections\.plant\.u: 'plant\.u' is given twice",
    ),
    "size mismatch": (
        [('"observer.y" = "plant.y"', '"observer.y" = "plant.x_a"')],
        r"plant\.x_a -> observer\.y: .*size 2 .*size 1",
    ),
    "no value into an input that needs one": (
        [
            (
                "[truth]",
                '[components.k]\nkind = "gain"\nK = [[1.0, 0.0]]\n[connections.k]\nu = '
                '"identifier.theta"\n[truth]',
            )
        ],
        r"identifier\.theta -> k\.u: ",
    ),
    "step not whole nanoseconds": (
        [("step = 1e-3 ", "step = 1.00000000001e-3 ")],
        r"/mine\.toml:9: scenario\.step: .*0\.00100000000001 s.*nearest: 0\.001 s",
    ),
    "step of nothing": (
        [("step = 1e-3 ", "step = 0 ")],
        r"scenario\.step: .*0\.0 s",
    ),
    "stop off the grid": (
        [("stop = 40.0 ", "stop = 40.0005 ")],
        r"/mine\.toml:8: scenario\.stop: 40\.0005 s.*0\.001 s.*nearest: 40\.0 s",
    ),
    "period not a multiple": (
        [("period = 0.1 ", "period = 3.3e-3 ")],
        r"period of 'identifier': .*0\.0033 s.*0\.001 s.*nearest: 0\.003 s",
    ),
    "delay not a multiple": (
        [("[1.0, 2.0, 3.0]", "[1.0, 2.0, 3.0005]")],
        r"delays\[2\]: .*3\.0005 s.*0\.001 s",
    ),
    "NaN": (
        [("amplitude = 1.0", "amplitude = nan")],
        r"/mine\.toml:20: components\.u\.amplitude: expected a finite number, got nan",
    ),
    "infinity in a list": (
        [("x_a0 = [1.0,", "x_a0 = [inf,")],
        r"components\.plant\.x_a0\[0\]: expected a finite number, got inf",
    ),
    "NaN in a matrix": (
        [("C  = [[2, 0, 1]]", "C  = [[2, nan, 1]]")],
        r"models\.academic\.C\[0\]\[1\]: expected a finite number, got nan",
    ),
    "matrix of wrong shape": (
        [("Bu = [[0], [2], [1]]", "Bu = [[0], [2]]")],
        r"Bu.*\(2, 1\)",
    ),
    "ragged matrix": (
        [("[[0, 1, 1],", "[[0, 1],")],
        r"models\.academic\.A: .*\[2, 3, 3\]",
    ),
    "singular A22": (
        [("[1, 0, 1]]\nBu", "[1, 0, 0]]\nBu")],
        r"components\.plant: .*\(0 of 1; Assumption 2\); A\[2:, 2:\] is singular; INDEX_2",
    ),
    "disturbance not decoupled": (
        [("Bd = [[1], [0], [0]]", "Bd = [[0], [1], [0]]")],
        r"components\.observer: .*Assumption 5\): 0 of 1 .*\(RELATIVE_DEGREE\).* of rank 0",
    ),
    "observer not Hurwitz because of a zero": (
        [("[0, -2, 1]", "[0, 2, 1]")],
        r"M - L C is not Hurwitz: eigenvalue \+2.*zero at \+2",
    ),
    "observer not Hurwitz because of L": (
        [("L = [4.0, 0.0]", "L = [-4.0, 0.0]")],
        r"M - L C is not Hurwitz: eigenvalue \+4",
    ),
    "gain of wrong shape": (
        [("L = [4.0, 0.0]", "L = [4.0]")],
        r"components\.observer: L: .*\(2, 1\), .*got \(1, 1\)",
    ),
    "neither gain nor poles": ([("L = [4.0, 0.0] ", "# ")], r"L .*poles"),
    "equal delays": (
        [("[1.0, 2.0, 3.0]", "[1.0, 2.0, 2.0]")],
        r"components\.regressor: delays 2 and 3: .*got 2 s twice",
    ),
    "too few delays": (
        [("[1.0, 2.0, 3.0]", "[1.0, 2.0]")],
        r"components\.regressor: delays: expected 3, .*got 2 \(Assumption 3\)",
    ),
    "proportional alphas": (
        [
            (
                'alpha = "1.10 + 0.20*cos(2.3*t)", family = "exponential" }',
                'alpha = "2.7 + 0.5*sin(1.7*t)", family = "exponential" }',
            )
        ],
        r"are proportional",
    ),
    "unknown family": (
        [('family = "exponential" },\n]\ndelays', 'family = "exponentail" },\n]\ndelays')],
        r"'exponentail'.*did you mean 'exponential'\?",
    ),
    "unknown model": (
        [('model = "academic" ', 'model = "acedemic" ')],
        r"unknown model 'acedemic' in \[models\]; did you mean 'academic'\?",
    ),
    "unknown method": (
        [('method = "output-error"', 'method = "rls"')],
        r"components\.identifier\.method: unknown value 'rls'; available: output-error, ",
    ),
    "unknown coupling": (
        [("step = 1e-3 ", 'coupling = "jacoby"\nstep = 1e-3 ')],
        r"scenario\.coupling: unknown value 'jacoby'; did you mean 'jacobi'\?",
    ),
    "expression with an unknown name": (
        [("1.7*t", "1.7*tt")],
        r"'tt'.*did you mean 't'\?",
    ),
    "truth of an unknown signal": (
        [
            (
                '"observer.delta" = "delta.y"\n"identifier',
                '"observer.dleta" = "delta.y"\n"identifier',
            )
        ],
        r"truth\.observer\.dleta: unknown signal 'observer\.dleta'; did you mean "
        r"'observer\.delta'\?",
    ),
    "truth of another size": (
        [("[-0.1, -0.3]", "[-0.1]")],
        r"'identifier\.theta' has size 2, .*\[-0\.1\] has size 1",
    ),
    "no TOML": ([("stop = 40.0 ", "stop = = ")], r"/mine\.toml:8: not TOML: "),
    "name with a dot": (
        [("[components.u]", '[components."u.v"]')],
        r"expected a name of letters, digits, '_' and '-' .*got 'u\.v'",
    ),
    "identification before there is a regression": (
        [("period = 0.1 ", "start = 2.0\nperiod = 0.1 ")],
        r"start: .*longest delay, 3\.0 s, got 2\.0 s",
    ),
    "prior that is none": (
        [('method = "output-error"', 'method = "least-squares"\nP0 = -1.0')],
        r"P0: .*-1\.0",
    ),
}


START = """
[scenario]
name = "x"
stop = 1.0
step = 0.1
[components.p]
kind = "fmu"
path = "x.fmu"
start = { T = %s }
"""
STARTS = [
    ("nan", r"T: expected a finite number, got nan"),
    ("[1.0, nan]", r"T\[1\]: expected a finite number, got nan"),
    ("[[1.0], [nan]]", r"T\[1\]\[0\]: expected a finite number, got nan"),
    ("{}", r"T: expected true or false or a number or a string or a list, got {}"),
]


def test_a_start_value_is_refused_in_one_line(tmp_path):
    """Whatever else it might have been."""
    path = tmp_path / "x.toml"

    def run(value):
        path.write_text(START % value)
        cosim.run(path)

    lines = [(value, rf"\A.*/x\.toml:9: components\.p\.start\.{text}\Z") for value, text in STARTS]
    check_refused(lines, run, ScenarioError)


def test_bad_input_is_refused_with_its_place(tmp_path):
    """One clear error each, before anything is written: see CASES."""
    cases = [(name, pattern.replace(r"\A", "")) for name, (_, pattern) in CASES.items()]
    check_refused(cases, lambda name: run_edited(tmp_path, CASES[name][0]))
    assert not (tmp_path / "mine.mcap").exists()
    assert UsageError.exit_code == 2


def test_all_errors_of_a_file_come_together(tmp_path):
    """Errors of values, keys, assumptions and connections are reported together, each once."""
    message = refused(
        tmp_path,
        ("amplitude = 1.0", "amplitude = nan"),
        ("delays = [1.0, 2.0, 3.0]", "delays = [1.0, 2.0, 2.0]"),
        ("L = [4.0, 0.0]", "L = [-4.0, 0.0]"),
        ('"regressor.delta" = "observer.delta"', '"regressor.delta" = "w.delta"'),
        ('"plant.delta" = "delta.y"\n', ""),
    )
    for pattern in (
        "amplitude: expected a finite number, got nan",
        "delays 2 and 3",
        "not Hurwitz",
        "component 'w'",
        "'plant.delta' is not connected",
    ):
        assert message.count(pattern) == 1, message


def test_an_algebraic_loop_without_a_solution_names_every_port(tmp_path):
    """A static gain from y to u closes a path without delay, as y of the plant feeds through.

    The plant has D = -1 from u to y: a gain of -1 makes the loop u = u + ..., which is singular.
    """
    message = refused(
        tmp_path,
        ('"plant.u" = "u.y"', '"plant.u" = "k.y"\n"k.u" = "plant.y"'),
        ("[connections]", '[components.k]\nkind = "gain"\nK = -1.0\n\n[connections]'),
    )
    cycle = re.search(r"no initial values for ((?:\S+ -> )+[^, ]+), which form", message)
    assert cycle, message
    assert set(cycle[1].split(" -> ")) == {"plant.y", "k.u", "k.y", "plant.u"}


def test_units_must_agree_or_be_converted(tmp_path):
    """A declared unit drives one that it can be converted to; a gain says what unit it leads to."""
    text = (
        '[scenario]\nname = "units"\nstop = 0.1\nstep = 0.01\n[components.u]\nkind = '
        '"constant"\nvalue = 2.0\nunit = "mm"\n'
        '[components.x]\nkind = "lag"\ntime_constant = 1.0\nunit = "m"\n[connections]\n"x.u" = '
        "{source}\n"
    )
    path = tmp_path / "units.toml"
    path.write_text(text.replace("{source}", '"u.y"'))
    assert cosim.run(path)["x.u"][-1] == 2.0 * 1e-3
    path.write_text(text.replace("{source}", '"u.y"').replace('unit = "m"', 'unit = "s"'))
    with pytest.raises(ScenarioError, match=r"u\.y -> x\.u: .*'mm'.*'s'"):
        cosim.run(path)
    path.write_text(text.replace("{source}", '{ from = "u.y", gain = 1e-3, unit = "m" }'))
    assert cosim.run(path)["x.u"][-1] == pytest.approx(2e-3, rel=1e-15)


CHANGES = [
    (
        {"obs.filter_rate": 1.0},
        r"set\['obs\.filter_rate'\]: unknown component 'obs'; did you mean 'observer'\?",
    ),
    (
        {"observer.filter_rat": 1.0},
        r"set\['observer\.filter_rat'\]: unknown key",
    ),
    (
        {"scenario.threads": True},
        r"set\['scenario\.threads'\]: expected a whole number, got True",
    ),
    (
        {"scenario.threads": 3},
        r"set\['scenario\.threads'\]: expected a number <= 2, got 3",
    ),
    (
        {"filter_rate": 1.0},
        r"set\['filter_rate'\]: expected COMPONENT\.PARAMETER, such as set=",
    ),
    (
        {"plant.x_a0": [1.0]},
        r"academic:30 \(with set\['plant\.x_a0'\]\): components\.plant: x_a0.*\(2,\)",
    ),
    (
        {"scenario.stop": -1.0},
        r"set\['scenario\.stop'\]: .*-1\.0 s",
    ),
]
SWAPS = [
    (
        {"plnt": "x.fmu"},
        r"swap\['plnt'\]: unknown component 'plnt'; did you mean 'plant'\?",
    ),
    (
        {"plant": "x.zip"},
        r"swap\['plant'\]: expected .*\.fmu .*\.mcap .*\.csv.*got '.*x\.zip'",
    ),
    (
        {"plant": "missing.fmu"},
        r"swap\['plant'\]: .*missing\.fmu",
    ),
    (
        {"plant": "missing.mcap"},
        r"swap\['plant'\]: .*missing\.mcap .*No such file",
    ),
]


def test_a_bad_edit_names_the_edit():
    """What came from --set and --swap is not blamed on the file."""
    check_refused(CHANGES, lambda changes: cosim.run("academic", set=changes), ScenarioError)
    check_refused(SWAPS, lambda swap: cosim.run("academic", swap=swap), ScenarioError)


def test_an_unknown_scenario_names_the_nearest():
    """A name that is no path and not shipped."""
    with pytest.raises(ScenarioError, match=r"unknown scenario 'acedemic'.* mean 'academic'\?"):
        cosim.load("acedemic")


def test_a_start_time_is_not_computed_from_one_of_several_observers():
    """T_id is computed for one observer: of stacked sources none is taken for all."""
    spec = cosim.load("academic").tree["components"]["observer"]
    changes = {
        "components.second": {**spec, "filter_rate": 500.0},
        "connections.second.u": "u.y",
        "connections.second.y": "plant.y",
        "connections.regressor.delta": {
            "from": ["observer.delta", "second.delta"],
            "gain": [[0.5, 0.5]],
        },
        "scenario.stop": 0.1,
        "identifier.method": "least-squares",
    }
    with pytest.raises(ScenarioError, match=r"components\.identifier: start: .*one observer"):
        cosim.run("academic", set=changes)
    cosim.run("academic", set={**changes, "identifier.start": 7.0})


def test_a_missing_file_is_refused(tmp_path):
    """A path that leads nowhere."""
    with pytest.raises(ScenarioError, match=r"none\.toml: .*No such file or directory"):
        cosim.load(tmp_path / "none.toml")


def test_a_log_that_lacks_a_component_is_refused(tmp_path):
    """A recording can only stand for what it recorded."""
    path = tmp_path / "a.mcap"
    cosim.run("academic", out=path, set={"scenario.stop": 0.1})
    with pytest.raises(
        ScenarioError,
        match=r"a\.mcap .*'plnat'; did you mean 'plant'\? Available: u, delta",
    ):
        cosim.run(
            "academic", swap={"plant": path}, set={"scenario.stop": 0.1, "plant.component": "plnat"}
        )


@pytest.mark.parametrize(("start", "end"), [(0.5, 50.0), (0.0, 39.0)])
def test_a_table_must_cover_the_whole_run(start, end):
    """Beyond its ends a table has no value; that is known before the first step."""
    table = {"kind": "table", "t": [start, end], "y": [0.0, 1.0]}
    with pytest.raises(
        ScenarioError,
        match=rf"set\['u'\]: table: .*0\.0 s to 40\.0 s .*{start} s to {end} s",
    ):
        cosim.run("academic", set={"components.u": table})


TOO_FINE_OR_LARGE = [
    (
        {"components.u": {"kind": "step", "time": 1.0005}},
        r"time: .*1\.0005 s.*0\.001 s.*nearest: 1\.0 s",
    ),
    (
        {"components.d": {"kind": "delay", "delay": 1e9}},
        r"delay: .*communication steps of 1 values",
    ),
    (
        {"scenario": {"stop": 2.0}},
        r"set\['scenario'\]: expected COMPONENT\.PARAMETER, such as set=",
    ),
    (
        {"connections.plant.u": {"from": "u.y", "gain": [[1.0, 2.0], [3.0]]}},
        r"connections\.plant\.u'\]: 'u\.y': .*gain, got .*lengths: .*1\.0, 2\.0.*3\.0",
    ),
    (
        {"scenario.stop": 1e12},
        r"set\['scenario\.stop'\]: 1000000000000\.0 s",
    ),
]


def test_values_off_the_grid_or_too_large_are_refused():
    """Nothing is rounded to the grid, and nothing is tried that cannot fit."""
    check_refused(
        TOO_FINE_OR_LARGE, lambda changes: cosim.run("academic", set=changes), ScenarioError
    )


NOT_FINITE = [
    (("regressor", "1/(t - 5)"), r"alpha '1/\(t - 5\)': .*inf at t = 5 s"),
    (("regressor", "1/(t - 4.015)"), r"inf at t = 4.015 s|off, most at t = 4.01"),
    (("regressor", "log(t - 1)"), r"alpha 'log\(t - 1\)': .*nan at t = 0 s"),
    (("delta", "1/(t - 5)"), r"alpha '1/\(t - 5\)': .*inf at t = 5 s"),
    (("delta", "log(t - 1)"), r"alpha 'log\(t - 1\)': .*nan at t = 0 s"),
]


def test_an_alpha_that_is_not_finite_is_refused_before_the_run():
    """With the instant, and without a warning of numpy."""

    def run(case):
        component, alpha = case
        term = {"alpha": alpha, "family": "exponential"}
        changes = {"regressor.terms": [term], "regressor.delays": [0.5, 1.0]}
        if component == "delta":
            changes = {"delta.terms": [{**term, "theta": -0.4}]}
        changes |= {"scenario.step": 0.01, "scenario.stop": 10.0, "observer.filter_rate": 50.0}
        cosim.run("academic-noisy", set=changes)

    check_refused(NOT_FINITE, run)


@pytest.mark.parametrize("components", ["components = 1000", "[componants]"])
def test_nothing_follows_from_a_table_that_cannot_be_read(tmp_path, components):
    """As that there is no component in it."""
    path = tmp_path / "mine.toml"
    table = '[scenario]\nname = "x"\nstop = 1.0\nstep = 0.1\n'
    is_table = components.startswith("[")
    path.write_text(f"{table}{components}\n" if is_table else f"{components}\n{table}")
    with pytest.raises(ScenarioError) as caught:
        cosim.run(path)
    (line,) = str(caught.value).splitlines()
    assert "mine.toml:5: componants" in line if is_table else "mine.toml:1: components" in line


def test_the_page_lists_every_table_of_a_scenario():
    """And none that is a table of another file."""
    page = (Path(__file__).parents[3] / ".readme" / "scenario.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| `[")]
    listed = {name for row in rows for name in re.findall(r"\[(\w+)[\].]", row.split("|")[1])}
    assert listed == File.model_fields.keys()
