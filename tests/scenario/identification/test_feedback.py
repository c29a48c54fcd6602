"""Which inputs of an observer carry the noise of its y: those that the loop's connections close."""

import pytest

import cosim
from cosim.scenario.running.identifying import identifier_record


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
