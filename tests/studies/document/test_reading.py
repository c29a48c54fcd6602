"""Study files, studies in scenarios, and options beside them."""

import json
import os
import re

import numpy as np
import pytest
from pydantic import ValidationError

import cosim
from cosim.errors import UsageError, shell_language
from cosim.scenario.document.document import find
from cosim.studies.contracts import StudySubject
from cosim.studies.design import find_recordings
from cosim.studies.study_file import KeptLogs, StudyTables, read_study
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


@pytest.fixture
def write(tmp_path):
    def write(text, name="study.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_a_file_says_all_of_a_study(write, tmp_path):
    """Settings, variations in their order, metrics."""
    study = read_study(write(STUDY))
    assert study.name == "study"
    assert study.source == str(tmp_path / "study.toml")
    assert study.scenario == "academic"
    settings = study.settings
    assert (settings.sampling, settings.samples, settings.seed) == ("sobol", 64, 7)
    assert (settings.seeds, settings.timeout) == (2, 30.0)
    assert study.kept_logs == KeptLogs("worst", 5, "error")
    assert [item.key for item in study.variations] == [
        "observer.filter_rate",
        "delta.terms[0].theta",
        "identifier.P0",
    ]
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


def test_the_tables_of_a_study_make_the_same_study_again(write):
    """Also after JSON."""
    study = read_study(write(STUDY))
    tables = json.loads(json.dumps(study.to_dict()))
    assert StudyTables.model_validate(tables).study == study.settings.model_copy(
        update={"name": "study"}
    )
    assert study.with_options().variations == study.variations
    assert study.with_options().to_dict() == tables


def test_a_scenario_without_a_study_has_an_empty_one(write, tmp_path):
    """What a run says is kept, as there are no metrics."""
    for name in ("academic", write(find("academic").text, "mine.toml")):
        study = read_study(name)
        assert study.name == "academic"
        assert study.scenario == str(name)
        assert study.variations == ()
        assert study.kept_logs == KeptLogs()
        assert study.subject.with_results
    assert study.settings.seed == 0
    assert os.path.isabs(study.scenario)


def test_a_scenario_may_have_its_study_inside(write):
    """The scenario runs as without, and the study is that of a file of its own."""
    inside = STUDY.replace('scenario = "academic"\n', "")
    inside = inside.replace("[vary]", "[study.vary]").replace("[metrics]", "[study.metrics]")
    path = write(f"{find('academic').text}\n{inside}", "mine.toml")
    study = read_study(path)
    own = read_study(write(STUDY))
    assert study.scenario == str(path)
    assert study.variations == own.variations
    assert study.metrics == own.metrics
    assert study.settings.samples == 64
    end = {"scenario.stop": 0.01}
    assert cosim.diff(cosim.run(path, set=end), cosim.run("academic", set=end)).equal


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
    assert study.scenario == str(tmp_path.parent / "mine.toml")
    assert study.settings.cases == str(tmp_path / "c.csv")
    assert study.settings.replay == str(tmp_path / "field-*.mcap")
    assert study.variations == (
        GridVariation("swap.plant", (str(tmp_path / "a.fmu"), str(tmp_path.parent / "b.fmu#cs"))),
        SampledVariation("swap.sensor", "choice", (1.0,), (str(tmp_path / "c.fmu"),)),
    )
    changed = study.with_options(
        vary={"plant": [["x.fmu"]]}, cases="d.csv", replay=["*.mcap"], swap={"u": "u.fmu"}
    )
    assert changed.variations[0] == GridVariation("swap.plant", (str(elsewhere / "x.fmu"),))
    assert changed.settings.cases == str(elsewhere / "d.csv")
    assert changed.settings.replay == (str(elsewhere / "*.mcap"),)
    assert changed.settings.swap == {"u": str(elsewhere / "u.fmu")}
    assert changed.variations[1] == study.variations[1]


def test_options_extend_and_replace(write):
    """What is varied anew comes behind what the file varies."""
    study = read_study(write(STUDY)).with_options(
        vary={
            "components.u.rate": np.array([1.0, 2.0]),
            "identifier.P0": {"values": [1.0]},
        },
        metrics={"last": "last(plant.y)"},
        set={"u.amplitude": np.float64(2.0)},
        swap={},
        map={"plant.x": ["a", "b"]},
        sampling="random",
        samples=10,
        seeds=3,
        seed=8,
        timeout=1.0,
        keep=[3, 1, 1],
        results=False,
    )
    assert [item.key for item in study.variations] == [
        "observer.filter_rate",
        "delta.terms[0].theta",
        "identifier.P0",
        "u.rate",
    ]
    assert study.grid[1:] == (
        GridVariation("identifier.P0", (1.0,)),
        GridVariation("u.rate", (1.0, 2.0)),
    )
    assert list(study.metrics) == ["error", "last"]
    assert study.settings.set["u.amplitude"] == 2.0
    assert study.settings.set["scenario.stop"] == 1.0
    assert dict(study.settings.map) == {"plant.y": "out", "plant.x": ["a", "b"]}
    assert (study.settings.sampling, study.settings.samples) == ("random", 10)
    assert (study.settings.seeds, study.settings.seed) == (3, 8)
    assert study.kept_logs == KeptLogs("numbers", numbers=(1, 3))
    assert not study.subject.with_results


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ('[study]\nscenario = "academic"\nsampels = 3\n', ["3: study.sampels: unknown key 'samp"]),
        ("[study]\nsamples = 3\n", ["1: study: 'scenario' is missing"]),
        (
            '[study]\nscenario = "academic"\n[varry]\n[metrics]\na = 3\n',
            ["3: varry: unknown key 'varry'; did you mean 'vary'", "5: metrics.a: .*3"],
        ),
        (
            '[study]\nscenario = "academic"\nsamples = 0\nsampling = "sobl"\nkeep = "faild"\n'
            '[vary]\n"u.rate" = { uniform = [2.0, 1.0] }\nobserver.filter_rate = 3\n'
            "u.amplitude.normal = [0.0, 0.0]\n",
            [
                "3: study.samples: .*0",
                "4: study.sampling: .*'sobl'; did you mean 'sobol'",
                "7: vary.u.rate.uniform: ",
                "8: vary.observer.filter_rate: .*got 3",
                "9: vary.u.amplitude.normal: ",
            ],
        ),
        (
            '[study]\nscenario = "academic"\nkeep = "worst 0 of x"\n',
            ["3: study.keep: .*got 'worst 0 of x'"],
        ),
        (
            '[study]\nscenario = "academic"\nkeep = [-1]\n',
            [r"3: study.keep: .*got \[-1\]"],
        ),
        (
            '[study]\nscenario = "academic"\nkeep = "best 2 of eror"\n[metrics]\nerror = "x"\n',
            ["3: study.keep: no metric 'eror'; did you mean 'error'"],
        ),
        (
            '[study]\nscenario = "academic"\nset = { "u.rate" = 3.0 }\n[vary]\nu.rate = [1.0]\n',
            ["5: vary.u.rate: it is varied"],
        ),
        ("[studdy]\n", ["neither a study nor a scenario; .*the table \\[study\\]"]),
        ("study = 3\n", ["1: study: .*3"]),
        ('[study]\nscenario = "academic"\nvary = 3\n', ["3: study.vary: unknown key 'vary'"]),
        ('vary = 3\n[study]\nscenario = "academic"\n', ["1: vary: .*3"]),
    ],
)
def test_every_problem_of_a_file_is_in_one_report(write, text, problems):
    """Each with its line, once."""
    path = write(text)
    with pytest.raises(UsageError) as caught:
        read_study(path)
    lines = str(caught.value).splitlines()
    assert len(lines) == len(problems), lines
    for line, problem in zip(sorted(lines), sorted(problems), strict=True):
        place = f"{path}:" if problem[0].isdigit() else f"{path}: "
        assert re.match(re.escape(place) + problem, line), (problem, line)


