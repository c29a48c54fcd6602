"""What a replay takes from its log: FMUs only where that is allowed, and designs; forged logs."""

import hashlib
import io
import json
import re
import zipfile

import numpy as np
import pytest

import cosim
from cosim.core import linear
from cosim.errors import CosimError, FmuError, LogError, UsageError
from cosim.log.metadata import decode_design, encode_design
from cosim.log.places import MOST_ATTACHED
from cosim.report.verification import verify
from cosim.scenario.document.document import find, shipped
from cosim.scenario.record import component_record, replay_origin
from cosim.scenario.recordings import log_contents
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.replay import replays_of
from tests.fmi import lag
from tests.fmi.compiled import compile_fmu
from tests.log.crafting import change_rows, put_together, take_apart
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

SCENARIO = """
scenario = { name = "fmu", stop = 0.5, step = 0.01 }
[components]
u = { kind = "sine", rate = 5.0 }
plant = { kind = "fmu", path = "lag.fmu" }
filter = { kind = "lag", time_constant = 0.1 }

[connections]
"plant.u" = "u.y"
"filter.u" = "plant.y"
"""
BOTH = {"rerun": True, "allow_code": True}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Write a scenario with an FMU that leaves a mark beside it where it is loaded."""
    sources = ("lag2.c", "marking.c")
    compile_fmu(tmp_path / "lag.fmu", lag.xml("2"), *sources, defines=(f'MARK="{tmp_path}/mark"',))
    (tmp_path / "fmu.toml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(folder, **options):
    """Run the scenario to a log, and remove the mark that its FMU left."""
    log = cosim.run(folder / "fmu.toml", out=folder / "a.mcap", force=True, **options)
    (folder / "mark").unlink()
    return cosim.open_log(log.path)


def forged(log, path, change):
    """Write a log whose content was changed, all checksums right; return it."""
    content = take_apart(log.path)
    change(content)
    return cosim.open_log(put_together(content, path))


def change_metadata(component, change):
    """Return what changes the metadata record of a component, or of the run."""
    return lambda content: change(dict(content.metadata)[component])


def replace_fmu(data, sha256=None):
    """Return what puts other bytes in the place of the FMU, and says another hash of it."""

    def change(content):
        items = dict(content.metadata)["cosim.component.plant"]
        said = json.loads(items["metadata"])
        items["metadata"] = json.dumps({**said, "sha256": sha256 or said["sha256"]})
        content.attachments = [
            (f"{sha256}.fmu" if sha256 else name, data) if name.endswith(".fmu") else (name, own)
            for name, own in content.attachments
        ]

    return change


def say_sha256(sha256):
    """Return what changes the hash that the log says of its FMU."""

    def change(items):
        items["metadata"] = json.dumps({**json.loads(items["metadata"]), "sha256": sha256})

    return change_metadata("cosim.component.plant", change)


@pytest.mark.fast("pair", "academic", "closed-loop")
@pytest.mark.parametrize("name", shipped())
def test_a_rerun_has_the_rows_of_the_run(name, tmp_path):
    """Plants of models need no permission; nothing is copied, and all is verified."""
    log = cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.2})
    again = cosim.replay(log, rerun=True)
    assert replay_origin(again).copied == ()
    verification = verify(log, again)
    assert verification.passed, verification.problems
    assert verification.copied == ()


def test_an_embedded_fmu_runs_again_from_the_log_alone(folder):
    """To the same bits, without its file; alone, or of two components, which have it once."""
    both = SCENARIO.replace("filter =", 'other = { kind = "fmu", path = "lag.fmu" }\nfilter =')
    (folder / "fmu.toml").write_text(both)
    log = run(folder, embed=True)
    sha256 = component_record(log, "plant").sha256
    content = (folder / "lag.fmu").read_bytes()
    assert [name for name in log.attachments if name.endswith(".fmu")] == [f"{sha256}.fmu"]
    assert log.attachment(f"{sha256}.fmu") == content
    assert hashlib.sha256(content).hexdigest() == sha256
    (folder / "lag.fmu").unlink()
    again = cosim.replay(log, **BOTH)
    assert (folder / "mark").exists()
    assert replay_origin(again).copied == ()
    assert verify(log, again).passed
    alone = cosim.replay(log, components=["plant"], **BOTH)
    assert set(replay_origin(alone).copied) == {"u", "filter", "other"}
    assert verify(log, alone).passed


def test_a_reachable_fmu_runs_again(folder, monkeypatch):
    """From where it was, also for who works in another folder, where another FMU has its name."""
    log = run(folder)
    assert not [name for name in log.attachments if name.endswith(".fmu")]
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "lag.fmu").write_bytes(b"another")
    for place in (folder, elsewhere):
        monkeypatch.chdir(place)
        log = cosim.open_log(folder / "a.mcap")
        assert verify(log, cosim.replay(log, **BOTH)).passed
    (elsewhere / "lag.fmu").unlink()
    (folder / "lag.fmu").unlink()
    message = (
        r"the FMU of 'plant' is neither in the log nor in a readable file: lag\.fmu; .*embed=True"
    )
    with pytest.raises(FmuError, match=message):
        cosim.replay(log, out=folder / "b.mcap", **BOTH)
    assert not (folder / "b.mcap").exists()


@pytest.mark.parametrize("embed", [True, False])
def test_no_fmu_runs_without_both_permissions(folder, embed, call):
    """Whether it is in the log, or beside it."""
    log = run(folder, embed=embed)
    cosim.replay(log, allow_code=True)
    with pytest.raises(UsageError, match="rerun=True runs the code of the FMUs plant; "):
        cosim.replay(log, rerun=True)
    assert call("replay", log.path, "--allow-code", "--verify")[0] == 0
    code, _, err = call("replay", log.path, "--rerun", "--verify")
    assert (code, "expected --allow-code, too" in err) == (2, True)
    assert call("info", log.path)[0] == 0
    assert not (folder / "mark").exists()
    code, out, _ = call("replay", log.path, "--rerun", "--allow-code", "--verify")
    assert (code, "not computed" in out) == (0, False)
    assert (folder / "mark").exists()


def test_another_fmu_is_refused_by_name_before_it_runs(folder, subtests):
    """In the log, or beside it; one whose hash is none, or fits an archive that leads out of it."""
    log = run(folder, embed=True)
    other = (folder / "lag.fmu").read_bytes() + b"\0"
    archive = io.BytesIO(other)
    with zipfile.ZipFile(archive, "a") as target:
        target.writestr("../../outside", "x")
    evil = archive.getvalue()
    sha256 = component_record(log, "plant").sha256
    wrong = "SHA-256|sha256"
    cases = [
        (replace_fmu(other), f"the FMU of 'plant': the FMU in .*: expected the SHA-256 {sha256}"),
        (replace_fmu(evil, hashlib.sha256(evil).hexdigest()), "has an entry that leads out of it"),
        *((say_sha256(text), wrong) for text in ("../../evil", "0" * 63, "G" * 64, 3, None)),
    ]
    for number, (change, message) in enumerate(cases):
        with subtests.test(number=number), pytest.raises(CosimError, match=message):
            cosim.replay(forged(log, folder / "b.mcap", change), **BOTH)
    log = run(folder)
    (folder / "lag.fmu").write_bytes(other)
    with pytest.raises(FmuError, match=rf"of 'plant': lag\.fmu: .*{sha256} .*; it is not run"):
        cosim.replay(log, **BOTH)
    assert not (folder / "mark").exists()
    assert not list(folder.parent.rglob("outside"))


def test_a_rerun_finds_what_is_wrong_with_the_plant(folder):
    """A changed row, its hash computed anew: a replay that copies the plant would not see it."""
    log = run(folder, embed=True)

    def flip(number, values):
        if number == 7:
            values[-1] += 1e-12

    changed = forged(log, folder / "b.mcap", lambda content: change_rows(content, "plant", flip))
    verification = verify(changed, cosim.replay(changed, **BOTH))
    assert not verification.passed
    first = verification.difference.first
    assert (first.signal.split(".")[0], first.time_ns) == ("plant", 70_000_000)


def test_the_source_of_a_plant_can_be_changed_in_a_rerun(folder):
    """As in a run: nothing of it is taken from the log."""
    log = run(folder, embed=True)
    changes = {"u.amplitude": 2.0}
    message = "run the scenario to change it, or compute it, too: cosim.replay with rerun=True"
    with pytest.raises(UsageError, match=message):
        cosim.replay(log, set=changes)
    again = cosim.replay(log, set=changes, **BOTH)
    assert cosim.diff(again, cosim.run(folder / "fmu.toml", set=changes)).equal


def test_a_plant_that_was_swapped_in_before_the_run_runs_again(folder):
    """Its report stays that of the run."""
    log = run(folder, swap={"u": folder / "lag.fmu"}, map={"u.y": "x"}, embed=True)
    again = cosim.replay(log, **BOTH)
    assert verify(log, again).passed
    report = component_record(log, "u").swap_report
    assert component_record(again, "u").swap_report == report
    assert again.warnings == log.warnings


def test_an_fmu_that_is_too_large_is_refused_before_the_run(folder, monkeypatch, call):
    """By its size; the limit is what can be read back, less the head of an attachment's record."""
    assert MOST_ATTACHED - 4096 == log_contents.MOST_EMBEDDED
    size = (folder / "lag.fmu").stat().st_size
    monkeypatch.setattr(log_contents, "MOST_EMBEDDED", size)
    assert run(folder, embed=True).status == "complete"
    monkeypatch.setattr(log_contents, "MOST_EMBEDDED", size - 1)
    code, _, err = call("run", "fmu.toml", "--embed", "--out", "b.mcap")
    assert code == 2
    assert re.search(rf"lag\.fmu .* more than {size - 1} bytes; omit --embed", err)
    assert not (folder / "b.mcap").exists()


