"""Runs that do not start at 0: every time is absolute, and nothing else changes."""

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.errors import CosimError, ScenarioError
from cosim.scenario.exporting import export_component
from tests.scenario.refusals import check_refused

START = 16.0


def shifted(start, **more):
    """Return closed-loop with every source shifted by ``start``, as changes."""
    alphas = [
        f"1.35 + 0.25*sin(1.7*(t - {start}))",
        f"1.10 + 0.20*cos(2.3*(t - {start}))",
    ]
    delta = f"({alphas[0]})*exp(-0.1*(t - {start})) + ({alphas[1]})*exp(-0.3*(t - {start}))"
    terms = [{"alpha": alpha, "family": "exponential"} for alpha in alphas]
    return {
        "scenario.stop": start + 1.0,
        "scenario.start_time": start,
        "reference": {"kind": "expression", "y": f"sin(t - {start})"},
        "delta": {"kind": "expression", "y": delta},
        "regressor.terms": terms,
        "regressor.delays": [0.1, 0.2, 0.3],
        "identifier.start": start + 0.4,
        "identifier.period": 0.1,
        "controller.period": 0.01,
        **more,
    }


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the logs of one experiment that starts at 0, and at ``START``."""
    folder = tmp_path_factory.mktemp("logs")
    found = {}
    for start in (0.0, START):
        path = folder / f"{start:g}.mcap"
        found[start] = cosim.run("closed-loop", set=shifted(start), out=path)
    return found


def test_an_experiment_does_not_depend_on_when_it_starts(logs):
    """With its sources shifted too, every row is that of the run from 0.

    The doubles t are 16 spacings of 1 coarser: 3.6e-15 s, on slopes of at most 1e3 (the filter).
    """
    first = logs[0.0]
    later = logs[START]
    for name, channel in first.channels.items():
        assert (later.time_ns(name) == first.time_ns(name) + 16 * 10**9).all()
        for signal in channel.signals:
            port = f"{name}.{signal.name}"
            if name == "identifier" and signal.role == "estimate":
                # 0.6 s do not determine it well; when it begins to have a value is what counts
                assert (np.isnan(first[port]) == np.isnan(later[port])).all()
            else:
                np.testing.assert_allclose(later[port], first[port], rtol=1e-9, atol=1e-9)


def test_the_log_has_simulation_time(logs):
    """``log_time`` is absolute, ``sequence`` counts the steps of the run; a replay has both."""
    log = logs[START]
    with open(log.path, "rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages()]
    assert min(message.log_time for message in messages) == 16 * 10**9
    for message in messages:
        assert message.log_time == 16 * 10**9 + message.sequence * 10**6
    assert log.end_ns == 17 * 10**9
    assert log.steps == 1000
    assert cosim.diff(log, cosim.replay(log)).equal
    part = cosim.replay(log, set={"scenario.stop": 16.5})
    assert part.time("plant")[[0, -1]].tolist() == [16.0, 16.5]


@pytest.mark.usefixtures("without_verdicts")
def test_an_fmu_starts_there(tmp_path, logs):
    """FMI's start time is that of the run; the comparison before it starts there as well."""
    path = tmp_path / "plant.fmu"
    export_component("closed-loop", "plant", path, fmi="2", platforms=[], force=False, dae=False)
    for interface_type in ("me", "cs"):
        swap = {"plant": f"{path}#{interface_type}"}
        swapped = cosim.run("closed-loop", set=shifted(START), swap=swap)
        np.testing.assert_allclose(swapped["plant.y"], logs[START]["plant.y"], atol=1e-9)


def swapped_for_log(log, start, stop):
    """Run with the recorded plant of a log, from ``start`` to ``stop``."""
    changes = shifted(START, **{"identifier.start": start + 0.3})
    changes |= {"scenario.start_time": start, "scenario.stop": stop}
    return cosim.run("closed-loop", swap={"plant": str(log.path)}, set=changes)


@pytest.mark.usefixtures("without_verdicts")
def test_a_recorded_component_needs_rows_where_the_run_has_points(logs):
    """A log of a later start can stand in from there on, at its own communication points."""
    log = logs[START]
    swapped = swapped_for_log(log, 16.5, 17.0)
    assert (swapped["plant.y"] == log["plant.y"][500:]).all()
    covers = r"15\.0 s to 17\.0 s .*16\.0 s to 17\.0 s"
    with pytest.raises(ScenarioError, match=covers):
        swapped_for_log(log, 15.0, 17.0)
    with pytest.raises(ScenarioError, match=r"\.mcap.* start_time, 16\.0005 s, got .* 16\.0 s"):
        swapped_for_log(log, 16.0005, 16.9995)


UNFIT = [
    ({"start_time": -1.0}, r"scenario\.start_time'?\]?: .*>= 0 s, got -1\.0 s"),
    ({"start_time": 1.5e-9}, r"scenario\.start_time'?\]?: 1\.5e-09 s is not a whole number of"),
    ({"start_time": 20.0}, r"scenario\.stop'?\]?: .* start_time = 20\.0 s, got 20\.0 s"),
    ({"start_time": 0.0005}, r"stop: 20\.0 s is not .* nearest: (20\.0005|19\.9995) s"),
]


def test_a_start_that_does_not_fit_is_refused():
    """With the key, what was found and what was needed."""

    def run(changes):
        cosim.run("closed-loop", set={f"scenario.{key}": v for key, v in changes.items()})

    check_refused(UNFIT, run, ScenarioError)


def test_an_identifier_cannot_begin_before_its_regressor_has_a_value():
    """The longest delay counts from the start of the run, and a given time is absolute."""
    cosim.run("closed-loop", set=shifted(START, **{"identifier.start": 16.3}))
    with pytest.raises(CosimError, match=r"longest delay, 0\.3 s, got 16\.2995 s"):
        cosim.run("closed-loop", set=shifted(START, **{"identifier.start": 16.2995}))
