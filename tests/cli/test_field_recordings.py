"""Recordings of other tools from the command line: swapped in, replayed, shown."""

from __future__ import annotations

import json

import pytest

from tests.scenario.field_recordings import LOOP, field_log

MAPS = ("--map", "plant.y=/drive/state.position", "--map", "plant.u=[/cmd.values[0]]")


@pytest.fixture
def files(tmp_path):
    """Write a scenario and a recording to the working directory."""
    (tmp_path / "loop.toml").write_text(LOOP, encoding="utf-8")
    field_log(tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_a_recording_takes_the_place_of_the_plant(call, tmp_path):
    """As any file does, and says what that means."""
    code, out, err = call("run", "loop.toml", "--swap", "plant=field.mcap", *MAPS)
    assert code == 0, err
    assert "plant.u" in out
    assert "take it in the place of command.y" in err
    code, out, err = call("run", "loop.toml", "--swap", "plant=field.mcap", *MAPS, "--dry-run")
    assert code == 0, err
    assert "plant.y -> /drive/state.position" in out


@pytest.mark.usefixtures("files")
def test_a_recording_is_replayed_with_its_scenario(call):
    """--scenario and --map; without them, and with --verify, the way out is said."""
    names = ("--scenario", "loop.toml", *MAPS)
    code, out, err = call("replay", "field.mcap", *names, "--set", "model.time_constant=0.1")
    assert code == 0, err
    assert "model.y" in out
    code, _, err = call("replay", "field.mcap", *MAPS)
    assert code == 2
    assert "was written by another tool and has no scenario; expected --scenario" in err
    code, out, err = call("replay", "field.mcap", *names, "--vary", "model.time_constant=0.1,0.2")
    assert code == 0, err
    assert "model.time_constant" in out
    code, _, err = call("replay", "field.mcap", *names, "--out", "once.mcap")
    assert code == 0, err
    vary = ("replay", "once.mcap", "--vary", "model.time_constant=0.1,0.2", "--out", "sweep")
    code, out, err = call(*vary)
    assert code == 0, err
    code, _, err = call(*vary, "--scenario", "loop.toml")
    assert code == 2
    assert "once.mcap has its own scenario; omit --scenario" in err
    code, _, err = call("replay", "field.mcap", *names, "--verify")
    assert code == 2
    assert "--verify compares with a log of cosim; field.mcap is of another tool" in err


@pytest.mark.usefixtures("files")
def test_info_shows_topics_and_fields(call):
    """Of a recording of another tool, as tables and as JSON."""
    code, out, err = call("info", "field.mcap")
    assert code == 0, err
    assert "/drive/state.position" in out
    assert "100 Hz" in out
    code, out, _ = call("info", "field.mcap", "--json")
    assert code == 0
    assert {"field": "/cmd.values[0:2]", "type": "number"} in json.loads(out)["fields"]


@pytest.mark.usefixtures("files")
def test_recordings_are_compared_as_plants_are(call, tmp_path):
    """Each takes the entries of the map that are its own: fields, and columns of a table."""
    rows = [f"{0.01 * i},{0.5 * i}" for i in range(320)]
    (tmp_path / "field.csv").write_text("\n".join(["t,level", *rows]), encoding="utf-8")
    text = LOOP + '\n[truth]\n"error.y" = "model.y"\n'
    (tmp_path / "loop.toml").write_text(text, encoding="utf-8")
    swaps = ("--swap", "plant=field.mcap", "--swap", "plant=field.csv")
    names = ("--map", "plant.y=/drive/state.position", "--map", "error.u1=level")
    code, out, err = call("compare", "loop.toml", *swaps, *names)
    assert code == 0, err
    assert "field.csv" in out or "field-2" in out
    code, _, err = call("compare", "loop.toml", *swaps, "--map", "plant.y=/other.position")
    assert code == 2
    assert "no alternative has a port '/other.position'" in err
