"""Designs that are given are taken wherever a member runs, and those that its values change not.

Those given here differ from what this machine computes by far more than machines do, so that a
member which takes others shows that.
"""

import json
from contextlib import ExitStack
from dataclasses import asdict, replace

import pytest

import cosim
from cosim.log import Log
from cosim.log.contents.metadata import decode_design
from cosim.scenario.actions.settings import SETTINGS, prepare_settings
from cosim.scenario.building.kept_build import KeptBuild
from cosim.scenario.preparing import build_experiment
from cosim.scenario.recordings.recording import run_rows
from cosim.scenario.running.execution import load
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members import member_builder
from cosim.studies.members.designs import decode_designs, encode_designs
from cosim.studies.members.inspector import DESIGNS, open_inspector
from cosim.studies.members.logging_runner import open_logging_runner, unfinished_name
from cosim.studies.members.runner import open_runner
from tests.studies.members.common import common_designs
from tests.studies.members.sinks import Digest

FILTERED = """
[scenario]
name = "filtered"
stop = 0.5
step = 0.01

[components]
u = { kind = "sine", amplitude = 1.0, rate = 3.0 }
plant = { kind = "lag", time_constant = 0.3, initial = 1.0 }
filter = { kind = "controller", A = [[-0.9]], B = [[0.5]], C = [[3.0]], x0 = [1.0] }

[connections]
"plant.u" = "u.y"
"filter.u" = "plant.y"
"""
LOOP = """
[connections]
"plant.u" = "filter.y"
"filter.u" = "plant.y"
"""
SET = """
[[actions]]
at = 0.2
set = { "plant.time_constant" = 0.6, "u.rate" = 4.0 }
"""
METRICS = {"last": "last(filter.y)", "mean": "mean(filter.y)"}
MEMBERS = {
    "plain": {},
    "built whole": {"scenario.stop": 0.4},
    "another step": {"scenario.step": 0.02},
    "its own plant": {"plant.time_constant": 0.2},
    "its own initial state": {"filter.x0": [2.0]},
    "its own filter, built whole": {"filter.B": [[0.25]], "scenario.stop": 0.4},
}


@pytest.fixture
def write(tmp_path):
    """Return what writes a scenario, and beside it samples that may take the place of a plant."""
    rows = [f"{0.01 * k:.2f},{1.0 + 0.1 * k}" for k in range(60)]
    for number in range(4):
        rows.append(f"0.{60 + number},{number}.0")  # other bytes, same rows of the run
        (tmp_path / f"{number}.csv").write_text("\n".join(["t,y", *rows]) + "\n")

    def write_scenario(text):
        path = tmp_path / "filtered.toml"
        path.write_text(text)
        return str(path)

    return write_scenario


def samples(path, number=0):
    """Return the swap of the plant by samples."""
    return {"plant": path.replace("filtered.toml", f"{number}.csv")}


def scaled(text, factor=1.0 + 2.0**-30):
    """Return other designs: those of a machine with a strange way to compute."""
    designs = decode_designs(text)
    for design in designs.values():
        for key in design:
            design[key] = design[key] * factor
    return encode_designs(designs)


def built(subject, member, resources):
    swaps = {**subject.swap, **member.swap}
    scenario = load(subject.scenario).edit(swap=swaps, set={**subject.set, **member.set})
    return build_experiment(scenario, resources, None)


def computed(experiment):
    """Return the designs that this machine computes for a run, those of settings by their names."""
    step_ns = experiment.clock.step_ns
    texts = prepare_settings(experiment.graph, step_ns, experiment.settings, {})
    settings = {name: decode_design(text) for name, text in texts.items()}
    return dict(experiment.graph.prepare(step_ns).designs), settings


def with_given(designs, common, given):
    """Return designs with those arrays that are given for what is the same in all members."""
    taken = {}
    for name, design in designs.items():
        taken[name] = dict(design)
        for key, array in design.items():
            if key in common.get(name, {}) and array.tobytes() == common[name][key].tobytes():
                taken[name][key] = given[name][key]
    return taken


