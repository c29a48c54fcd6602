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


def run_edited(tmp_path, *edits):
    """Edit the shipped text, and run it."""
    text = TEXT
    for before, after in edits:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    cosim.run(path, out=tmp_path / "mine.mcap")


# what is written in the place of what, and what the message says of that, in its first line; behind
# a + there are more, of what the mistake leaves open
CASES = r"""
filter_rate = 1e3 -> filter_rat = 1e3 :: :40: components.observer.filter_rat: .* 'filter_rate'\?
rate = 1.0   -> # :: :18: components.u: 'rate' is missing .*\[rad/s\]
kind = "sine" -> kind = "sin" :: :19: components.u.kind: unknown kind 'sin'; did you mean 'sine'
kind = "sine" -> # :: :18: components.u: 'kind' is missing
amplitude = 1.0 -> amplitude = "1" :: :20: components.u.amplitude: expected a number, got '1'
amplitude = 1.0 -> amplitude = nan :: :20: components.u.amplitude: expected a finite number, got nan
x_a0 = [1.0, -> x_a0 = [inf, :: components.plant.x_a0\[0\]: expected a finite number, got inf
C  = [[2, 0, 1]] -> C  = [[2, nan, 1]] :: models.academic.C\[0\]\[1\]: .*finite number, got nan
period = 0.1  -> irregular = 0.0  :: identifier.irregular: expected a number > 0, got 0.0$
"plant.u" = "u.y" -> "plant.u" = "w.y" :: :56: connections.plant.u: 'w.y': .*component 'w'
"plant.u" = "u.y" -> "plant.u" = "u.x" :: :56: connections.plant.u: 'u.x': .*'x'.*: y
"plant.u" = "u.y" -> "plant.u" = 3 :: connections.plant.u: .* string or a list or a table, got 3
"plant.u" = "u.y" -> "plant.u" = { from = "u.y", gian = 2.0 } :: plant.u.gian: .*did you mean 'gain'
"plant.u" = "u.y" -> "plant.u" = { gain = 2.0 } :: connections.plant.u: 'from' is missing
"plant.u" = -> "plant.uu" = :: +'plant.uu': .*'uu'.*'u'.*: u, delta
"plant.delta" = -> # :: 'plant.delta' .*\[connections\]
"observer.y" = "plant.y" -> "observer.y" = "plant.x_a" :: plant.x_a -> observer.y: .*2 .*size 1
"plant.u" = "u.y" -> plant.u = "u.y"¶"plant.u" = "delta.y" :: :57: .*'plant.u' is given twice
"plant.u" = "u.y" -> "plant.u" = "u.y"¶"plant.u" = "d.y" :: :57: "plant.u" is given twice
"plant.u" = "u.y" -> "plant.u" = "u.y"¶[connections] :: :57: \[connections\] is given .* heading
step = 1e-3 -> step = 1e-3¶step = 2e-3 :: :10: step is given twice; remove one$
"observer.delta" = -> observer.delta = "plant.x_b"¶"observer.delta" = :: :66: truth.* given twice
"observer.delta" = "delta.y" -> "observer.dleta" = "delta.y" :: dleta: .*'observer.delta'\?
[-0.1, -0.3] -> [-0.1] :: 'identifier.theta' has size 2, .*\[-0.1\] has size 1
step = 1e-3  -> step = 1.00000000001e-3  :: :9: scenario.step: .*0.00100000000001 s.*: 0.001 s
step = 1e-3  -> step = 0 :: scenario.step: .*0.0 s
step = 1e-3  -> coupling = "jacoby"¶step = 1e-3 :: scenario.coupling: .*did you mean 'jacobi'\?
stop = 40.0 -> stop = = :: :8: not TOML:
stop = 40.0 -> stop = 40.0005 :: :8: scenario.stop: 40.0005 s.*0.001 s.*nearest: 40.0 s
period = 0.1  -> period = 3.3e-3  :: period of 'identifier': .*0.0033 s.*0.001 s.*nearest: 0.003 s
period = 0.1  -> start = -1.0¶period = 0.1 :: identifier: start: .*longest delay, 3.0 s, got -1.0 s
period = 0.1  -> start = 2.0¶period = 0.1 :: identifier: start: .*longest delay, 3.0 s, got 2.0 s
[1.0, 2.0, 3.0] -> [1.0, 2.0, 3.0005] :: components.regressor: delays\[2\]: .*3.0005 s.*0.001 s
[1.0, 2.0, 3.0] -> [1.0, 2.0, 3.0000000000000004] :: delays\[2\]: .*3.0000000000000004 s
[1.0, 2.0, 3.0] -> [1.0, 2.0, 2.0] :: components.regressor: delays 2 and 3: .*got 2 s twice
[1.0, 2.0, 3.0] -> [1.0, 2.0] :: components.regressor: delays: expected 3, .*got 2 \(Assumption 3\)
Bu = [[0], [2], [1]] -> Bu = [[0], [2]] :: Bu.*\(2, 1\)
[[0, 1, 1], -> [[0, 1], :: models.academic.A: .*\[2, 3, 3\]
[1, 0, 1]]¶Bu -> [1, 0, 0]]¶Bu :: +components.plant: .*Assumption 2\); A\[2:, 2:\] .*INDEX_2
Bd = [[1], [0], [0]] -> Bd = [[0], [1], [0]] :: observer: .*Assumption 5\).*RELATIVE_DEGREE
[0, -2, 1] -> [0, 2, 1] :: M - L C is not Hurwitz: eigenvalue \+2.*zero at \+2
L = [4.0, 0.0] -> L = [-4.0, 0.0] :: M - L C is not Hurwitz: eigenvalue \+4
L = [4.0, 0.0] -> L = [4.0] :: components.observer: L: .*\(2, 1\), .*got \(1, 1\)
L = [4.0, 0.0] -> L = [[4.0], [0.0, 1.0]] :: L: .*\[1, 2\]
L = [4.0, 0.0] -> # :: L .*poles
model = "academic"  -> model = "acedemic"  :: unknown model 'acedemic' .* mean 'academic'\?
method = "output-error" -> method = "rls" :: identifier.method: .*'rls'; available: output-error,
method = "output-error" -> method = "least-squares"¶P0 = -1.0 :: P0: .*-1.0
1.7*t -> 1.7*tt :: +'tt'.*did you mean 't'\?
"1.10 + 0.20*cos(2.3*t)" -> "2.7 + 0.5*sin(1.7*t)" :: are proportional
"exponential" } -> "exponentail" } :: 'exponentail'.*did you mean 'exponential'\?
[components.u] -> [components."u.v"] :: +expected a name of letters, .*got 'u.v'
[connections] -> [conections] :: \[conections|conections: .*'connections'
[models.academic] -> [model.academic] :: model: .*'models'
n_a = 2 -> n_a = -2 :: models.academic.n_a: .*-2
C  = [[2, 0, 1]] -> C  = [[2, 0]] :: models.academic: .*C
step = 1e-3  -> step = -1e-3  :: :9: scenario.step: .*-0.001
name = "academic" -> name = "" :: scenario.name: .*''
"regressor.delta" = "observer.delta" -> "regressor.delta" = "observer" :: delta: .*'observer'
[1.0, 2.0, 3.0] -> [1.0, 2.0, 3e300] :: components.regressor: .*3e\+300
kind = "unknown-input-observer" -> kind = "observer" :: components.observer.kind: .*'observer'
"observer.y" = "plant.y" -> # :: connections.observer.y: 'observer.y' is not connected
[truth] -> [swap.plant]¶path = "x.fmu"¶map = { "plant.u" = "a", plant.u = "b" }¶[truth] :: +twice
"""


