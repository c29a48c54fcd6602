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
from cosim.studies.study_file import KeptLogs, read_study
from cosim.studies.variations import GridVariation, SampledVariation

STUDY = """\
[study]
scenario = "academic"
sampling = "sobol"
samples = 64
seed = 7
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


@pytest.fixture
def write(tmp_path):
    def write(text, name="study.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_a_file_says_all_of_a_study(write, tmp_path):
    """Settings, variations in their order, metrics; its tables make the same study again."""
    study = read_study(write(STUDY))
    assert (study.name, study.source) == ("study", str(tmp_path / "study.toml"))
    settings = study.settings
    assert (settings.sampling, settings.samples, settings.seed) == ("sobol", 64, 7)
    assert (settings.seeds, settings.timeout) == (2, 30.0)
    assert study.settings.keep == KeptLogs("worst", 5, "error")
    assert [item.key for item in study.variations] == KEYS
    assert study.grid[1] == GridVariation("identifier.P0", (1e3, 1e6))
    assert study.sampled == (SampledVariation("delta.terms[0].theta", "uniform", (-0.2, -0.1)),)
    assert study.subject == StudySubject(
        "academic",
        set={"scenario.stop": 1.0, "plant.x_a0": [0.0, 1.0]},
        swap={"plant": str(tmp_path / "fmus" / "a.fmu#cs")},
        map={"plant.y": "out"},
        metrics={"error": "rms(observer.delta - delta.y)"},
        with_results=True,
    )
    assert study.with_options().to_dict() == json.loads(json.dumps(study.to_dict()))
    assert study.with_options().variations == study.variations


def test_a_scenario_may_have_its_study_inside(write):
    """The scenario runs as without, and the study is that of a file of its own, or an empty one."""
    empty = read_study(write(find("academic").text, "mine.toml"))
    assert (empty.name, empty.variations, empty.subject.with_results) == ("academic", (), True)
    inside = STUDY.replace('scenario = "academic"\n', "")
    inside = inside.replace("[vary]", "[study.vary]").replace("[metrics]", "[study.metrics]")
    path = write(f"{find('academic').text}\n{inside}", "mine.toml")
    study, own = read_study(path), read_study(write(STUDY))
    assert study.scenario == str(path)
    assert (study.variations, study.metrics) == (own.variations, own.metrics)
    end = {"scenario.stop": 0.01}
    assert cosim.diff(cosim.run(path, set=end), cosim.run("academic", set=end)).equal


def test_a_log_is_the_study_of_its_replay(write, tmp_path, monkeypatch):
    """By its path, or in the place of the scenario; other logs may take its place."""
    monkeypatch.chdir(tmp_path)
    cosim.run("academic", set={"scenario.stop": 0.01}, out="a.mcap")
    path = str(tmp_path / "a.mcap")
    for name in ("a.mcap", write('[study]\nscenario = "a.mcap"\n')):
        study = read_study(name)
        assert study.scenario == path
        assert find_recordings(study.settings.replay) == (path,)
    assert read_study("a.mcap").name == "academic"
    replaced = read_study("a.mcap").with_options(replay="field-*.mcap")
    assert replaced.settings.replay == str(tmp_path / "field-*.mcap")


def test_paths_begin_at_the_file_and_those_of_options_at_the_folder(write, tmp_path, monkeypatch):
    """A study can be read from anywhere."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    path = write(
        '[study]\nscenario = "../mine.toml"\ncases = "c.csv"\nreplay = "field-*.mcap"\n'
        '[vary]\nplant = ["a.fmu", "../b.fmu#cs"]\n"swap.sensor" = { choice = ["c.fmu"] }\n',
    )
    monkeypatch.chdir(elsewhere)
    study = read_study(path)
    paths = [study.scenario, study.settings.cases, study.settings.replay]
    paths += [value for item in study.variations for value in item.values]
    names = ["../mine.toml", "c.csv", "field-*.mcap", "a.fmu", "../b.fmu#cs", "c.fmu"]
    assert paths == [os.path.normpath(tmp_path / name) for name in names]
    assert [item.key for item in study.variations] == ["swap.plant", "swap.sensor"]
    changed = study.with_options(vary={"plant": [["x.fmu"]]}, cases="d.csv", swap={"u": "u.fmu"})
    assert changed.variations[0] == GridVariation("swap.plant", (str(elsewhere / "x.fmu"),))
    assert changed.settings.cases == str(elsewhere / "d.csv")
    assert changed.settings.swap == {"u": str(elsewhere / "u.fmu")}
    assert changed.variations[1] == study.variations[1]