def expected(subject, member):
    """Return the designs and the digest of a run that is given all its designs."""
    with ExitStack() as resources:
        base, base_settings = computed(built(replace(subject), StudyMember(0), resources))
    given = decode_designs(subject.designs)
    common = {**base, **base_settings}
    with ExitStack() as resources:
        experiment = built(subject, member, resources)
        designs, settings = (with_given(found, common, given) for found in computed(experiment))
        step_ns = experiment.clock.step_ns
        prepare_settings(experiment.graph, step_ns, experiment.settings, settings)
        plan = experiment.graph.prepare(step_ns, designs)
        digest = Digest()
        run_rows(digest, replace(experiment, plan=plan))
    return {**designs, **settings}, digest.values()["digest"]


def assert_same_designs(found, needed):
    assert {name for name, design in found.items() if design} == {
        name for name, design in needed.items() if design
    }
    for name, design in found.items():
        for key, array in design.items():
            assert array.tobytes() == needed[name][key].tobytes(), (name, key)


def assert_follows(subject, member):
    """Check that a member has the bits that follow from its designs, and says which are its own."""
    needed, digest = expected(subject, member)
    with open_runner(subject, sink_of=Digest) as runner:
        outcome = runner.run(member)
        again = runner.run(member)
    assert outcome.reason == ""
    assert outcome.metrics["digest"] == again.metrics["digest"] == digest
    given = decode_designs(subject.designs)
    own = {}
    for name, design in needed.items():
        for key, array in design.items():
            theirs = given.get(name, {}).get(key)
            if theirs is None or theirs.tobytes() != array.tobytes():
                own.setdefault(name, {})[key] = array
    assert outcome.designs == again.designs == encode_designs(own)
    return outcome


@pytest.mark.parametrize("text", [FILTERED, FILTERED.split("[connections]")[0] + LOOP])
@pytest.mark.parametrize("name", MEMBERS)
def test_given_designs_are_taken(write, name, text):
    """With and without a loop, whose gain is computed of them, and where results are asked for."""
    subject = StudySubject(write(text))
    subject = replace(subject, designs=scaled(common_designs(subject)))
    member = StudyMember(3, MEMBERS[name])
    plain = assert_follows(subject, member)
    with_results = assert_follows(replace(subject, with_results=True), member)
    assert with_results.designs == plain.designs


def test_given_designs_are_taken_by_members_with_swaps_of_their_own(write):
    """Also of members that are built as a whole, or replace what all members have swapped."""
    path = write(FILTERED)
    for swap in ({}, samples(path, 1)):
        subject = StudySubject(path, swap=swap)
        subject = replace(subject, designs=scaled(common_designs(subject)))
        for changes in ({}, {"filter.B": [[0.25]]}, {"scenario.stop": 0.4}):
            outcome = assert_follows(subject, StudyMember(0, changes, samples(path)))
            assert ("filter" in decode_designs(outcome.designs)) == ("filter.B" in changes)


def test_given_designs_of_what_actions_set_are_taken(write):
    """Their designs are made of values in the table of the action, not of the component."""
    subject = StudySubject(write(FILTERED + SET))
    subject = replace(subject, designs=scaled(common_designs(subject)))
    assert "200000000 plant" in decode_designs(subject.designs)
    assert assert_follows(subject, StudyMember(0)).designs == ""
    member = StudyMember(1, {"actions.0.set": {"plant.time_constant": 0.5}})
    own = decode_designs(assert_follows(subject, member).designs)
    assert list(own) == ["200000000 plant"]
    assert own["200000000 plant"]["A"].tolist() == [[-2.0]]


def logged(subject, member, folder):
    """Return the metrics and the log of a member that runs for its log."""
    with open_logging_runner(replace(subject, logs=str(folder))) as runner:
        outcome = runner.run(member)
    assert outcome.status == "complete"
    return outcome.metrics, Log(folder / unfinished_name(member.number))


