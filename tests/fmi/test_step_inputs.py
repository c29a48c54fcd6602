"""What a co-simulation FMU without input derivatives gets as an input over a step.

It takes one value. The mean of both ends is one of the signal's only where that is continuous by
construction; what another FMU or a component in Python may do inside of a step nobody knows, so
that there it is the latest value known, as in FMI 2.0 (4.1.1): nothing is used that nobody sent.
"""

from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.blocks.arithmetic import switch
from cosim.blocks.source import Expression, step
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.errors import UsageError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.report.verification import verify
from tests.core.parts import InPython, integrator, through, times
from tests.fmi import small
from tests.fmi.small import USED
from tests.log.crafting import put_together, take_apart

JUMP = {"KIND": 3.0}
H = 0.1


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return small.compiled(tmp_path_factory.mktemp("small"))


@pytest.fixture
def opened(fmu, tmp_path):
    """Return a function that opens a small FMU: what it can, start values."""
    fmus = []

    def component(*can, **values):
        path = small.able(fmu, tmp_path / f"{len(fmus)}.fmu", *can, **values)
        fmus.append(load(path, FmuOptions(interface_type="cs", start=values)))
        return fmus[-1].component

    yield component
    for each in fmus:
        each.close()


def recorded(components, connections, **options):
    """Return the record of a run of a second."""
    memory = Memory()
    run(Graph(components, connections, **options), Clock(1.0, H), memory)
    return memory


@pytest.mark.parametrize("native", [True, False])
def test_a_jump_of_another_fmu_is_used_as_it_was_sent(opened, native):
    """y jumps from 1 to 5, and used = u is 1 or 5, what the log has of u: never 3."""
    parts = {"a": opened(**JUMP), "b": opened(**USED)}
    log = recorded(parts, {"b.u": "a.y"}, native=native)
    assert set(log["b.y"].tolist()) == {1.0, 5.0}
    assert log["b.y"].tolist() == log["b.u"].tolist() == log["a.y"].tolist()


@pytest.mark.parametrize(
    "options",
    [
        {"input_interpolation": "linear"},
        {"coupling": "newton"},
        {"substeps": SubstepTolerance(rtol=1e-3, atol=1e-3, min_ns=1000)},
    ],
    ids=["linear", "newton", "substeps"],
)
def test_the_mean_is_used_where_it_is_asked_for(opened, options):
    log = recorded({"a": opened(**JUMP), "b": opened(**USED)}, {"b.u": "a.y"}, **options)
    assert set(log["b.y"].tolist()) == {1.0, 3.0, 5.0}


def test_one_fmu_may_ask_for_the_mean(opened):
    parts = {"a": opened(**JUMP), "b": opened(**USED), "c": opened(**USED)}
    graph = Graph(parts, {"b.u": "a.y", "c.u": "a.y"}, means=["c"])
    memory = Memory()
    run(graph, Clock(1.0, H), memory)
    assert set(memory["b.y"].tolist()) == {1.0, 5.0}
    assert set(memory["c.y"].tolist()) == {1.0, 3.0, 5.0}
    assert graph.mean_inputs == {"c": ["u"]}


def test_what_is_continuous_by_construction_is_used_by_its_mean(opened):
    """Its integral over a step is right up to third order."""
    graph = Graph({"a": Expression(["t**2"]), "b": opened(**USED)}, {"b.u": "a.y"})
    memory = Memory()
    run(graph, Clock(1.0, H), memory)
    u = memory["b.u"]
    assert memory["b.y"][1:] == pytest.approx(0.5 * (u[1:] + u[:-1]), abs=1e-15)
    assert graph.mean_inputs == {"b": ["u"]}


@pytest.mark.parametrize("native", [True, False])
def test_a_jump_that_feeds_through_what_integrates_is_used_as_it_was_sent(opened, native):
    """y = x + u / 2 jumps by 2 where u jumps from 1 to 5: b uses no value between."""
    parts = {"a": opened(**JUMP), "part": through(0.5), "b": opened(**USED)}
    log = recorded(parts, {"part.u": "a.y", "b.u": "part.y"}, native=native)
    assert log["b.u"] - log["part.x"] == pytest.approx(0.5 * log["a.y"])
    assert log["b.y"].tolist() == log["b.u"].tolist()


