"""Designs are computed where a study is planned; what a member's values change is its own."""

import json
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.scenario.preparing import build_experiment
from cosim.scenario.running.execution import load
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members.designs import decode_designs, encode_designs
from cosim.studies.members.runner import open_runner
from tests.studies.members.common import common_designs
from tests.studies.members.sinks import Digest

SUBJECT = StudySubject("academic", set={"scenario.stop": 1.0})


def computed(changes):
    """Return the designs of a run of its own."""
    with ExitStack() as resources:
        experiment = build_experiment(load("academic").set(changes), resources, None)
        return experiment.graph.prepare(experiment.clock.step_ns).designs


def test_designs_of_one_member_are_stored_with_it():
    """Array by array: of another initial state that alone, of another theta nothing."""
    with open_runner(SUBJECT) as runner:
        same = runner.run(StudyMember(0))
        theta = runner.run(StudyMember(1, {"delta.terms[0].theta": -0.2}))
        state = runner.run(StudyMember(2, {"plant.x_a0": [0.5, 2.0]}))
        observer = runner.run(StudyMember(3, {"observer.L": [3.0, 0.5]}))
    assert same.designs == theta.designs == ""
    own = decode_designs(state.designs)
    assert {name: list(design) for name, design in own.items()} == {"plant": ["X0"]}
    assert own["plant"]["X0"].tolist() == [0.5, 2.0]
    own = decode_designs(observer.designs)
    needed = computed({"observer.L": [3.0, 0.5], "scenario.stop": 1.0})
    assert "plant" not in own
    assert own["observer"]["A"].tobytes() == needed["observer"]["A"].tobytes()


def test_designs_go_to_text_and_back_bit_for_bit():
    """Also empty arrays, and numbers that decimal digits do not have."""
    designs = {"a": {"A": np.array([[0.1, 1e-310]]), "b": np.zeros((0, 2))}, "c": {}}
    again = decode_designs(encode_designs(designs))
    assert list(again) == ["a"]
    for key, array in designs["a"].items():
        assert again["a"][key].shape == array.shape
        assert again["a"][key].tobytes() == array.tobytes()
    assert encode_designs({"c": {}}) == ""
    assert decode_designs("") == {}


def of_another_machine(text):
    """Return designs whose discretized matrices differ in the last bit."""
    designs = decode_designs(text)
    for design in designs.values():
        for key in design.keys() & {"Ad", "B0", "B1"}:
            design[key] = np.nextafter(design[key], 9.0)
    return encode_designs(designs)


@pytest.mark.slow
def test_a_machine_takes_the_designs_of_the_one_that_planned_the_study():
    """Those that a member's values do not change; and its metrics follow from them."""
    with open_runner(SUBJECT, sink_of=Digest) as runner:
        members = [
            StudyMember(0),
            StudyMember(1, {"plant.x_a0": [0.5, 2.0]}),
            StudyMember(2, {"observer.L": [3.0, 0.5]}),
        ]
        own = [runner.run(member) for member in members]
    planned = common_designs(SUBJECT)
    with open_runner(replace(SUBJECT, designs=planned), sink_of=Digest) as runner:
        same = [runner.run(member) for member in members]
    other = of_another_machine(planned)
    assert common_designs(replace(SUBJECT, designs=other)) == other
    with open_runner(replace(SUBJECT, designs=other), sink_of=Digest) as runner:
        others = [runner.run(member) for member in members]
        again = [runner.run(member) for member in members]
    assert [o.metrics for o in same] == [o.metrics for o in own]
    assert [o.designs for o in same] == [o.designs for o in own]
    assert [o.metrics for o in others] == [o.metrics for o in again]
    assert all(o.metrics != p.metrics for o, p in zip(others, own, strict=True))
    # of the initial state alone there is nothing else of its own there, either
    assert others[1].designs == own[1].designs


def test_designs_of_something_else_are_refused():
    """Before any member."""
    for text in ("no designs", json.dumps({"plant": "?"}), json.dumps([1])):
        with pytest.raises(UsageError, match=r"designs: expected"):
            open_runner(replace(SUBJECT, designs=text))