def test_options_extend_and_replace(write):
    """What is varied anew comes behind what the file varies."""
    study = read_study(write(STUDY)).with_options(
        vary={"components.u.rate": np.array([1.0, 2.0]), "identifier.P0": {"values": [1.0]}},
        metrics={"last": "last(plant.y)"},
        set={"u.amplitude": np.float64(2.0)},
        map={"plant.x": ["a", "b"]},
        samples=10,
        keep=[3, 1, 1],
        results=False,
    )
    assert [item.key for item in study.variations] == [*KEYS, "u.rate"]
    assert [item.values for item in study.grid[1:]] == [(1.0,), (1.0, 2.0)]
    assert list(study.metrics) == ["error", "last"]
    settings = study.settings
    assert (settings.set["u.amplitude"], settings.set["scenario.stop"]) == (2.0, 1.0)
    assert settings.map == {"plant.y": "out", "plant.x": ["a", "b"]}
    assert (settings.sampling, settings.samples) == ("sobol", 10)
    assert study.settings.keep == KeptLogs("numbers", numbers=(1, 3))
    assert not study.subject.with_results


OF_ACADEMIC = '[study]\nscenario = "academic"\n'


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ("[study]\nsamples = 3\n", ["1: study: 'scenario' is missing"]),
        (
            f"{OF_ACADEMIC}[varry]\n[metrics]\na = 3\n",
            ["3: varry: .*did you mean 'vary'", "5: metrics.a: .*3"],
        ),
        (
            f'{OF_ACADEMIC}samples = 0\nsampling = "sobl"\nkeep = "faild"\n'
            '[vary]\n"u.rate" = { uniform = [2.0, 1.0] }\nobserver.filter_rate = 3\n'
            "u.amplitude.normal = [0.0, 0.0]\n",
            [
                "3: study.samples: .*0",
                "4: study.sampling: .*'sobl'; did you mean 'sobol'",
                "5: study.keep: .*'faild'",
                "7: vary.u.rate.uniform: ",
                "8: vary.observer.filter_rate: .*got 3",
                "9: vary.u.amplitude.normal: ",
            ],
        ),
        (
            f'{OF_ACADEMIC}keep = "best 2 of eror"\n[metrics]\nerror = "x"\n',
            ["3: study.keep: no metric 'eror'; did you mean 'error'"],
        ),
        (f'{OF_ACADEMIC}set = {{ "u.rate" = 3.0 }}\n[vary]\nu.rate = [1.0]\n', ["5: vary.u.rate"]),
        (
            f'{OF_ACADEMIC}[vary]\nu.rate = [1.0]\n"u.rate" = [2.0]\n',
            ["5: vary.u.rate: .*'u.rate'"],
        ),
        (f"vary = 3\n{OF_ACADEMIC}", ["1: vary: .*3"]),
    ],
)
def test_every_problem_of_a_file_is_in_one_report(write, text, problems):
    """Each with its line, once."""
    path = write(text)
    with pytest.raises(UsageError) as caught:
        read_study(path)
    lines = sorted(str(caught.value).splitlines())
    assert len(lines) == len(problems), lines
    for line, problem in zip(lines, problems, strict=True):
        assert re.match(re.escape(f"{path}:") + problem, line), (problem, line)


def test_problems_of_a_study_in_a_scenario_have_their_lines(write):
    """In whichever way its tables are written."""
    text = find("academic").text
    end = len(text.splitlines())
    inside = "[study]\nscenario = 'x'\nvary.u.rate = { uniform = [1.0] }\n[study.metrics]\na = 1\n"
    path = write(text + inside, "mine.toml")
    with pytest.raises(UsageError) as caught:
        read_study(path)
    lines = sorted(str(caught.value).splitlines())
    places = {2: "scenario", 3: "vary.u.rate.uniform", 5: "metrics.a"}
    for line, (number, key) in zip(lines, places.items(), strict=True):
        assert line.startswith(f"{path}:{end + number}: study.{key}: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vary": {"u.rate": object()}}, "--vary u.rate: .*<object"),
        ({"keep": "none"}, "--keep: .*'none'"),
        ({"vary": {"u.x": [1], "components.u.x": [2]}}, "--vary components.u.x: .* 'u.x'"),
        ({"vary": {"rate": [1]}}, "--vary rate: 0: .*got 1"),
        ({"set": {"u.rate": 1.0}, "vary": {"u.rate": [1.0]}}, "--vary u.rate: it is varied"),
    ],
)
def test_wrong_options_are_named(options, message):
    """In the language of the caller."""
    with shell_language(), pytest.raises(UsageError, match=message):
        read_study("academic").with_options(**options)
