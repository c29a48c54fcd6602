"""``cosim run --rotate``, and what is done with its files."""

import json
import re

import pytest

RUN = ("run", "academic", "--stop", "1")
ROTATED = (*RUN, "--rotate", "0.4s", "--out", "run.mcap")


@pytest.mark.slow
def test_the_files_and_the_end_of_the_whole_run_are_shown(call, tmp_path):
    """Of no file alone; together they are the log of the run."""
    code, out, err = call(*ROTATED)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "status\tcomplete"
    assert lines[1] == "steps\t1000, up to 1.0 s"
    names = ["run.mcap", "run.part2.mcap", "run.part3.mcap"]
    assert lines[3:6] == [f"log\t{name}" for name in names]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert call("merge", *names, "-o", "whole.mcap") == (0, "whole.mcap: complete\n", "")
    digest = lines[2].removeprefix("content hash\t")
    assert call("hash", "whole.mcap")[1] == f"{digest}  whole.mcap\n"
    assert call("replay", "run.part3.mcap", "--verify")[0] == 0
    assert call("replay", "run.part2.mcap", "--verify")[0] == 0
    code, out, _ = call("info", "run.part2.mcap")
    assert code == 0
    assert "part 2 of its log, from 0.4 s to 0.799 s" in out


def test_json_has_the_results_of_the_whole_run(call):
    """With the files."""
    code, out, _ = call(*ROTATED, "--json")
    shown = json.loads(out)
    assert (code, shown["status"], shown["steps"], shown["end"]) == (0, "complete", 1000, 1.0)
    assert shown["logs"] == ["run.mcap", "run.part2.mcap", "run.part3.mcap"]
    assert "u.y" in shown["results"]["last"]
    assert call(*ROTATED, "--force", "--quiet") == (0, "", "")


def test_a_run_within_the_limit_is_shown_as_ever(call, tmp_path):
    """It has one file."""
    code, out, _ = call(*RUN, "--rotate", "3s", "--out", "run.mcap")
    assert code == 0
    assert out.splitlines()[-1] == "log\trun.mcap"
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_wrong_use_of_rotate_exits_with_2(call):
    """One line on stderr, nothing on stdout."""
    call(*ROTATED, "--quiet")
    for options, text in [
        (("a.mcap", "--rotate", "1 MiBi"), "--rotate: .*'1 MiBi'"),
        (("run.mcap", "--rotate", "0.1s"), r"run\.mcap exists; choose another path, or --force"),
        (("a.mcap", "--rotate", "0.1s", "--rotate", "2s"), "--rotate: .*given 2 times"),
    ]:
        code, out, err = call(*RUN, "--out", *options)
        assert (code, out) == (2, "")
        assert re.search(text, err)
        assert err.count("\n") == 1


def test_a_run_that_fails_names_its_last_file(call, tmp_path):
    """The rows before are in others."""
    (tmp_path / "bad.toml").write_text(
        '[scenario]\nname = "bad"\nstop = 1.0\nstep = 0.01\n'
        '[components.u]\nkind = "expression"\ny = "log(0.5 - t)"\n'
    )
    code, _, err = call("run", "bad.toml", "--out", "bad.mcap", "--rotate", "0.2s")
    assert code == 1
    assert err.splitlines()[-1] == (
        "cosim: bad.part3.mcap is the last of several files, which hold the run up to t = 0.49 s"
    )
    names = ["bad.mcap", "bad.part2.mcap", "bad.part3.mcap"]
    assert call("merge", *names, "-o", "whole.mcap")[1].startswith("whole.mcap: failed, 'u.y'")
