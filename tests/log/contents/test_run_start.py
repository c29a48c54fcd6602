"""Where the rows of a run begin is the start time, or that of the span that a replay recorded."""

from cosim.log.metadata import recorded_start_ns


def test_the_start_is_read_from_the_record_of_the_run():
    """None where that is nothing, or no time."""
    starts = [
        ({"start_time": "0.25"}, 250_000_000),
        ({"start_time": "0.25", "replay": '{"window": null}'}, 250_000_000),
        ({"start_time": "0.25", "replay": '{"window": [6.1, 7.0]}'}, 6_100_000_000),
        ({"start_time": "0.25", "replay": '{"window": [0.0, 7.0]}'}, 0),
        ({}, None),
        ({"start_time": "soon"}, None),
        ({"start_time": "inf"}, None),
        ({"start_time": "0.0", "replay": "[]"}, None),
        ({"start_time": "0.0", "replay": '{"window": {"a": 1}}'}, None),
        ({"start_time": "0.0", "replay": '{"window": [[]]}'}, None),
        ({"start_time": "0.0", "replay": '{"window": 5}'}, None),
    ]
    found = [(run, recorded_start_ns({"cosim.run": run})) for run, _ in starts]
    assert found == starts
    assert recorded_start_ns({}) is None