def test_bad_input_is_refused_with_its_place(tmp_path):
    """One line each, before anything is written: a consequence of a mistake is no second one."""
    cases = []
    for case in CASES.strip().splitlines():
        edit, pattern = case.split(" :: ")
        end = "" if pattern.startswith("+") else r"(?=.*\Z)"
        whole = rf"\A{end}.*({pattern.removeprefix('+')})"
        cases.append((edit.replace("¶", "\n").split(" -> "), whole))
    check_refused(cases, lambda edit: run_edited(tmp_path, edit))
    assert not (tmp_path / "mine.mcap").exists()
    assert UsageError.exit_code == 2


def test_an_algebraic_loop_without_a_solution_names_every_port(tmp_path):
    """A static gain from y to u closes a path without delay, as y of the plant feeds through.

    The plant has D = -1 from u to y: a gain of -1 makes the loop u = u + ..., which is singular.
    """
    with pytest.raises(UsageError) as caught:
        run_edited(
            tmp_path,
            ('"plant.u" = "u.y"', '"plant.u" = "k.y"\n"k.u" = "plant.y"'),
            ("[connections]", '[components.k]\nkind = "gain"\nK = -1.0\n\n[connections]'),
        )
    cycle = re.search(r"no initial values for ((?:\S+ -> )+[^, ]+), which form", str(caught.value))
    assert cycle, caught.value
    assert set(cycle[1].split(" -> ")) == {"plant.y", "k.u", "k.y", "plant.u"}