@pytest.mark.parametrize("native", [True, False])
def test_a_switch_is_used_as_it_was_sent(opened, native):
    """Between two steps t passes 0.45, and y jumps from 1 to 5: never 3."""
    parts = {
        "t": Expression(["t"]),
        "numbers": Expression(["1", "5"]),
        "part": switch(threshold=0.45),
        "b": opened(**USED),
    }
    driving = {"part.u1": "numbers.y[1]", "part.u2": "numbers.y[0]", "part.control": "t.y"}
    log = recorded(parts, driving | {"b.u": "part.y"}, native=native)
    assert log["b.y"].tolist() == log["b.u"].tolist() == [1.0] * 5 + [5.0] * 6


def test_a_discrete_signal_that_feeds_through_is_used_by_its_mean_up_to_the_jump(opened):
    """Its value before the jump is known: no mean of both sides of it is used."""
    parts = {"a": step(time=0.5), "part": through(1.0), "b": opened(**USED)}
    log = recorded(parts, {"part.u": "a.y", "b.u": "part.y"})
    u, before = log["b.u"], log["part.x"] + np.array([0.0] * 6 + [1.0] * 5)
    assert log["b.y"][1:] == pytest.approx(0.5 * (u[:-1] + before[1:]), abs=1e-15)


@pytest.mark.parametrize("between", ["a static part", "a component in Python"])
def test_what_passes_a_jump_on_is_not_continuous_either(opened, between):
    """A gain behind the FMU, or an integrator that a user wrote, of which nothing is known."""
    part = times(2.0)
    if between != "a static part":
        part = InPython(integrator())
        part.interface = replace(part.interface, continuous=False)
    parts = {"a": opened(**JUMP), "part": part, "b": opened(**USED)}
    log = recorded(parts, {"part.u": "a.y", "b.u": "part.y"})
    assert log["b.y"].tolist() == log["b.u"].tolist() == log["part.y"].tolist()


def test_a_component_of_ours_behind_the_jump_is_continuous_again(opened):
    """It is integrated with its input on a line."""
    parts = {"a": opened(**JUMP), "part": integrator(), "b": opened(**USED)}
    log = recorded(parts, {"part.u": "a.y", "b.u": "part.y"})
    u = log["b.u"]
    assert log["b.y"][1:] == pytest.approx(0.5 * (u[1:] + u[:-1]), abs=1e-15)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_a_loop_gives_what_fmi_says(opened, coupling):
    """x' = -x + u, u of the other: by Jacobi both have u(t0), by Gauss-Seidel the second u(t1)."""
    pair = {"A": -1.0, "B": 1.0, "C": 1.0, "D": 0.0}
    parts = {"a": opened(**pair, x=1.0), "b": opened(**pair, x=-0.5)}
    log = recorded(parts, {"a.u": "b.y", "b.u": "a.y"}, coupling=coupling)
    kept = np.exp(-H)
    a, b = [1.0], [-0.5]
    for _ in range(10):
        a.append(kept * a[-1] + (1.0 - kept) * b[-1])
        u = a[-1] if coupling == "gauss-seidel" else a[-2]
        b.append(kept * b[-1] + (1.0 - kept) * u)
    assert log["a.x"] == pytest.approx(a, abs=1e-12)
    assert log["b.x"] == pytest.approx(b, abs=1e-12)


SCENARIO = """
scenario = {{ name = "jump", stop = 1.0, step = 0.1{setting} }}
[components]
a = {{ kind = "fmu", path = "a.fmu", start = {{ KIND = 3.0 }} }}
b = {{ kind = "fmu", path = "b.fmu", start = {{ A = -1.0, D = 1.0 }}{key} }}
[connections]
"b.u" = "a.y"
"""
LINEAR = ', input_interpolation = "linear"'


