"""Study files, studies in scenarios, and options beside them."""

import json
import os
import re

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError, shell_language
from cosim.scenario.document.document import find
from cosim.studies.contracts import StudySubject
from cosim.studies.design import find_recordings
from cosim.studies.study_file import KeptLogs, StudyOptions, read_study
from cosim.studies.variations import GridVariation, SampledVariation

STUDY = """\
[study]
scenario = "academic"
sampling = "sobol"
samples = 64
seeds = 2
timeout = 30.0
keep = "worst 5 of error"
results = true
set = { "scenario.stop" = 1.0, plant = { x_a0 = [0.0, 1.0] } }
swap = { plant = "fmus/a.fmu#cs" }
map = { "plant.y" = "out" }
[vary]
"observer.filter_rate" = { log = [10.0, 1e4], points = 4 }
"delta.terms[0].theta" = { uniform = [-0.2, -0.1] }
identifier.P0 = [1e3, 1e6]
[metrics]
error = "rms(observer.delta - delta.y)"
"""
KEYS = ["observer.filter_rate", "delta.terms[0].theta", "identifier.P0"]
SET = {"scenario.stop": 1.0, "plant.x_a0": [0.0, 1.0]}
ACADEMIC = find("academic").text


@pytest.fixture
def write(tmp_path):
    def write(text, name="study.toml"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_a_file_says_all_of_a_study(write, tmp_path):
    """Settings, variations in their order, metrics; its tables make the same study again."""
    study = read_study(write(STUDY))
    assert (study.name, study.source) == ("study", str(tmp_path / "study.toml"))
    stated = {"sampling": "sobol", "samples": 64, "seeds": 2, "timeout": 30.0}
    stated["keep"] = KeptLogs("worst", 5, "error")
    assert stated.items() <= dict(study.settings).items()
    assert [item.key for item in study.variations] == KEYS
    assert study.grid[1] == GridVariation("identifier.P0", (1e3, 1e6))
    assert study.sampled == (SampledVariation("delta.terms[0].theta", "uniform", (-0.2, -0.1)),)
    swap = {"plant": str(tmp_path / "fmus" / "a.fmu#cs")}
    metrics = {"error": "rms(observer.delta - delta.y)"}
    subject = StudySubject("academic", SET, swap, {"plant.y": "out"}, metrics, with_results=True)
    assert study.subject == subject
    again = study.with_options(StudyOptions())
    assert again.to_dict() == json.loads(json.dumps(study.to_dict()))
    assert (again.settings, again.variations) == (study.settings, study.variations)


def test_a_scenario_may_have_its_study_inside(write):
    """The scenario runs as without, and the study is that of a file of its own, or an empty one."""
    empty = read_study(write(ACADEMIC, "mine.toml"))
    assert (empty.name, empty.variations, empty.subject.with_results) == ("academic", (), True)
    inside = STUDY.replace('scenario = "academic"\n', "")
    inside = inside.replace("[vary]", "[study.vary]").replace("[metrics]", "[study.metrics]")
    path = write(f"{ACADEMIC}\n{inside}", "mine.toml")
    study, own = read_study(path), read_study(write(STUDY))
    assert study.scenario == str(path)
    assert (study.variations, study.metrics) == (own.variations, own.metrics)
    end = {"scenario.stop": 0.01}
    assert cosim.diff(cosim.run(path, set=end), cosim.run("academic", set=end)).equal


def test_a_log_is_the_study_of_its_replay(write, tmp_path, monkeypatch):
    """By its path, or in the place of the scenario; other logs may take its place."""
    monkeypatch.chdir(tmp_path)
    path = str(tmp_path / "a.mcap")
    cosim.run("academic", set={"scenario.stop": 0.01}, out=path)
    for name in ("a.mcap", write('[study]\nscenario = "a.mcap"\n')):
        study = read_study(name)
        assert (study.scenario, find_recordings(study.settings.replay)) == (path, (path,))
    replaced = study.with_options(StudyOptions(replay="field-*.mcap"))
    assert replaced.settings.replay == str(tmp_path / "field-*.mcap")


def test_paths_begin_at_the_file_and_those_of_options_at_the_folder(write, tmp_path, monkeypatch):
    """A study can be read from anywhere."""
    path = write(
        '[study]\nscenario = "../mine.toml"\ncases = "c.csv"\nreplay = "field-*.mcap"\n'
        '[vary]\nplant = ["a.fmu", "../b.fmu#cs"]\n"swap.sensor" = { choice = ["c.fmu"] }\n',
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    study = read_study(path)
    paths = [study.scenario, study.settings.cases, study.settings.replay]
    paths += [value for item in study.variations for value in item.values]
    names = ["../mine.toml", "c.csv", "field-*.mcap", "a.fmu", "../b.fmu#cs", "c.fmu"]
    assert paths == [os.path.normpath(tmp_path / name) for name in names]
    assert [item.key for item in study.variations] == ["swap.plant", "swap.sensor"]
    changed = study.with_options(
        StudyOptions(vary={"plant": [["x.fmu"]]}, cases="d.csv", swap={"u": "u.fmu"})
    )
    x, d, u = (str(elsewhere / name) for name in ("x.fmu", "d.csv", "u.fmu"))
    assert changed.variations == (GridVariation("swap.plant", (x,)), study.variations[1])
    assert (changed.settings.cases, changed.settings.swap) == (d, {"u": u})


def test_options_extend_and_replace(write):
    """What is varied anew comes behind what the file varies; a wrong one is named as given."""
    study = read_study(write(STUDY)).with_options(
        StudyOptions(
            vary={"components.u.rate": np.array([1.0, 2.0]), "identifier.P0": {"values": [1.0]}},
            metrics={"last": "last(plant.y)"},
            set={"u.amplitude": np.float64(2.0)},
            map={"plant.x": ["a", "b"]},
            samples=10,
            keep=[3, 1, 1],
            results=False,
        )
    )
    assert [item.key for item in study.variations] == [*KEYS, "u.rate"]
    assert [item.values for item in study.grid[1:]] == [(1.0,), (1.0, 2.0)]
    assert (study.settings.sampling, study.settings.samples) == ("sobol", 10)
    assert study.settings.keep == KeptLogs("numbers", numbers=(1, 3))
    subject = study.subject
    assert (subject.set, [*subject.metrics]) == ({**SET, "u.amplitude": 2.0}, ["error", "last"])
    assert subject.map == {"plant.y": "out", "plant.x": ["a", "b"]}
    assert not subject.with_results
    for vary, message in (
        ({"u.rate": object()}, "u.rate: .*<object"),
        ({"u.x": [1], "components.u.x": [2]}, "components.u.x: .* 'u.x'"),
        ({"rate": [1]}, "rate: 0: .*got 1"),
    ):
        with shell_language(), pytest.raises(UsageError, match=f"--vary {message}"):
            study.with_options(StudyOptions(vary=vary))


WRONG = {  # behind "#: ", what the report says of a line
    "each entry": """\
[study]  #: study: 'scenario' is missing
samples = 0  #: study.samples: .*0
sampling = "sobl"  #: study.sampling: .*'sobl'; did you mean 'sobol'
keep = "faild"  #: study.keep: .*'faild'
[varry]  #: varry: .*did you mean 'vary'
[vary]
"u.rate" = { uniform = [2.0, 1.0] }  #: vary.u.rate.uniform:
observer.filter_rate = 3  #: vary.observer.filter_rate: .*got 3
u.amplitude.normal = [0.0, 0.0]  #: vary.u.amplitude.normal:
[metrics]
a = 3  #: metrics.a: .*3
""",
    "entries together": """\
[study]
scenario = "academic"
keep = "best 2 of eror"  #: study.keep: no metric 'eror'; did you mean 'error'
set = { "u.amplitude" = 3.0 }
[vary]
u.amplitude = [1.0]  #: vary.u.amplitude: it is varied
u.rate = [1.0]
"u.rate" = [2.0]  #: vary.u.rate: .*'u.rate'
[metrics]
error = "x"
""",
    "in a scenario": f"""{ACADEMIC}
[study]
scenario = 'x'  #: study.scenario: .*this file
vary.u.rate = {{ uniform = [1.0] }}  #: study.vary.u.rate.uniform:
metrics = 3  #: study.metrics: .*3
""",
}


@pytest.mark.parametrize("text", WRONG.values(), ids=WRONG)
def test_every_problem_of_a_file_is_in_one_report(write, text):
    """Each with its line, once."""
    path = write(text)
    with pytest.raises(UsageError) as caught:
        read_study(path)
    said = [(n, line) for n, line in enumerate(text.splitlines(), 1) if "#: " in line]
    expected = [rf"{path}:{n}: {line.partition('#: ')[2]}" for n, line in said]
    found = sorted(str(caught.value).splitlines(), key=lambda line: int(line.split(":")[1]))
    for line, problem in zip(found, expected, strict=True):
        assert re.match(problem, line), (problem, line)