NAN = float("nan")
TABLE = {"kind": "table", "y": [0.0, 1.0]}
CHANGES = [
    ({"obs.filter_rate": 1.0}, r"set\['obs.filter_rate'\]: .*component 'obs'; .*'observer'\?"),
    ({"observer.filter_rat": 1.0}, r"set\['observer\.filter_rat'\]: unknown key"),
    ({"scenario.threads": True}, r"set\['scenario\.threads'\]: expected a whole number, got True"),
    ({"scenario.threads": 3}, r"set\['scenario\.threads'\]: expected a number <= 2, got 3"),
    ({"filter_rate": 1.0}, r"set\['filter_rate'\]: expected COMPONENT\.PARAMETER, such as set="),
    ({"scenario": {"stop": 2.0}}, r"set\['scenario'\]: expected COMPONENT\.PARAMETER"),
    ({"plant.x_a0": [1.0]}, r"academic:30 \(with set\['plant\.x_a0'\]\): components\.plant: x_a0"),
    ({"scenario.stop": -1.0}, r"set\['scenario\.stop'\]: .*-1\.0 s"),
    ({"scenario.stop": 1e12}, r"set\['scenario\.stop'\]: 1000000000000\.0 s"),
    ({"scenario.step": 0.3}, r"set\['scenario\.step'\]: .*0\.3 s"),
    ({"u": {"kind": "step", "time": 1.0005}}, r"time: .*1\.0005 s.*nearest: 1\.0 s"),
    (
        {"components.d": {"kind": "delay", "delay": 1e9}},
        r"delay: .*communication steps of 1 values",
    ),
    (
        {"connections.plant.u": {"from": "u.y", "gain": [[1.0, 2.0], [3.0]]}},
        r"gain, .*lengths: .*1\.0, 2",
    ),
    (
        {"components.p": {"kind": "fmu", "path": "x.fmu", "start": {"T": [1.0, NAN]}}},
        r"T\[1\]: .*nan",
    ),
    ({"regressor.terms": []}, r"\A.*terms'\]: expected at least 1, got \[\]\Z"),
    ({"regressor.terms": [{"alpha": 2.0, "family": "sine"}]}, r"\A.*terms\[0\]\.alpha: .*2\.0\Z"),
    (
        {"regressor.terms": [{"family": "sine", "element": 64}]},
        r"terms\[0\]\.element: .*< 64, got 64",
    ),
    # beyond its ends a table has no value
    ({"u": {**TABLE, "t": [0.5, 50.0]}}, r"set\['u'\]: .*0\.0 s to 40\.0 s .*0\.5 s to"),
    ({"u": {**TABLE, "t": [0.0, 39.0]}}, r"set\['u'\]: .*0\.0 s to 40\.0 s .* 39\.0 s"),
]
SWAPS = [
    ({"plnt": "x.fmu"}, r"swap\['plnt'\]: unknown component 'plnt'; did you mean 'plant'\?"),
    ({"plant": "x.zip"}, r"swap\['plant'\]: expected .*\.fmu .*\.mcap .*\.csv.*got '.*x\.zip'"),
    ({"plant": "x.fmu#xy"}, r"swap\['plant'\]: expected '#me' .* or '#cs' .*, got '#xy'"),
    ({"plant": "missing.fmu"}, r"swap\['plant'\]: .*missing\.fmu"),
    ({"plant": "missing.mcap"}, r"swap\['plant'\]: .*missing\.mcap .*No such file"),
]


