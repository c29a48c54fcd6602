"""What the workers of a cluster are told of a study."""

import hashlib

from cosim.studies.cluster.cluster_study import ClusterStudy
from cosim.studies.cluster.opening import OPENER, TRIAL
from cosim.studies.contracts import StudyMember, StudySubject

SCENARIO = """
scenario = {{ name = "x", stop = 0.1, step = 0.01 }}
[components]
plant = {{ kind = "fmu", path = "{fmu}" }}
"""
FIRST = StudyMember(7, {"plant.rate": 2.0}, {"plant": "b.fmu"}, "field.mcap", designs="{}")
PLAIN = {str, bool, int, float, bytes, type(None), dict, list, tuple}


def planned(scenario, files, place="logs/study"):
    """Return the study of a scenario."""
    subject = StudySubject(str(scenario), {"scenario.step": 0.02}, replay_designs=[("a", "{}")])
    return ClusterStudy.planned(
        subject, FIRST, files=files, timeout=2.5, place=place, sha256="0" * 64, opener=OPENER
    )


def kinds(value):
    """Return the types of what is in a value."""
    match value:
        case dict():
            return set().union({dict}, *map(kinds, value.keys()), *map(kinds, value.values()))
        case list() | tuple():
            return set().union({type(value)}, *map(kinds, value))
    return {type(value)}


def digest_of(path):
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_workers_are_told_plain_values_alone(tmp_path):
    """And make the same study of them."""
    scenario = tmp_path / "a.toml"
    scenario.write_text(SCENARIO.format(fmu=tmp_path / "a.fmu"))
    files = {str(scenario): digest_of(scenario), str(tmp_path / "a.fmu"): "1" * 64}
    study = planned(scenario, files)
    content = study.to_dict()
    assert kinds(content) <= PLAIN
    assert ClusterStudy.from_dict(content) == study


def test_the_member_that_is_tried_has_the_values_of_the_first(tmp_path):
    """It has a number of its own, and what was designed for the first is computed."""
    study = planned(tmp_path / "a.toml", {})
    assert study.trial == StudyMember(TRIAL, FIRST.set, FIRST.swap, FIRST.recording)


def test_no_two_studies_have_one_name_or_one_probe(tmp_path):
    """They may run on the same workers, and write into the same folder."""
    studies = [planned(tmp_path / "a.toml", {}) for _ in range(20)]
    assert len({study.name for study in studies}) == 20
    assert len({study.probe.name for study in studies}) == 20
    assert len({study.probe.content for study in studies}) == 20


def test_a_place_is_absolute(tmp_path, monkeypatch):
    """A worker has a working directory of its own; the URL of a bucket is the same everywhere."""
    monkeypatch.chdir(tmp_path)
    assert planned("a.toml", {}).place == str(tmp_path / "logs" / "study")
    bucket = "s3://bucket/study"
    assert planned("a.toml", {}, place=bucket).place == bucket


def test_a_scenario_behind_a_link_is_the_file_that_is_sent(tmp_path):
    """With what it names by absolute paths; one that is not sent is left as it is."""
    scenario = tmp_path / "real.toml"
    scenario.write_text(SCENARIO.format(fmu=tmp_path / "a.fmu"))
    link = tmp_path / "link.toml"
    link.symlink_to(scenario)
    files = {str(scenario): digest_of(scenario), str(tmp_path / "a.fmu"): "1" * 64}
    study = planned(link, files)
    assert study.subject.scenario == str(scenario)
    assert study.named == {str(tmp_path / "a.fmu"): str(tmp_path / "a.fmu")}
    unsent = planned(link, {})
    assert unsent.subject.scenario == str(link)
    assert unsent.named == {}