# --- logs that are not what they say ---


def test_a_run_of_another_plant_is_found_under_the_scenario_of_this_one(tmp_path, call):
    """Its log has the tables and hashes of an honest one, and its own rows and matrices."""
    short = {"scenario.stop": 1.0}  # the setpoint steps at 0.5 s
    honest = cosim.run("pair", out=tmp_path / "honest.mcap", set=short)
    heavier = {**short, "models.motor.E[0][0]": 0.04}
    other = cosim.run("pair", out=tmp_path / "other.mcap", set=heavier)
    said = dict(take_apart(honest.path).metadata)

    def say(content):
        for name, items in content.metadata:
            if name == "cosim.run" or name.startswith("cosim.component."):
                items.update({key: said[name][key] for key in items if key != "cosim.design"})

    log = forged(other, tmp_path / "forged.mcap", say)
    anew = replays_of(log, ReplayRequest(rerun=True)).designs()
    verification = verify(log, cosim.replay(log, rerun=True), anew)
    assert verification.difference.equal
    found, *_ = verification.contradictions
    assert found.statement.startswith("designs.motor.")
    # of E x' = A x + ...: the derivative by the state is A/E, half as large for 2 E
    assert found.found == pytest.approx(0.5 * found.expected)
    assert verify(honest, cosim.replay(honest, rerun=True), anew).passed
    code, _, err = call("replay", log.path, "--verify", "--rerun")
    assert (code, "designs.motor." in err) == (1, True)
    code, out, _ = call("replay", log.path, "--verify")  # what is copied proves no matrix
    assert (code, "component tables, designs, overrides" in out) == (0, True)


