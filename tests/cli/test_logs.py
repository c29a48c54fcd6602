"""The commands on logs: what they contain, how they differ, and what is made of them."""

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.log import McapRecorder
from tests.log.crafting import change_rows, put_together, take_apart
from tests.log.foreign_files import write_json
from tests.log.recordings import blocks, layout, plan, record, table

# --- what they contain ---


@pytest.mark.parametrize(
    ("source", "key", "named"),
    [
        ("a.mcap", "run", "content hash\t"),
        ("closed-loop", "connections", "gauss-seidel controller plant observer"),
        ("field.mcap", "fields", "/drive/state.position\t"),
    ],
)
def test_info_shows_what_there_is(call, files, source, key, named):
    """Of a log, a scenario, an FMU and a recording of another tool, as tables and as JSON."""
    code, out, _ = call("info", source)
    assert code == 0
    assert named in out
    assert json.loads(call("info", source, "--json")[1])[key]


@pytest.mark.usefixtures("files")
def test_info_says_what_is_recorded_of_what(call):
    """Of a partial log; nothing of it is said of a whole one."""
    lines = call("info", "part.mcap")[1].splitlines()
    assert {"partial", "of signals\t24"} <= set(lines)
    about = json.loads(call("info", "part.mcap", "--json")[1])["partial"]
    assert (about["signals"], about["every"]) == (["plant.*", "observer.delta"], 10)
    assert (about["recorded signals"], about["of components"]) == (6, 6)
    assert about["not recorded"].keys() == {"u", "delta", "observer", "regressor", "identifier"}
    assert "partial" not in json.loads(call("info", "a.mcap", "--json")[1])


def test_overrides_are_shown_and_compared(call, tmp_path):
    """How many, the first ten of them, and where two logs first differ in them."""
    for name, value in (("a", 0.3), ("b", 0.4)):
        with cosim.load("academic").start(out=tmp_path / f"{name}.mcap") as sim:
            for _ in range(6):
                sim.step()
                sim["plant.u"] = value
                sim.step()
                sim.release("plant.u")
    out = call("info", "a.mcap")[1]
    assert "override 6, follow " in out
    assert {"0.001\tplant.u\toverride\t0.3", "not shown\t2"} <= set(out.splitlines())
    assert len(json.loads(call("info", "a.mcap", "--json")[1])["overrides"]) == 10
    code, out, _ = call("diff", "a.mcap", "b.mcap", "plant.u")
    assert code == 1
    assert out.splitlines()[-1] == (
        "events: 12 in a, 12 in b: 6 of 12 jumps differ; first plant.u at 0.001 s: override 0.3, "
        "override 0.4"
    )
    code, out, _ = call("diff", "a.mcap", "b.mcap", "plant.u", "--atol", "0.2")
    assert code == 0
    assert "12 in b: within the tolerance" in out


RAMP = """
[scenario]
name = "ramp"
stop = {stop}
step = {step}
[components]
r = {{ kind = "ramp", slope = 1.0, start_time = {start} }}
"""


def test_runs_of_other_instants_are_compared_between_them(call, tmp_path):
    """A ramp that begins 0.05 s later has the value of the first within 0.05 s."""
    for name, step, start, stop in (("a", 0.01, 0.2, 1), ("b", 0.04, 0.2, 1), ("c", 0.04, 0.25, 2)):
        text = RAMP.format(step=step, start=start, stop=stop)
        (tmp_path / f"{name}.toml").write_text(text)
        cosim.run(tmp_path / f"{name}.toml", out=tmp_path / f"{name}.mcap")
    assert call("diff", "a.mcap", "b.mcap")[0] == 1
    assert call("diff", "a.mcap", "b.mcap", "--interpolate", "--atol", "1e-12")[0] == 0
    assert call("diff", "a.mcap", "c.mcap", "--interpolate", "--atol", "0.049")[0] == 1
    assert call("diff", "a.mcap", "c.mcap", "--tube", "0.05s,0.1%")[0] == 0
    assert call("diff", "a.mcap", "c.mcap", "--tube", "0.04s,0.1%")[0] == 1
    for tube in ("0.05", "0.05ms", "1..5s", "5%"):
        code, _, err = call("diff", "a.mcap", "c.mcap", "--tube", tube)
        assert code == 2
        assert "--tube: expected a time" in err
        assert repr(tube) in err
    err = call("diff", "a.mcap", "c.mcap", "--tube", "0.05s", "--rtol", "0.1")[2]
    assert "--tube brings its own relative tolerance; omit it or --rtol" in err