def test_problems_of_a_study_in_a_scenario_have_their_lines(write):
    """In whichever way its tables are written."""
    text = find("academic").text
    count = len(text.splitlines())
    path = write(
        f"{text}[study]\nscenario = 'x'\nvary.u.rate = {{ uniform = [1.0] }}\n"
        "[study.metrics]\na = 1\n",
        "mine.toml",
    )
    with pytest.raises(UsageError) as caught:
        read_study(path)
    lines = sorted(str(caught.value).splitlines())
    places = {2: "scenario", 3: "vary.u.rate.uniform", 5: "metrics.a"}
    for line, (number, key) in zip(lines, places.items(), strict=True):
        assert line.startswith(f"{path}:{count + number}: study.{key}: ")


def test_a_study_in_a_scenario_is_a_table(write):
    """Which the schema of the scenario says."""
    path = write(f"study = 3\n{find('academic').text}", "mine.toml")
    with pytest.raises(UsageError, match=r"mine.toml:1: study: .*3"):
        cosim.load(path)
    with pytest.raises(UsageError, match=r"mine.toml:1: study: .*3"):
        read_study(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vary": {"u.rate": {"uniform": [1.0]}}}, "--vary u.rate: uniform: .*\\[1.0\\]"),
        ({"vary": {"u.rate": 3}}, "--vary u.rate: .*got 3"),
        ({"vary": {"u.rate": object()}}, "--vary u.rate: .*<object"),
        ({"vary": [1]}, r"--vary: .*\[1\]"),
        ({"samples": 0}, "--samples: .*0"),
        ({"samples": 2.5}, "--samples: .*2.5"),
        ({"seeds": -1}, "--seeds: .*-1"),
        ({"sampling": "lhs"}, "--sampling: .*'lhs'; .*: random, latin-hypercube"),
        ({"keep": "none"}, "--keep: .*got 'none'"),
        ({"timeout": 0.0}, "--timeout: .*0.0"),
        ({"metrics": {"a": 3}}, "--metrics a: .*3"),
        ({"set": {"u.rate": object()}}, "--set u.rate: .*<object"),
        ({"set": {"u.rate": 1.0}, "vary": {"u.rate": [1.0]}}, "--vary u.rate: it is varied"),
        ({"swap": {"plant": 3}}, "--swap plant: .*3"),
    ],
)
def test_wrong_options_are_named(options, message):
    """In the language of the caller."""
    study = read_study("academic")
    with shell_language(), pytest.raises(UsageError, match=message):
        study.with_options(**options)


