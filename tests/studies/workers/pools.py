"""Pools of workers that do what their members say."""

from cosim.studies.contracts import COMPLETE, FAILED, StudyMember, StudySubject
from cosim.studies.workers.pool import WorkerPool

RUNNERS = "tests.studies.workers.runners"


def doing(number, does="nothing", **more):
    """Return a member that does something."""
    return StudyMember(number, set={"does": does, **more})


def open_pool(count=2, opener="open_doing", scenario="a.toml", subject=None, **options):
    """Return a pool of workers with a runner of the tests."""
    subject = StudySubject(scenario, set=subject or {})
    return WorkerPool(f"{RUNNERS}:{opener}", subject, count, **options)


def outcomes_of(members, count=2, **options):
    """Run members; return outcomes by number, each of which comes once."""
    with open_pool(count, **options) as workers:
        results = list(workers.run(members))
    by_number = {outcome.number: outcome for _, outcome in results}
    assert len(by_number) == len(results)
    assert [member.number for member, _ in results] == list(by_number)
    return by_number


def failures(outcomes):
    """Return the reasons of those that failed."""
    assert {outcome.status for outcome in outcomes.values()} <= {COMPLETE, FAILED}
    return {
        number: outcome.reason for number, outcome in outcomes.items() if outcome.status == FAILED
    }