def test_what_cannot_be_compared_is_said(call, tmp_path):
    """Events beside a table, which has none; of what could not be read nothing is called equal."""
    with cosim.load("academic").start(out=tmp_path / "e.mcap") as sim:
        sim.step()
        sim["plant.u"] = 0.3
        sim.step()
    call("convert", "e.mcap", "e.csv")
    code, out, err = call("diff", "e.mcap", "e.csv")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "note: not compared: events: e.csv has no place for them"
    between = call("diff", "e.mcap", "e.mcap", "--interpolate")[1].splitlines()
    assert between[-1] == "note: not compared: events: not between rows"
    for name, other in (("x", 1.0), ("y", 2.0)):
        rows = [(0, {"v": 1.0, "mode": 3}), (10**9, {"v": 1.0, "mode": f"at {other}"})]
        write_json(tmp_path / f"{name}.mcap", {"/r": rows})
    code, out, err = call("diff", "x.mcap", "y.mcap")
    assert code == 1
    assert "/r.mode\tnot read" in out
    assert "x.mcap: left out: /r.mode: it is a number in message 1, text in message 2" in err
    assert call("diff", "x.mcap", "y.mcap", "/r.v")[0] == 0
    shown = json.loads(call("diff", "x.mcap", "y.mcap", "--json")[1])
    assert (shown["equal"], shown["within"], len(shown["not_compared"])) == (False, False, 1)


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("name", ["r.csv", "r.parquet", "r.mat", "r.npz", "r.mcap"])
def test_recordings_of_any_kind_are_read_like_logs(call, tmp_path, name):
    """By each of these commands; a signal of another name is the one that a map says."""
    write_json(tmp_path / "r.mcap", {"/r": [(k * 10**7, {"y": k / 100}) for k in range(11)]})
    if name != "r.mcap":
        assert call("convert", "r.mcap", name) == (0, f"{name}\n", "")
        code, out, _ = call("diff", "r.mcap", name)
        assert (code, out.splitlines()[1]) == (0, "/r.y\tequal\t0\t0.1\t0")
    assert call("metrics", name, "last('/r.y')")[1] == "last('/r.y')\t0.1\n"
    assert call("cat", name)[1].splitlines()[:3] == ["t [s],/r.y", "0.0,0.0", "0.01,0.01"]
    for command in (f"plot {name} /r.y --out p.svg", f"convert {name} c.csv"):
        assert call(*command.split())[0] == 0
    (tmp_path / "m.csv").write_text("t,level [mm]\n0,0\n0.1,0.1\n")
    assert "note: no signal of a has the name of one of b" in call("diff", "m.csv", name)[1]
    mapped = ("diff", "m.csv", name, "--map", "table.level=/r.y", "--interpolate")
    assert call(*mapped)[0] == 0
    (tmp_path / "m.csv").write_text("t,level [mm]\n0,0\n0.05,0.07\n0.1,0.1\n")
    code, out, _ = call(*mapped, "--plot", "d.svg")
    assert (code, out.splitlines()[-1]) == (1, "d.svg")
    assert "table.level at 0.05 s: 0.07, 0.05" in out
    code, out, _ = call(*mapped, "--atol", "0.03")
    note = (
        "note: compared only at instants of a within b: table.level at 3 instants (3 in a, 11 in b)"
    )
    assert (code, out.splitlines()[-1]) == (0, note)


# --- the hash of what they contain ---


@pytest.mark.usefixtures("files")
def test_the_hash_of_a_log_is_printed(call):
    """As sha256sum prints it; with the hash of each signal, if they are asked for."""
    log = cosim.open_log("a.mcap")
    assert call("hash", "a.mcap") == (0, f"{log.recorded_hash}  a.mcap\n", "")
    code, out, _ = call("hash", "a.mcap", "--signals")
    own, *signals = [line.split("  ", 1) for line in out.splitlines()]
    assert (code, own) == (0, [log.recorded_hash, "a.mcap"])
    assert {name: digest for digest, name in signals} == log.signal_hashes()


@pytest.fixture
def rows(tmp_path):
    """Write rows.mcap; return its content in pieces."""
    record(tmp_path / "rows.mcap", steps=50)
    return take_apart(tmp_path / "rows.mcap")