@pytest.mark.parametrize("name", MEMBERS)
def test_given_designs_are_taken_where_a_member_runs_for_its_log(write, tmp_path, name):
    """And its own ones where it had others before: on another machine, then."""
    subject = StudySubject(write(FILTERED + SET), metrics=METRICS)
    subject = replace(subject, designs=scaled(common_designs(subject)))
    member = StudyMember(3, MEMBERS[name])
    with open_runner(subject) as runner:
        outcome = runner.run(member)
    metrics, log = logged(subject, member, tmp_path)
    assert metrics == outcome.metrics
    found = {**log.designs, **_settings(log)}
    needed, _ = expected(subject, member)
    assert_same_designs(found, needed)
    if not outcome.designs:
        return
    own = scaled(outcome.designs, 1.0 - 2.0**-30)
    elsewhere, log = logged(subject, replace(member, designs=own), tmp_path)
    assert elsewhere != metrics
    for name, design in decode_designs(own).items():
        needed[name] = {**needed[name], **design}
    assert_same_designs({**log.designs, **_settings(log)}, needed)
    with open_runner(subject) as runner:
        again = runner.run(replace(member, designs=own))
    assert again.metrics == elsewhere
    assert again.designs == own


def _settings(log):
    texts = log.metadata[SETTINGS]
    return {name: decode_design(text) for name, text in texts.items()}


@pytest.mark.slow
def test_outcomes_do_not_depend_on_how_many_builds_are_kept(write, monkeypatch):
    """Nor on what ran before; a build is made again where others were used since."""
    path = write(FILTERED)
    subject = StudySubject(path, metrics=METRICS)
    members = []
    for number in range(8):
        changes = {"plant.time_constant": 0.5} if number == 7 else {"filter.x0": [1.0 + number]}
        swap = {} if number == 7 else samples(path, number % 4)
        members.append(StudyMember(number, {} if number % 3 == 0 else changes, swap))
    found = set()
    builds = []
    build = KeptBuild.__init__

    def counted(kept, *arguments):
        builds.append(arguments[0])
        build(kept, *arguments)

    monkeypatch.setattr(KeptBuild, "__init__", counted)
    for most in (1, 2, 16):
        monkeypatch.setattr(member_builder, "MOST_BUILDS", most)
        for order in (members, members[::-1], members[1::2] + members[::2]):
            builds.clear()
            with open_runner(subject) as runner:
                outcomes = {member.number: runner.run(member) for member in order}
            texts = []
            for number in range(8):
                assert outcomes[number].status == "complete", outcomes[number].reason
                texts.append(asdict(replace(outcomes[number], wall_time=0.0)))
            found.add(json.dumps(texts))
            assert most < 4 or len(builds) == 5  # one without swaps, four with
    assert len(found) == 1


def test_given_designs_are_taken_by_replays(write, tmp_path):
    """What the log has stays; of what all members change its design is given, beside the log."""
    path = write(FILTERED + SET)
    log = str(tmp_path / "run.mcap")
    cosim.run(path, out=log)
    subject = StudySubject(path, metrics=METRICS, set={"filter.B": [[0.25]]})
    plain = StudyMember(0, recording=log)
    own = StudyMember(1, {"filter.x0": [2.0]}, recording=log)
    with open_runner(subject) as runner:  # nothing is given
        computed = [runner.run(member) for member in (plain, own)]
    with open_inspector(subject) as inspector:
        given = inspector.run(plain).details[DESIGNS]
    assert computed[0].designs == given
    assert list(decode_designs(given)) == ["filter"]
    same = replace(subject, replay_designs=[[log, given]])
    other = replace(subject, replay_designs=[[log, scaled(given)]])
    for used in (same, other):
        with open_runner(used) as runner:
            found = [runner.run(member) for member in (plain, own)]
        assert found[0].designs == ""
        assert list(decode_designs(found[1].designs)["filter"]) == ["X0"]
        is_same = [o.metrics == c.metrics for o, c in zip(found, computed, strict=True)]
        assert is_same == [used is same] * 2
        with open_runner(replace(used, with_results=True)) as runner:
            assert METRICS.keys() <= runner.run(own).metrics.keys()
        for member, outcome in zip((plain, own), found, strict=True):
            metrics, kept = logged(used, replace(member, designs=outcome.designs), tmp_path)
            assert metrics == outcome.metrics
            needed = decode_designs(used.replay_designs[0][1])["filter"]
            needed |= decode_designs(outcome.designs).get("filter", {})
            assert_same_designs({"filter": kept.designs["filter"]}, {"filter": needed})
            assert_same_designs(
                {"plant": kept.designs["plant"]}, {"plant": Log(log).designs["plant"]}
            )
