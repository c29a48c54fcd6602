"""Which inputs of an observer carry the noise of its y: those that the loop's connections close."""

from contextlib import ExitStack

import pytest

import cosim
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds.identified_plant import inputs_in_feedback
from cosim.scenario.running.execution import load
from cosim.scenario.running.identifying import identifier_record


@pytest.mark.parametrize(("scenario", "closed"), [("academic", False), ("closed-loop", True)])
def test_the_connections_say_whether_a_loop_is_closed(scenario, closed):
    """By the observer's estimate, a gain, a sum and a controller; a sine drives the open one."""
    with ExitStack() as resources:
        graph = Builder(load(scenario), resources).experiment().graph
        assert inputs_in_feedback(graph, "observer").tolist() == [closed]


@pytest.mark.parametrize(
    ("scenario", "options", "closed"),
    [
        ("closed-loop", {}, True),
        ("academic", {"identifier.closed_loop": True}, True),
        ("academic", {}, False),
    ],
)
@pytest.mark.usefixtures("without_verdicts")
def test_the_data_of_an_identifier_say_so(scenario, options, closed):
    """By the connections, or as the identifier states of a recording."""
    memory = cosim.run(scenario, set={"scenario.stop": 1.0, **options})
    assert identifier_record(memory).data.is_in_feedback.tolist() == [closed]
