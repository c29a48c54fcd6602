"""A member that runs again for its log has the designs that are recorded with it."""

from dataclasses import replace
from functools import partial

import numpy as np

import cosim
from cosim.log import Log
from cosim.studies.contracts import StudyMember
from cosim.studies.study_file import read_study
from cosim.studies.members.designs import decode_designs, encode_designs
from cosim.studies.members.inspector import MemberInspector
from cosim.studies.members.runner import open_runner
from cosim.studies.running.keeping import keep_logs
from cosim.studies.plan import plan_study
from cosim.studies.studying import open_dataset

STUDY = """
[scenario]
name = "filtered"
stop = 0.5
step = 0.01
[components]
u = { kind = "sine", amplitude = 1.0, rate = 3.0 }
filter = { kind = "controller", A = [[-0.9]], B = [[0.5]], C = [[3.0]], x0 = [1.0] }
[connections]
"filter.u" = "u.y"
[study]
[study.vary]
"filter.A[0][0]" = [-0.9, -2.0]
[study.metrics]
last = "last(filter.y)"
"""


def test_logs_have_the_designs_that_are_recorded(tmp_path):
    """A member of another machine comes to the same here: nothing is to be said of it."""
    path = tmp_path / "filtered.toml"
    path.write_text(STUDY)
    plan = plan_study(read_study(path).with_options(keep="all"))
    with open_runner(plan.subject) as runner:
        designs = decode_designs(runner.run(plan.design.member(1)).designs)
        designs["filter"]["Ad"] = np.nextafter(designs["filter"]["Ad"], 9.0)
        members = [plan.design.member(0), plan.design.member(1)]
        elsewhere = encode_designs(designs)
        outcomes = [
            runner.run(members[0]),
            runner.run(replace(members[1], designs=elsewhere)),
        ]
    notices = []
    with open_dataset(plan, tmp_path / "out", new=False) as dataset:
        for member, outcome in zip(members, outcomes, strict=True):
            dataset.add(member, outcome)
        keep_logs(plan, dataset, workers=1, notice=notices.append)
    assert notices == []
    log = Log(tmp_path / "out" / "logs" / "1.mcap")
    for key, array in designs["filter"].items():
        assert log.designs["filter"][key].tobytes() == array.tobytes()
    assert outcomes[1].metrics["last"] == log["filter.y"][-1]


def test_designs_of_replays_are_planned(tmp_path):
    """Of each log, what all members change; what they share is not stored with each."""
    path = tmp_path / "filtered.toml"
    path.write_text(STUDY.split("[study]")[0])
    logs = []
    for number in range(2):
        logs.append(str(tmp_path / f"{number}.mcap"))
        cosim.run(path, out=logs[-1], set={"u.rate": 3.0 + number})
    options = {
        "replay": logs,
        "set": {"filter.B": [[0.25]]},
        "vary": {"filter.x0[0]": [1.0, 2.0]},
        "metrics": {"last": "last(filter.y)"},
    }
    plan = plan_study(read_study(path).with_options(**options))
    assert [place for place, _ in plan.subject.replay_designs] == logs
    for _, text in plan.subject.replay_designs:
        designs = decode_designs(text)
        assert list(designs) == ["filter"]
        assert designs["filter"]["B"].tolist() == [[0.25]]
    study = cosim.study(path, **options, out=tmp_path / "out", workers=1)
    for text in study.table(["designs"])["designs"].to_pylist():
        own = decode_designs(text or "")
        assert [list(design) for design in own.values()] in ([], [["X0"]])


def scaled(text):
    """Return designs that another machine might have computed."""
    designs = decode_designs(text)
    for design in designs.values():
        for key in design:
            design[key] = design[key] * (1.0 + 2.0**-30)
    return encode_designs(designs)


def test_a_study_goes_on_with_the_designs_that_it_was_begun_with(tmp_path, monkeypatch):
    """Wherever that was: all members have the same, those of a tuning too."""
    path = tmp_path / "filtered.toml"
    path.write_text(STUDY)
    run = partial(cosim.study, path, out=tmp_path / "out", workers=1)
    search = partial(
        cosim.tune,
        path,
        minimize="last(filter.y)",
        vary={"filter.x0[0]": {"linear": [0.0, 1.0]}},
        out=tmp_path / "tuned",
        workers=1,
    )
    computed = MemberInspector._designs
    monkeypatch.setattr(MemberInspector, "_designs", lambda *given: scaled(computed(*given)))
    begun = plan_study(read_study(path)).subject
    values = [1.0, 2.0]
    run(vary={"filter.x0[0]": values[:1], "filter.A[0][0]": [-0.9]})
    search(members=2)
    monkeypatch.undo()
    assert plan_study(read_study(path)).subject.designs != begun.designs
    found = run(vary={"filter.x0[0]": values, "filter.A[0][0]": [-0.9]})
    tuned = search(members=4)
    with open_runner(begun) as runner:
        for number, value in enumerate(values):
            alone = runner.run(StudyMember(0, {"filter.x0[0]": value, "filter.A[0][0]": -0.9}))
            assert found.table(["last"])["last"][number].as_py() == alone.metrics["last"]
        for trial in tuned.trials:
            outcome = runner.run(StudyMember(0, trial.point))
            assert trial.objective == outcome.metrics["last"]