def test_a_path_that_is_no_file_is_refused(tmp_path):
    """As of a scenario."""
    with pytest.raises(UsageError, match=r"unknown scenario 'acdemic'; .*did you mean 'academi"):
        read_study("acdemic")
    with pytest.raises(UsageError, match=r"x.toml: cannot be read"):
        read_study(tmp_path / "x.toml")


def test_the_schema_has_no_other_keys():
    """Not even beside the three tables."""
    with pytest.raises(ValidationError, match="Extra inputs"):
        StudyTables.model_validate({"study": {}, "other": 1})


def test_a_log_is_the_study_of_its_replay(tmp_path, monkeypatch):
    """By its path, or in the place of the scenario; other logs may take its place."""
    monkeypatch.chdir(tmp_path)
    cosim.run("academic", set={"scenario.stop": 0.01}, out="a.mcap")
    path = str(tmp_path / "a.mcap")
    for name in ("a.mcap", of_text(tmp_path / "x.toml", '[study]\nscenario = "a.mcap"\n')):
        study = read_study(name)
        assert study.scenario == path
        assert tuple(find_recordings(study.settings.replay)) == (path,)
    assert read_study("a.mcap").name == "academic"
    replaced = read_study("a.mcap").with_options(replay="field-*.mcap")
    assert replaced.settings.replay == str(tmp_path / "field-*.mcap")


def of_text(path, text):
    path.write_text(text)
    return path
