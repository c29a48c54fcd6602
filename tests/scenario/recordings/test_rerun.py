"""Replays that compute plants too: FMUs of the log only where that is allowed."""

import hashlib
import io
import json
import zipfile

import pytest

import cosim
from cosim.cli import main
from cosim.errors import FmuError, LogError, UsageError
from cosim.log.contents.metadata import decode_design, encode_design
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from cosim.scenario.record import component_record, replay_origin
from cosim.scenario.recordings import embedding
from cosim.scenario.running.replay import replays_of
from tests.fmi import lag
from tests.fmi.compiled import compile_fmu
from tests.log.crafting import change_rows, put_together, take_apart

pytestmark = pytest.mark.usefixtures("without_verdicts")

SCENARIO = """
[scenario]
name = "fmu"
stop = 0.5
step = 0.01

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
    """Write a log whose content was changed, all checksums right."""
    content = take_apart(log.path)
    change(content)
    return put_together(content, path)


def sha256_of(log):
    """Return the recorded hash of the FMU."""
    return component_record(log, "plant").sha256


@pytest.mark.fast("pair", "academic", "closed-loop")
@pytest.mark.parametrize("name", shipped())
def test_a_rerun_has_the_rows_of_the_run(name, tmp_path):
    """Plants of models need no permission; nothing is copied, and all is verified."""
    log = cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.5})
    again = cosim.replay(log, rerun=True)
    assert replay_origin(again).copied == ()
    verification = verify(log, again)
    assert verification.passed, verification.problems
    assert verification.copied == ()


def test_an_embedded_fmu_runs_again_from_the_log_alone(folder, tmp_path):
    """To the same bits, without its file."""
    log = run(folder, embed=True)
    name = f"{sha256_of(log)}.fmu"
    content = (folder / "lag.fmu").read_bytes()
    assert log.attachment(name) == content
    assert hashlib.sha256(content).hexdigest() == sha256_of(log)
    (folder / "lag.fmu").unlink()
    again = cosim.replay(log, **BOTH)
    assert (folder / "mark").exists()
    assert replay_origin(again).copied == ()
    verification = verify(log, again)
    assert verification.passed, verification.problems


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
    assert (folder / "mark").exists()
    (elsewhere / "lag.fmu").unlink()
    (folder / "lag.fmu").unlink()
    message = (
        r"the FMU of 'plant' is neither in the log nor in a readable file: lag\.fmu; .*embed=True"
    )
    with pytest.raises(FmuError, match=message):
        cosim.replay(log, **BOTH)


@pytest.mark.parametrize("embed", [True, False])
def test_no_fmu_runs_without_both_permissions(folder, embed, call):
    """Whether it is in the log, or beside it."""
    log = run(folder, embed=embed)
    cosim.replay(log)
    cosim.replay(log, allow_code=True)
    with pytest.raises(UsageError, match="rerun=True runs the code of the FMUs plant; "):
        cosim.replay(log, rerun=True)
    assert call("replay", log.path, "--allow-code", "--verify")[0] == 0
    code, _, err = call("replay", log.path, "--rerun", "--verify")
    assert (code, "expected --allow-code, too" in err) == (2, True)
    assert call("info", log.path)[0] == 0
    assert not (folder / "mark").exists()
    code, out, _ = call("replay", log.path, "--rerun", "--allow-code", "--verify")
    assert code == 0
    assert "not computed" not in out
    assert (folder / "mark").exists()


def test_another_fmu_is_refused_by_name_before_it_runs(folder):
    """In the log, and beside it."""
    log = run(folder, embed=True)
    sha256 = sha256_of(log)
    other = (folder / "lag.fmu").read_bytes() + b"\0"

    def replace(content):
        named = [(name, other if name.endswith(".fmu") else data) for name, data in content]
        return named

    def change(content):
        content.attachments = replace(content.attachments)

    changed = forged(log, folder / "b.mcap", change)
    message = f"the FMU of 'plant': the FMU in .*b.mcap: expected the SHA-256 {sha256}"
    with pytest.raises(FmuError, match=message):
        cosim.replay(changed, **BOTH)
    log = run(folder)
    (folder / "lag.fmu").write_bytes(other)
    message = rf"the FMU of 'plant': lag\.fmu: .*{sha256} .*; it is not run"
    with pytest.raises(FmuError, match=message):
        cosim.replay(log, **BOTH)
    assert not (folder / "mark").exists()


def test_a_hash_that_is_none_is_refused(folder, subtests):
    """It names an attachment and a file, so it has to be a hash."""
    for sha256 in ["../../evil", "0" * 63, "G" * 64, 3, None]:
        with subtests.test(sha256=sha256):
            log = run(folder, embed=True)

            def change(content, sha256=sha256):
                for name, items in content.metadata:
                    if name == "cosim.component.plant":
                        table = json.loads(items["metadata"])
                        table["sha256"] = sha256
                        items["metadata"] = json.dumps(table)

            changed = forged(log, folder / "b.mcap", change)
            with pytest.raises(LogError, match=r"SHA-256|sha256"):
                cosim.replay(changed, **BOTH)
            assert not (folder / "mark").exists()


def test_an_embedded_archive_that_leads_out_is_refused(folder):
    """With a hash that fits: whoever writes a log chooses that too."""
    log = run(folder, embed=True)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as target, zipfile.ZipFile(folder / "lag.fmu") as source:
        for member in source.namelist():
            target.writestr(member, source.read(member))
        target.writestr("../../outside", "x")
    evil = archive.getvalue()
    sha256 = hashlib.sha256(evil).hexdigest()

    def change(content):
        content.attachments = [
            (f"{sha256}.fmu", evil) if name.endswith(".fmu") else (name, data)
            for name, data in content.attachments
        ]
        for name, items in content.metadata:
            if name == "cosim.component.plant":
                items["metadata"] = items["metadata"].replace(sha256_of(log), sha256)

    changed = forged(log, folder / "b.mcap", change)
    with pytest.raises(UsageError, match="the archive has an entry that leads out of it"):
        cosim.replay(changed, **BOTH)
    assert not (folder / "mark").exists()
    assert not list(folder.parent.rglob("outside"))


def test_a_rerun_finds_what_is_wrong_with_the_plant(folder):
    """A changed row, its hash computed anew: a replay that copies the plant would not see it."""
    log = run(folder, embed=True)

    def flip(number, values):
        if number == 7:
            values[-1] += 1e-12

    changed = forged(log, folder / "b.mcap", lambda content: change_rows(content, "plant", flip))
    verification = verify(cosim.open_log(changed), cosim.replay(changed, **BOTH))
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
    """Its report stays that of the run: what it had replaced is not there."""
    log = cosim.run(
        "academic",
        swap={"u": folder / "lag.fmu"},
        map={"u.y": "x"},
        set={"scenario.stop": 0.1},
        out=folder / "b.mcap",
        embed=True,
    )
    again = cosim.replay(log, **BOTH)
    verification = verify(log, again)
    assert verification.passed, verification.problems
    report = component_record(log, "u").swap_report
    assert component_record(again, "u").swap_report == report


def test_a_plant_in_place_of_what_cannot_be_built_runs_again(folder):
    """The run warned that it compared nothing, and so does its replay."""
    text = SCENARIO.replace('{ kind = "sine", rate = 5.0 }', '{ kind = "step", time = 0.005 }')
    (folder / "off-grid.toml").write_text(text)
    swap = {"u": folder / "lag.fmu"}
    log = cosim.run("off-grid.toml", swap=swap, map={"u.y": "x"}, out=folder / "b.mcap", embed=True)
    texts = [warning.text for warning in log.warnings if warning.source == "u"]
    assert any("0.005 s" in text for text in texts)
    again = cosim.replay(log, **BOTH)
    assert [warning.text for warning in again.warnings if warning.source == "u"] == texts
    assert verify(log, again).passed


def test_a_component_of_a_rerun_alone_is_verified(folder):
    """The plant from what drives it, as it was recorded."""
    log = run(folder, embed=True)
    again = cosim.replay(log, components=["plant"], **BOTH)
    assert set(replay_origin(again).copied) == {"u", "filter"}
    assert verify(log, again).passed


def test_an_fmu_that_is_too_large_is_refused_before_the_run(folder, monkeypatch, call):
    """By its size, which is looked at before anything is written."""
    size = (folder / "lag.fmu").stat().st_size
    monkeypatch.setattr(embedding, "MOST_EMBEDDED", size)
    assert run(folder, embed=True).status == "complete"
    monkeypatch.setattr(embedding, "MOST_EMBEDDED", size - 1)
    code, _, err = call("run", "fmu.toml", "--embed", "--out", "b.mcap")
    assert code == 2
    for text in (f"lag.fmu: has {size} bytes", f"at most {size - 1}; omit --embed"):
        assert text in err
    assert not (folder / "b.mcap").exists()


def test_a_log_of_the_largest_fmu_can_be_read_back(tmp_path):
    """The limit is that of the reader, less what the record of an attachment has beside it."""
    from cosim.log.reading.container import MOST_ATTACHED

    assert MOST_ATTACHED - 4096 == embedding.MOST_EMBEDDED


def test_an_fmu_of_two_components_is_embedded_once(folder):
    """By its hash."""
    text = (folder / "fmu.toml").read_text()
    twice = text.replace("filter =", 'other = { kind = "fmu", path = "lag.fmu" }\nfilter =')
    (folder / "fmu.toml").write_text(twice)
    log = run(folder, embed=True)
    assert len([name for name in log.attachments if name.endswith(".fmu")]) == 1
    assert verify(log, cosim.replay(log, **BOTH)).passed


def test_fmus_are_embedded_in_logs_alone(folder):
    """A recorder of one's own takes no files."""
    from cosim.core import Memory

    with pytest.raises(UsageError, match="expected embed=True or a recorder, got both"):
        cosim.run(folder / "fmu.toml", embed=True, recorder=Memory())


