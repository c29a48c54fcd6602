"""Members read what expressions in t were before, and have the bits of a run alone."""

import ctypes

import pytest

import cosim
from cosim.native.numerics import program_cache
from cosim.native.numerics.program_cache import ProgramCaches
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members.runner import open_runner
from tests.studies.members.sinks import Digest

ACADEMIC = {"scenario.stop": 4.0, "scenario.step": 4e-3, "identifier.period": 1.0}
MEMBERS = [
    {"plant.x_a0": [1.5, -1.0]},
    {"plant.x_a0": [2.5, 0.0]},
    {"delta.terms[0].theta": -0.2},
    {"u.rate": 2.0},
    {"u.rate": 1.0},
    {},
]


@pytest.fixture
def connected(monkeypatch):
    """Return all caches that a runner connects, by the component."""
    caches = {}
    connect = ProgramCaches.connect

    def noted(self, component, step):
        connect(self, component, step)
        programs = list(program_cache._programs(step))
        caches[component] = [program.cache.contents for program in programs if program.cache]

    monkeypatch.setattr(ProgramCaches, "connect", noted)
    return caches


@pytest.mark.slow
def test_members_have_their_own_bits_whatever_was_kept_before(connected):
    subject = StudySubject("academic", set=ACADEMIC)
    with open_runner(subject, sink_of=Digest) as runner:
        for number, changes in enumerate(MEMBERS):
            outcome = runner.run(StudyMember(number, changes))
            alone = cosim.run("academic", set={**ACADEMIC, **changes}, recorder=Digest())
            assert outcome.metrics == alone.values()
            assert outcome.status == "complete"
    assert connected["u"] == connected["delta"] == []
    assert connected["regressor"]
    for cache in connected["regressor"]:
        assert cache.next == cache.count > 750


def test_the_next_member_reads_what_is_kept(connected):
    subject = StudySubject("academic", set=ACADEMIC, metrics={"end": "last(u.y)"})
    with open_runner(subject) as runner:
        runner.run(StudyMember(0, MEMBERS[0]))
        (cache,) = connected["u"]
        values = (ctypes.c_double * cache.count).from_address(cache.values)
        values[-1] = 0.5
        assert runner.run(StudyMember(1, MEMBERS[1])).metrics == {"end": 0.5}