def test_a_bad_edit_names_the_edit():
    """What came from --set and --swap is not blamed on the file; nothing is rounded to the grid."""
    check_refused(CHANGES, lambda changes: cosim.run("academic", set=changes), ScenarioError)
    check_refused(SWAPS, lambda swap: cosim.run("academic", swap=swap), ScenarioError)


def test_a_scenario_that_is_not_there_is_refused(tmp_path):
    """A name that is no path and not shipped; a path that leads nowhere; no text."""
    with pytest.raises(ScenarioError, match=r"unknown scenario 'acedemic'.* mean 'academic'\?"):
        cosim.load("acedemic")
    with pytest.raises(ScenarioError, match=r"none\.toml: .*No such file or directory"):
        cosim.load(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_bytes(b"a = '\xff'")
    with pytest.raises(ScenarioError, match=r"a\.toml: is not UTF-8 text \(byte 5\)"):
        cosim.load(tmp_path / "a.toml")


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


def test_a_log_that_lacks_a_component_is_refused(tmp_path):
    """A recording can only stand for what it recorded."""
    path = tmp_path / "a.mcap"
    end = {"scenario.stop": 0.1}
    cosim.run("academic", out=path, set=end)
    with pytest.raises(ScenarioError, match=r"a\.mcap .*'plnat'; did you mean 'plant'\?"):
        cosim.run("academic", swap={"plant": path}, set={**end, "plant.component": "plnat"})


@pytest.mark.parametrize(
    ("alpha", "found"),
    [
        ("1/(t - 5)", "inf at t = 5 s"),
        ("1/(t - 4.015)", r"inf at t = 4\.015 s|off, most at t = 4\.01"),
        ("log(t - 1)", "nan at t = 0 s"),
    ],
)
def test_an_alpha_that_is_not_finite_is_refused_before_the_run(alpha, found):
    """With the instant, and without a warning of numpy; of the model and of the signal."""
    term = {"alpha": alpha, "family": "exponential"}
    coarse = {"scenario.step": 0.01, "scenario.stop": 10.0, "observer.filter_rate": 50.0}
    changes = [{"regressor.terms": [term], "regressor.delays": [0.5, 1.0]}]
    if "4.015" not in alpha:  # between two points
        changes.append({"delta.terms": [{**term, "theta": -0.4}]})
    for change in changes:
        with pytest.raises(UsageError, match=rf"{re.escape(alpha)}.*({found})|{found}"):
            cosim.run("academic-noisy", set=coarse | change)


def test_the_page_lists_every_table_of_a_scenario():
    """And none that is a table of another file."""
    page = (Path(__file__).parents[3] / ".readme" / "scenario.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| `[")]
    listed = {name for row in rows for name in re.findall(r"\[(\w+)[\].]", row.split("|")[1])}
    assert listed == File.model_fields.keys()
