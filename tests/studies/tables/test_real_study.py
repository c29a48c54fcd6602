"""A study that was run: from its file to its tables, with the Ishigami function as its scenario."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError, shell_language
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.results import results_of_study
from cosim.studies.dataset.columns import metric_column, parameter_column
from cosim.studies.dataset.identity import StudyIdentity
from cosim.studies.dataset.study import open_study
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.design.commands import run_command
from cosim.studies.design.planning import plan_design
from cosim.studies.document.reading import read_study
from cosim.studies.members.runner import open_runner
from cosim.studies.tables.sensitivity import print_sobol
from cosim.studies.tables.show import ShownParts, show_study

SCENARIO = """
[scenario]
name = "ishigami"
stop = 1.0
step = 1.0
[components]
a = { kind = "constant", value = 0.0 }
b = { kind = "constant", value = 0.0 }
c = { kind = "constant", value = 0.0 }
made = { kind = "expression", y = "sin(a.y) + 7*sin(b.y)**2 + 0.1*c.y**4*sin(a.y)" }
"""
STUDY = """
[study]
scenario = "ishigami.toml"
sampling = "saltelli"
samples = SAMPLES
[vary]
"a.value" = { uniform = [-3.141592653589793, 3.141592653589793] }
"b.value" = { uniform = [-3.141592653589793, 3.141592653589793] }
"c.value" = { uniform = [-3.141592653589793, 3.141592653589793] }
[metrics]
made = "last(made.y)"
"""


@pytest.fixture(scope="module")
def ishigami(tmp_path_factory):
    """Return a study of 64 base points, its file and its design."""
    return studied(tmp_path_factory.mktemp("ishigami"), 64)


def studied(folder, samples):
    """Return the study of a number of base points, its file and its design."""
    text = STUDY.replace("SAMPLES", str(samples))
    (folder / "ishigami.toml").write_text(SCENARIO)
    (folder / "study.toml").write_text(text)
    study = read_study(str(folder / "study.toml"))
    design = plan_design(study, cosim.load(str(folder / "ishigami.toml")))
    columns = [parameter_column(name, design.column(name)) for name in design.names]
    columns.append(metric_column("made", "last(made.y)"))
    identity = StudyIdentity(study.name, text, {}, tuple(columns), len(design))
    with (
        StudyDataset.open_or_create(folder / "data", identity) as dataset,
        open_runner(study.subject) as runner,
    ):
        for member in design.members():
            dataset.add(member, runner.run(member))
    return open_study(folder / "data"), study, design


@pytest.mark.slow
def test_sobol_indices_of_a_study_are_those_of_the_closed_form(tmp_path, capsys):
    """Within 0.02 of them, of 5120 runs."""
    study, _, design = studied(tmp_path, 1024)
    results = results_of_study(study, StudyLayout.of(design))
    print_sobol(results, as_json=True)
    content = json.loads(capsys.readouterr().out)["made"]
    variance = 0.5 + 49.0 / 8.0 + 0.1 * np.pi**4 / 5.0 + 0.01 * np.pi**8 / 18.0
    pair = 0.01 * np.pi**8 * (1.0 / 18.0 - 1.0 / 50.0)
    alone = np.array([0.5 * (1.0 + 0.1 * np.pi**4 / 5.0) ** 2, 49.0 / 8.0, 0.0])
    for key, own, shared in zip(design.sampled, alone, (pair, 0.0, pair), strict=True):
        found = content["parameters"][key]
        assert found["first_order"] == pytest.approx(own / variance, abs=0.02)
        assert found["total_order"] == pytest.approx((own + shared) / variance, abs=0.02)
    assert content["base_points"] == 1024


@pytest.mark.slow
def test_a_study_and_its_members_are_shown(ishigami, capsys):
    """The command of a member is the one that runs it."""
    study, file, design = ishigami
    layout = StudyLayout.of(design)

    def shown(**parts):
        def command_of(number):
            return run_command(design.member(number), file)

        show_study(study, layout, command_of, ShownParts(**parts))
        return capsys.readouterr().out

    out = shown(conditions=("made > 0",))
    assert "saltelli: 64 base points x 5; 320 of 320 members done, none failed" in out
    assert "made > 0" in out
    row = study.table(members=[7]).to_pylist()[0]
    out = shown(member=7)
    assert f"a.value\t{row['a.value']}" in out
    assert f"--set a.value={row['a.value']!r}" in out
    assert json.loads(shown(member=7, as_json=True))["made"] == row["made"]
    assert "standard deviation" in shown(metrics=("made",))
    assert list(json.loads(shown(sobol=True, as_json=True))) == ["made"]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"member": 320}, r"0 to 319, got 320"),
        ({"metrics": ("mad",)}, r"the study has no metric 'mad'; did you mean 'made'"),
        ({"conditions": ("made",)}, r"condition 'made': .*got 'made'"),
    ],
)
def test_parts_that_cannot_be_shown_are_an_error(ishigami, parts, message):
    """Found before anything is printed."""
    study, _, design = ishigami
    with pytest.raises(UsageError, match=message):
        show_study(study, StudyLayout.of(design), str, ShownParts(**parts))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"worst": -1}, r"--worst: .*0 or more, got -1"),
        ({"member": 1, "sobol": True}, r"--member and --sobol"),
        ({"member": 1, "metrics": ("a",)}, r"--member and --metric"),
        ({"conditions": ("a < 1",), "sobol": True}, r"--pass and --sobol"),
        ({"by": "a", "sobol": True}, r"--by and --sobol"),
    ],
)
def test_options_that_do_not_go_together_are_an_error(parts, message):
    """They name the options of the shell there."""
    with shell_language(), pytest.raises(UsageError, match=message):
        ShownParts(**parts)