def test_a_changed_value_is_said_and_exits_with_1(call, tmp_path, rows):
    """All checksums of the file fit; the recorded hash does not, and JSON says which signal's."""

    def change(number, values):
        if number == 30:
            values[1] += 1e-15

    change_rows(rows, "plant", change)
    put_together(rows, tmp_path / "b.mcap")
    recorded = cosim.open_log("rows.mcap").recorded_hash
    code, out, err = call("hash", "b.mcap")
    assert code == 1
    assert out.split()[1] == "b.mcap"
    assert recorded not in out
    assert f"b.mcap: the content hash differs from the recorded {recorded}" in err
    shown, known = (
        json.loads(call("hash", name, "--json", "--signals")[1]) for name in ("b.mcap", "rows.mcap")
    )
    assert (shown["recorded"], shown["equal"], known["equal"]) == (recorded, False, True)
    differ = [name for name, digest in known["signals"].items() if shown["signals"][name] != digest]
    assert differ == ["plant.x_a"]
    assert "signals" not in json.loads(call("hash", "rows.mcap", "--json")[1])
    # another tool may leave it out; there is nothing that it could differ from
    rows.metadata = [item for item in rows.metadata if item[0] != "cosim.result"]
    put_together(rows, tmp_path / "c.mcap")
    said = "c.mcap: no content hash was recorded\n"
    assert call("hash", "c.mcap") == (0, f"{shown['content_hash']}  c.mcap\n", said)


# --- how they differ ---


@pytest.fixture
def pair(tmp_path):
    """Write two logs whose plant.u and plant.x_a are apart by 1 and 1e-3."""
    rows = np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)
    record(tmp_path / "a.mcap", rows=rows)
    rows[50, 0] += 1.0
    rows[60, 2] += 1e-3
    record(tmp_path / "b.mcap", rows=rows)


@pytest.mark.usefixtures("pair")
@pytest.mark.parametrize(
    ("options", "code", "cells"),
    [
        ("", 1, ["outside", "1"]),
        ("--atol 10", 0, ["within", "1"]),
        ("--tol *=1e-2 --tol plant.u=1.5", 0, ["within", "1.5", "1"]),
    ],
)
def test_tolerances_decide_the_exit_code_of_diff(call, options, code, cells):
    """1 outside, 0 within; those of single signals are in the table, then."""
    found, out, err = call("diff", "a.mcap", "b.mcap", *options.split())
    assert (found, err) == (code, "")
    header, first = (line.split("\t") for line in out.splitlines()[:2])
    assert ("tolerance" in header) == ("--tol" in options)
    assert first[: 1 + len(cells)] == ["plant.u", *cells]


@pytest.mark.usefixtures("pair")
def test_the_worst_signal_is_drawn(call, tmp_path, monkeypatch):
    """Its picture is named on stdout, but in JSON; of equal logs there is none, which is said."""
    drawn = []
    monkeypatch.setattr(
        "cosim.report.plots.runs.plot_difference",
        lambda difference, logs, out: drawn.append((difference.worst.signal, str(out))),
    )
    code, out, err = call("diff", "a.mcap", "b.mcap", "--plot", "d.png")
    assert (code, out.splitlines()[-1], err) == (1, "d.png", "")
    assert json.loads(call("diff", "a.mcap", "b.mcap", "--json", "--plot", "e.png")[1])
    assert drawn == [("plant.u", "d.png"), ("plant.u", "e.png")]
    code, _, err = call("diff", "a.mcap", "a.mcap", "--plot", "f.png")
    assert (code, err) == (0, "f.png: not drawn, as the largest difference of two values is 0\n")
    assert len(drawn) == 2


@pytest.mark.usefixtures("files")
def test_diff_says_where_it_compares(call):
    """Rows and signals that one log has not are not equal: they are not there."""
    code, out, _ = call("diff", "part.mcap", "a.mcap")
    assert code == 0
    assert "u.y\tnot recorded in a" in out
    note = "note: compared only where both have values: {} instants ({} in a, {} in b)"
    assert note.format("plant.u at 11", 11, 101) in out.splitlines()
    assert "note: compared" not in call("diff", "a.mcap", "a.mcap")[1]
    call("run", "academic", "--stop", "0.2", "--out", "longer.mcap")
    code, out, _ = call("diff", "a.mcap", "longer.mcap")
    assert code == 1
    assert note.format("u.y at 101", 101, 201) in out.splitlines()


