"""An FMU that is ahead of the end of a run goes back, and its log with it."""

import pytest

import cosim
from cosim.log import open_log
from tests.fmi import eventful, lag
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import xml2

SCENARIO = """
[scenario]
name = "back"
stop = 2.0
step = 0.01
until = "{until}"

[components]
x = {{ kind = "fmu", path = "{path}", {options} }}
ramp = {{ kind = "ramp", slope = 1.0 }}
behind = {{ kind = "lag", time_constant = 0.3 }}

[connections]
"x.u" = "ramp.y"
"behind.u" = "ramp.y"
{connections}
"""


def logs(folder, path, until, options, connections=""):
    """Run to where the condition comes true, in blocks of several sizes; return the logs."""
    scenario = folder / "back.toml"
    scenario.write_text(
        SCENARIO.format(until=until, path=path, options=options, connections=connections)
    )
    found = []
    for block in (1, 7, 300, None):
        out = folder / f"{block}.mcap"
        found.append(cosim.run(scenario, out=out, force=True, block=block))
    return found


def texts(log):
    """Return what the FMU and the run say, but of the memory for copies of the FMU's state."""
    messages = [m for m in log.messages() if m.source in ("x", "run")]
    return [tuple(message) for message in messages if "allocated a state" not in message.text]


def assert_alike(found, steps):
    """Compare the rows and the messages of logs."""
    for log in found:
        assert log.steps == steps
        assert log.content_hash() == found[0].content_hash()
        assert texts(log) == texts(found[0])


def test_a_co_simulation_fmu_logs_no_step_behind_the_end(tmp_path):
    """It logs where each of its steps begins; that which begins at the last row is none of them."""
    path = compile_fmu(tmp_path / "model.fmu", xml2(), "probe2.c", defines=("SAYS",))
    found = logs(tmp_path, path, "behind.y > 0.5", 'interface_type = "cs"')
    steps = found[0].steps
    assert_alike(found, steps)
    begins = [time_ns for time_ns, _, _, text in texts(found[0]) if text.startswith("step: ")]
    assert begins == [10**7 * k for k in range(steps)]


@pytest.mark.fast("rk4")
@pytest.mark.parametrize("solver", ["rk4", "RK45", "BDF", "CVode"])
def test_a_model_exchange_fmu_has_the_events_up_to_the_end(tmp_path, solver):
    """Those of the last row among them, and each once; CVode, which cannot be copied, as well."""
    options = f'solver = "{solver}", start = {{ p = 0.05 }}'
    found = logs(tmp_path, eventful.build("SAW"), "t >= 0.52", options, '"x.d" = "ramp.y"')
    assert_alike(found, 52)
    events = [time_ns for time_ns, _, _, text in texts(found[0]) if "time event" in text]
    assert events == [5 * 10**7 * k for k in range(1, 11)]
    warned = [text for _, level, _, text in texts(found[0]) if level == "warning"]
    assert any("single steps" in text for text in warned) == (solver == "CVode")


def test_rows_after_the_end_of_a_run_are_not_in_the_log(tmp_path):
    """An inner step of 0.1 s in steps of 10 ms shows at the 10th spell of equal outputs, 1 s."""
    path = lag.able(lag.build(tmp_path, "2"), tmp_path / "able.fmu", "2", "state", "any step")
    options = 'interface_type = "cs", start = { inner = 0.1 }'
    for end, is_shown in ((0.99, False), (1.05, True)):
        found = logs(tmp_path, path, f"t >= {end}", options, '"x.d" = "ramp.y"')
        assert_alike(found, round(100 * end))
        shown = [text for *_, text in texts(found[0]) if "inner step" in text]
        assert len(shown) == is_shown


def test_an_fmu_that_cannot_go_back_takes_single_steps(tmp_path):
    """The result is the same, and a warning says so."""
    path = eventful.build("SAW", saves=False)
    found = logs(tmp_path, path, "t >= 0.5", "start = { p = 0.05 }", '"x.d" = "ramp.y"')
    assert_alike(found, 50)
    assert any("single steps" in text for *_, text in texts(open_log(found[0].path)))