def ran(fmu, folder, *, setting="", key=""):
    """Return the log of a run of the scenario, written."""
    small.able(fmu, folder / "a.fmu", **JUMP)
    small.able(fmu, folder / "b.fmu", **USED)
    path = folder / "jump.toml"
    path.write_text(SCENARIO.format(setting=setting, key=key), encoding="utf-8")
    return cosim.run(path, out=folder / "jump.mcap", force=True)


@pytest.mark.parametrize("where", ["nowhere", "setting", "key"])
def test_a_log_has_what_was_set_or_says_that_means_were(fmu, tmp_path, where):
    """The key of an FMU does without a period."""
    log = ran(fmu, tmp_path, **({} if where == "nowhere" else {where: LINEAR}))
    asked = where != "nowhere"
    assert any("y lags inputs set to a mean" in each.text for each in log.warnings) == asked
    assert set(log["b.y"].tolist()) == ({1.0, 3.0, 5.0} if asked else {1.0, 5.0})
    lines = [m.text for m in log.messages() if m.source == "b" and "mean of both" in m.text]
    assert [line.startswith("every step sets u to the mean") for line in lines] == [True] * asked


def test_a_recording_of_an_fmu_is_no_more_continuous_than_the_fmu(fmu, tmp_path):
    """A reader has the same bits beside what was recorded of it."""
    log = ran(fmu, tmp_path)
    again = cosim.run(tmp_path / "jump.toml", swap={"a": str(tmp_path / "jump.mcap")})
    assert again["b.y"].tobytes() == log["b.y"].tobytes()


@pytest.mark.parametrize(
    "part",
    [
        'kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[0.0]], D = [[1.0]]',
        'kind = "sensor", resolution = 0.5',
    ],
    ids=["feeds through", "jumps"],
)
def test_a_recording_passes_on_what_was_recorded(fmu, tmp_path, part):
    """A controller behind a jump, and a sensor that rounds: in the run, and taken from its log."""
    small.able(fmu, tmp_path / "a.fmu", **JUMP)
    small.able(fmu, tmp_path / "b.fmu", **USED)
    path = tmp_path / "jump.toml"
    text = SCENARIO.format(setting="", key="").replace("[connections]", f"m = {{ {part} }}\n$&")
    text = text.replace("$&", '[connections]\n"m.u" = "a.y"').replace('"b.u" = "a', '"b.u" = "m')
    path.write_text(text, encoding="utf-8")
    log = cosim.run(path, out=tmp_path / "jump.mcap")
    again = cosim.run(path, swap={"m": str(tmp_path / "jump.mcap")})
    assert again["b.y"].tobytes() == log["b.y"].tobytes() == log["b.u"].tobytes()
    assert verify(log, cosim.replay(log, rerun=True, allow_code=True)).passed


def test_a_zero_order_hold_needs_a_period(fmu, tmp_path):
    with pytest.raises(UsageError, match=r"b.*input_interpolation: expected \"linear\""):
        ran(fmu, tmp_path, key=', input_interpolation = "zero-order"')


@pytest.mark.parametrize("key", ["", LINEAR])
def test_a_log_replays_with_the_same_values(fmu, tmp_path, key):
    """Run again and verified; also where the FMU that is read is taken from the log."""
    log = ran(fmu, tmp_path, key=key)
    again = cosim.replay(log, rerun=True, allow_code=True)
    assert again["b.y"].tobytes() == log["b.y"].tobytes()
    assert verify(log, again).passed


def test_a_log_that_does_not_tell_what_got_a_mean_replays_by_means(fmu, tmp_path):
    """As the runs of its version did, wherever an input moves."""
    log = ran(fmu, tmp_path)
    content = take_apart(log.path)
    for _, items in content.metadata:
        items.pop("means", None)
    old = cosim.open_log(put_together(content, tmp_path / "old.mcap"))
    again = cosim.replay(old, rerun=True, allow_code=True, out=tmp_path / "again.mcap")
    assert set(again["b.y"].tolist()) == {1.0, 3.0, 5.0}
    assert not verify(old, again).passed  # its run had the latest value: what is forged is found
    assert verify(again, cosim.replay(again, rerun=True, allow_code=True)).passed