def test_the_help_of_diff_says_that_nothing_is_tolerated(call):
    """By default, neither absolutely nor relatively."""
    assert call("diff", "--help")[1].count("[default: 0.0]") == 2


# --- for other tools ---


def test_cat_prints_the_rows_that_are_chosen(call, tmp_path):
    """With the header; times are exact. Signals may be given one by one, rows as JSON lines."""
    rows = record(tmp_path / "a.mcap", steps=20)
    code, out, err = call("cat", "a.mcap", "--signals", "plant.n,plant.u", "--from", "0.008")
    assert (code, err) == (0, "")
    header, *lines = out.splitlines()
    assert header == "t [s],plant.n,plant.u [m/s]"
    assert lines[0] == f"0.008,{float(rows[8, 4])!r},{float(rows[8, 0])!r}"
    assert [line.split(",")[0] for line in lines] == [f"{k / 1000}" for k in range(8, 21)]
    again = call("cat", "a.mcap", "--signals=plant.n", "--signals=plant.u", "--format", "jsonl")
    assert json.loads(again[1].splitlines()[1])["t"] == 0.001


@pytest.mark.usefixtures("files")
def test_a_span_without_rows_is_said_with_that_of_the_log(call):
    """The header is printed all the same; of a log whose span is not chosen nothing is said."""
    header = call("cat", "a.mcap")[1].splitlines()[0]
    said = "a.mcap from 5 s: no rows in this span; a.mcap has rows from 0.0 s to 0.1 s\n"
    assert call("cat", "a.mcap", "--from", "5") == (0, f"{header}\n", said)
    assert call("cat", "a.mcap", "--from", "5", "--format", "jsonl") == (0, "", said)
    call("cut", "a.mcap", "--from", "0.02", "--to", "0.05", "--out", "c.mcap")
    err = call("cat", "c.mcap", "--to", "0.0105", "--signals", "plant.y")[2]
    assert "c.mcap has rows from 0.02 s to 0.05 s" in err
    for span in (["--from", "0.1"], ["--to", "0"], []):
        assert call("cat", "a.mcap", *span)[2] == ""


def test_a_span_has_all_digits_of_its_times(call, tmp_path):
    """Of nanoseconds since 1970, which doubles do not tell apart."""
    times = [1764570000123456788 + k for k in range(4)]
    write_json(tmp_path / "r.mcap", {"/r": [(t, {"y": float(k)}) for k, t in enumerate(times)]})
    span = ("--from", "1764570000.123456789", "--to", "1764570000.123456790")
    rows = ["1764570000.123456789,1.0", "1764570000.12345679,2.0"]
    assert call("cat", "r.mcap", *span)[1].splitlines()[1:] == rows
    assert call("convert", "r.mcap", "r.csv", *span)[0] == 0
    assert (tmp_path / "r.csv").read_text().splitlines()[1:] == rows


@pytest.mark.usefixtures("files")
def test_all_that_is_recorded_is_what_commands_take_by_default(call):
    """Of a partial log."""
    header, *rows = call("cat", "part.mcap")[1].splitlines()
    assert header.endswith("plant.x_a[0],plant.x_a[1],plant.x_b,observer.delta")
    assert [row.partition(",")[0] for row in rows[:3]] == ["0.0", "0.01", "0.02"]
    assert len(rows) == 11
    for command in ("convert part.mcap a.csv", "plot part.mcap --out a.svg"):
        out = command.split()[-1]
        assert call(*command.split()) == (0, f"{out}\n", "")


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("link", [os.link, os.symlink])
@pytest.mark.parametrize("command", ["convert a.csv OUT", "cut a.mcap --from 0 -o OUT"])
def test_a_command_does_not_write_over_its_input(call, link, command):
    """Also under another name of the file; the content stays."""
    call("convert", "a.mcap", "a.csv")
    source = Path(command.split()[1])
    content = source.read_bytes()
    link(source, source.with_stem("c"))
    for out in (source, source.with_stem("c")):
        code, printed, err = call(*command.replace("OUT", out.name).split(), "--force")
        assert (code, printed) == (2, "")
        assert f"{source} is an input of {out} and cannot be replaced by it" in err
        assert out.read_bytes() == content


FOLLOW = [sys.executable, "-m", "cosim", "cat", "a.mcap", "--follow"]