def other_scenario(name):
    """Return what puts another scenario's text into a log."""

    def change(content):
        text = find(name).text.encode()
        content.attachments = [
            (own, text if own == "scenario.toml" else data) for own, data in content.attachments
        ]

    return change


UNFIT = [
    (other_scenario("pair"), "components.motor: .* has no component 'motor'"),
    (change_metadata("cosim.run", lambda items: items.update(format="99")), "99"),
    (change_metadata("cosim.run", lambda items: items.update(edits="[]")), "cannot be understood"),
    (change_metadata("cosim.run", lambda items: items.pop("edits")), r"has no scenario\.toml"),
]


def test_a_log_that_does_not_fit_is_refused(tmp_path):
    """The text of another scenario, a later format, no scenario: one error, nothing written."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.05})
    kept = log.path.read_bytes()

    def replay(change):
        content = take_apart(log.path)
        change(content)
        path = put_together(content, tmp_path / "b.mcap")
        cosim.replay(path, out=log.path, force=True)

    check_refused(UNFIT, replay, CosimError)
    assert log.path.read_bytes() == kept


def test_the_scenario_of_another_run_with_the_same_components_is_found(tmp_path):
    """It can be replayed, and contradicts the log."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.05})
    changed = forged(log, tmp_path / "b.mcap", other_scenario("academic-as-printed"))
    assert not verify(changed, cosim.replay(changed)).passed
    content = take_apart(log.path)
    content.messages = [m for m in content.messages if m[1] != 20_000_000]
    with pytest.raises(CosimError):
        cosim.replay(put_together(content, tmp_path / "c.mcap"))


# --- designs ---


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """Record a run of an observer and an identifier, with a linear part beside them."""
    changes = {
        "scenario.stop": 0.05,
        "components.lag": {"kind": "lag", "time_constant": 0.1},
        "connections.lag.u": "u.y",
    }
    return cosim.run("academic", out=tmp_path_factory.mktemp("log") / "a.mcap", set=changes)


def test_no_design_that_is_recorded_is_computed(designed, monkeypatch):
    """It would cost what a replay saves, and fail where that fails."""

    def no_discretization(*arguments):
        raise AssertionError("was called")

    monkeypatch.setattr(linear, "first_order_hold", no_discretization)
    assert cosim.diff(designed, cosim.replay(designed)).equal


DESIGN_CHANGES = {
    "renamed": lambda design, key: {
        "other" if name == key else name: design[name] for name in design
    },
    "reshaped": lambda design, key: {**design, key: np.append(design[key], 1.0)},
    "added": lambda design, key: {**design, "more": design[key]},
}


@pytest.mark.parametrize("change", DESIGN_CHANGES.values(), ids=DESIGN_CHANGES)
@pytest.mark.parametrize(
    ("name", "key"), [("lag", "Ad"), ("observer", "B1"), ("identifier", "times")]
)
def test_a_recorded_design_of_other_arrays_is_refused(designed, name, key, change, tmp_path):
    """The kernels that step trust their shapes."""

    def forge(items):
        items["cosim.design"] = encode_design(change(decode_design(items["cosim.design"]), key))

    log = forged(designed, tmp_path / "a.mcap", change_metadata(f"cosim.component.{name}", forge))
    with pytest.raises(LogError, match=f"'{name}': the recorded design: expected arrays of shapes"):
        cosim.replay(log)