def test_a_run_of_another_plant_is_found_under_the_scenario_of_this_one(tmp_path, capsys):
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

    log = cosim.open_log(forged(other, tmp_path / "forged.mcap", say))
    anew = replays_of(log, rerun=True).designs()
    verification = verify(log, cosim.replay(log, rerun=True), anew)
    assert verification.difference.equal
    found, *_ = verification.contradictions
    assert found.statement.startswith("designs.motor.")
    # of E x' = A x + ...: the derivative by the state is A/E, half as large for 2 E
    assert found.found == pytest.approx(0.5 * found.expected)
    assert verify(honest, cosim.replay(honest, rerun=True), anew).passed
    for more, code in ((["--rerun"], "1"), ([], "0")):  # what is copied proves no matrix
        with pytest.raises(SystemExit, match=code):
            main(["replay", str(log.path), "--verify", *more])
    out = capsys.readouterr()
    assert "designs.motor." in out.err
    assert "component tables, designs, overrides" in out.out


def test_a_design_of_another_version_is_gone_by_and_not_compared(tmp_path):
    """An older identifier has fewer arrays; the report names it."""
    honest = cosim.run("academic", out=tmp_path / "honest.mcap", set={"scenario.stop": 7.0})

    def say(content):
        for name, items in content.metadata:
            if name == "cosim.component.identifier":
                design = decode_design(items["cosim.design"])
                del design["grids"]
                items["cosim.design"] = encode_design(design)

    log = cosim.open_log(forged(honest, tmp_path / "older.mcap", say))
    anew = replays_of(log, rerun=True).designs()
    verification = verify(log, cosim.replay(log, rerun=True), anew)
    assert verification.passed
    assert "designs but that of identifier, of another version" in verification.statements
    assert "another version" not in verify(honest, cosim.replay(honest), anew).statements
