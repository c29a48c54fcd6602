"""The command that runs a member on its own."""

import shlex
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.cli.options import read_edits, read_unique_pairs
from cosim.scenario.document.edits import parse_value
from cosim.scenario.document.swap import port_names
from cosim.studies.checking import check_design
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plan_design
from cosim.studies.plan import run_command, toml_text
from cosim.studies.study_file import read_study
from tests.scenario.field_recordings import BOTH, LOOP, field_log

EMPTY = read_study("academic-noisy")
TEXTS = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"))
SCALARS = (
    st.floats(allow_nan=False)
    | st.integers(-(2**63), 2**63 - 1)
    | st.booleans()
    | TEXTS
    | st.sampled_from(["true", "1.0", "inf", " a", "a\n", "", "[1]", "'", '"', "1 # c", "\x7f"])
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)


def options_of(line):
    """Return the command, and the texts of each option, as a shell and typer would."""
    words = shlex.split(line)
    options = {"--set": [], "--swap": [], "--map": [], "--scenario": []}
    for name, text in zip(words[3::2], words[4::2], strict=True):
        options[name].append(text)
    return words[:3], options


@given(VALUES)
def test_values_are_read_as_they_were(value):
    """By what reads --set; floats to the bit."""
    text = toml_text(value).strip()
    found = parse_value(text)
    assert repr(found) == repr(value)


@given(st.floats(allow_nan=False))
def test_floats_are_the_same_bits(value):
    """Zeros with either sign, subnormal numbers, infinities."""
    assert struct.pack("d", parse_value(toml_text(value))) == struct.pack("d", value)


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.sampled_from(["a.x", "b.y[0]", "c.z[1].w"]), VALUES), st.integers(0))
def test_the_edits_of_a_command_are_those_of_the_member(changes, number):
    """Read by the shell's rules and the readers of the command line."""
    study = EMPTY.with_options(
        set={"scenario.stop": 0.1 + 0.2},
        swap={"u": "it's u.fmu#cs"},
        map={"u.y": "out 1", "plant.x": ["s1", "s2"]},
    )
    member = StudyMember(number, changes, {"plant": "/x y/$a.fmu"})
    words, options = options_of(run_command(member, study))
    assert words == ["cosim", "run", "academic-noisy"]
    edits = read_edits(options["--set"])
    assert repr(edits) == repr({"scenario.stop": 0.1 + 0.2, **changes})
    swaps = read_unique_pairs(options["--swap"], "swap")
    assert swaps == {**study.settings.swap, "plant": "/x y/$a.fmu"}
    names = {
        port: port_names(text) for port, text in read_unique_pairs(options["--map"], "").items()
    }
    assert names == {"u.y": ["out 1"], "plant.x": ["s1", "s2"]}


@pytest.mark.slow
def test_a_member_runs_alone_to_the_same_bits(call, tmp_path):
    """Of every kind of variation; its command begins with the name of the program."""
    study = EMPTY.with_options(
        vary={
            "delta.terms[0].theta": {"uniform": [-0.2, -0.1]},
            "plant.x_a0[1]": {"normal": [0.0, 1.0]},
            "identifier.method": ["output-error", "least-squares"],
            "observer.L": [[4.0, 0.0], [5.0, 1.0]],
        },
        samples=3,
        sampling="sobol",
        seeds=2,
        set={"scenario.stop": 0.05},
    )
    scenario = cosim.load("academic-noisy")
    design = plan_design(study, scenario)
    for number in (0, 7, 23):
        member = design.member(number)
        words = shlex.split(run_command(member, study))
        assert words[0] == "cosim"
        assert call(*words[1:], "--quiet", "--out", f"{number}.mcap")[0] == 0
        log = cosim.run(scenario, set={**study.settings.set, **member.set})
        assert cosim.diff(cosim.open_log(tmp_path / f"{number}.mcap"), log).equal


def test_the_member_of_a_recording_is_a_replay(call, tmp_path):
    """Of the log alone, which has its scenario."""
    cosim.run("academic-noisy", set={"scenario.stop": 0.05}, out=tmp_path / "field-1.mcap")
    study = EMPTY.with_options(
        replay=str(tmp_path / "field-*.mcap"), vary={"observer.filter_rate": [100.0, 300.0]}
    )
    design = plan_design(study, cosim.load("academic-noisy"))
    line = run_command(design.member(1), study)
    log = tmp_path / "field-1.mcap"
    assert line == f"cosim replay {log} --set observer.filter_rate=300.0"
    assert call(*shlex.split(line)[1:], "--quiet", "--out", "again.mcap")[0] == 0
    expected = cosim.replay(log, set={"observer.filter_rate": 300.0})
    assert cosim.diff(cosim.open_log(tmp_path / "again.mcap"), expected).equal


def test_the_member_of_a_recording_of_another_tool_has_the_scenario(call, tmp_path):
    """And the fields of the recording, which are none of a swap."""
    path = tmp_path / "loop.toml"
    path.write_text(LOOP)
    log = field_log(tmp_path)
    study = read_study(path).with_options(
        replay=str(log), map=BOTH, vary={"model.time_constant": [0.25, 0.5]}
    )
    scenario = cosim.load(path)
    design = plan_design(study, scenario)
    check_design(design, scenario)
    line = run_command(design.member(1), study)
    assert line.startswith(f"cosim replay {log} --scenario {path} --map plant.y=/drive/state.posi")
    assert call(*shlex.split(line)[1:], "--quiet", "--out", "again.mcap")[0] == 0
    changes = {"model.time_constant": 0.5}
    expected = cosim.replay(log, scenario=path, map=BOTH, set=changes)
    assert cosim.diff(cosim.open_log(tmp_path / "again.mcap"), expected).equal


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("least-squares", "least-squares"),
        ("1.0", '"1.0"'),
        ("true", '"true"'),
        (True, "true"),
        (0.1 + 0.2, "0.30000000000000004"),
        (1e22, "1e+22"),
        (-0.0, "-0.0"),
        ([1.0, [2]], "[1.0, [2]]"),
        ({"a b": 1.0}, '{"a b" = 1.0}'),
    ],
)
def test_values_are_written_as_a_user_would(value, text):
    """Words without quotes, unless they would mean something else."""
    assert toml_text(value) == text
