"""Members whose FMUs crash, hang or end their process, run as a study runs them."""

import pytest

from cosim.studies.contracts import FAILED, StudyMember, StudySubject
from cosim.studies.workers.pool import WorkerPool
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

SCENARIO = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
plant = { kind = "fmu", path = "GOOD.fmu" }
"""
REASONS = {
    "CRASH": "crashes: SIGSEGV",
    "EXITS": "ends the process with exit code 3",
    "HANG": "hangs: did not end within 6 s",
    "FAILS_STEP": "fmi2DoStep returned 3 (error)",
}


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_each_bad_fmu_costs_the_members_that_have_it(tmp_path, capfd):
    """All others are completed, with the same metrics; what FMUs print is not seen."""
    compile_fmu(tmp_path / "GOOD.fmu", STATELESS, "rogue2.c", defines=("ROGUE=LIES",))
    for name in ("LOUD", *REASONS):
        compile_fmu(tmp_path / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",))
    scenario = tmp_path / "x.toml"
    scenario.write_text(SCENARIO)
    bad = dict(zip((3, 5, 11, 12), REASONS, strict=True))
    members = []
    for number in range(20):
        fmu = tmp_path / f"{bad.get(number, 'LOUD' if number == 8 else 'GOOD')}.fmu"
        members.append(StudyMember(number, swap={"plant": str(fmu)}))
    subject = StudySubject(str(scenario), metrics={"y": "last(plant.y)"})
    opener = "cosim.studies.members.runner:open_runner"
    with WorkerPool(opener, subject, 2, timeout=6.0) as pool:
        outcomes = [outcome for _, outcome in pool.run(members)]
    failures = {o.number: o.reason for o in outcomes if o.status == FAILED}
    assert sorted(outcome.number for outcome in outcomes) == list(range(20))
    assert failures.keys() == bad.keys()
    for number, name in bad.items():  # what is found within a run says where, too
        assert failures[number].rpartition(".fmu: ")[2] == REASONS[name]
    assert len({o.metrics["y"] for o in outcomes if o.status != FAILED}) == 1
    assert capfd.readouterr() == ("", "")