@pytest.fixture
def following(tmp_path):
    """Follow a log of 20 steps in a process; give that, what it printed, more rows, the end."""
    first, second = blocks(table(layout(), 40), 20)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": tmp_path}
    with ExitStack() as stack:
        recorder = stack.enter_context(McapRecorder(tmp_path / "a.mcap", flush=1e-3))
        recorder.begin(plan())
        recorder.write(*first)
        with subprocess.Popen(FOLLOW, **pipes) as process:
            lines = [process.stdout.readline() for _ in range(22)]
            assert lines[0].startswith(b"t [s],plant.u")
            yield process, lines, partial(recorder.write, *second), stack.close
            process.kill()


@pytest.mark.slow
def test_a_log_is_followed_until_its_run_ends(following, tmp_path):
    """Each flush is printed while the run goes on, and the whole is what ``cat`` prints later."""
    process, lines, write_more, end = following
    write_more()
    lines.append(process.stdout.readline())
    end()
    lines += process.stdout.readlines()
    assert (process.wait(60), process.stderr.read()) == (0, b"")
    later = subprocess.run(FOLLOW[:-1], check=True, capture_output=True, cwd=tmp_path).stdout
    assert b"".join(lines) == later


@pytest.mark.slow
@pytest.mark.parametrize("code", [130, 141], ids=["Ctrl-C", "a closed pipe"])
def test_following_ends_without_a_word(following, code):
    """With the exit code of Ctrl-C, or at the next row that nobody reads."""
    process, _, write_more, _ = following
    if code == 130:
        process.send_signal(signal.SIGINT)
    else:
        process.stdout.close()
        write_more()
    assert (process.wait(60), process.stderr.read()) == (code, b"")


# --- logs from logs ---


def test_rows_that_damage_cost_are_shown(call, tmp_path):
    """By component, with their times, as a table or JSON; the recovered log is partial."""
    record(tmp_path / "a.mcap", steps=20_000)  # several chunks
    with (tmp_path / "a.mcap").open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 30] ^= 1
    (tmp_path / "broken.mcap").write_bytes(data)
    recover = ("recover", "broken.mcap", "-o", "good.mcap")
    code, out, err = call(*recover)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "component\trows\tlost"
    assert lines[-1] == "good.mcap: partial, recovered from broken.mcap"
    assert "the scenario is lost: the log can be read, but not replayed" in lines
    assert cosim.open_log("good.mcap").status == "partial"
    assert call(*recover)[0] == 2
    shown = json.loads(call(*recover, "--force", "--json")[1])
    assert shown["status"] == "partial"
    first = next(own["lost"] for own in shown["components"].values() if own["lost"])[0]
    assert f"{first['rows']} from {first['from']} s to {first['to']} s" in out
    (tmp_path / "broken.mcap").write_bytes(data[: len(data) * 3 // 4])
    out = call(*recover, "--force")[1]
    assert "are lost, too: the file has no end" in out
    assert "messages, events or substeps are lost, too, or their number is unknown" in out


# --- metrics ---


@pytest.mark.usefixtures("files")
def test_expressions_may_have_names(call):
    """The first sign of equality ends one, unless it is a comparison; every digit is printed."""
    expressions = ["count(t, t >= 0)", "n = count(t, t == 0)", "a b=last(t)", "x = first(t, t < 0)"]
    values = json.loads(call("metrics", "a.mcap", *expressions, "--json")[1])
    assert values == {"count(t, t >= 0)": 101.0, "n": 1.0, "a b": 0.1, "x": None}
    printed = call("metrics", "a.mcap", *expressions)[1]
    assert printed.splitlines() == ["count(t, t >= 0)\t101.0", "n\t1.0", "a b\t0.1", "x\tno value"]
    assert cosim.metrics("a.mcap", {"a b": "last(t)"}) == {"a b": 0.1}


@pytest.mark.usefixtures("files")
def test_rows_that_a_log_lacks_are_said(call):
    """The metrics are those of the rows that it has."""
    code, out, err = call("metrics", "part.mcap", "count(plant.y)")
    assert (code, out) == (0, "count(plant.y)\t11.0\n")
    assert "part.mcap has rows at every 10 steps only; metrics of the whole run" in err
    call("cut", "a.mcap", "--to", "0.05", "--out", "c.mcap")
    assert "c.mcap is a part of the log of its run" in call("metrics", "c.mcap", "last(t)")[2]
