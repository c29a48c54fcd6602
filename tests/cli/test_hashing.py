"""``cosim hash``: the content hash, computed and compared with the recorded one."""

import json

from cosim.log import open_log
from tests.log.crafting import change_rows, put_together, take_apart
from tests.log.recordings import record


def test_the_hash_of_a_log_is_printed(call, tmp_path):
    """As by sha256sum: the hash, two blanks, the path."""
    record(tmp_path / "a.mcap", steps=50)
    log = open_log("a.mcap")
    assert call("hash", "a.mcap") == (0, f"{log.recorded_hash}  a.mcap\n", "")
    code, out, _ = call("hash", "a.mcap", "--signals")
    lines = [line.split("  ", 1) for line in out.splitlines()]
    assert code == 0
    assert lines[0] == [log.recorded_hash, "a.mcap"]
    assert {name: digest for digest, name in lines[1:]} == log.signal_hashes()


def test_compression_and_chunks_do_not_change_it(call, tmp_path):
    """A log that another tool has written anew passes, too."""
    rows = record(tmp_path / "a.mcap", steps=50)
    record(tmp_path / "b.mcap", rows=rows, compression="none", size=7)
    put_together(take_apart(tmp_path / "a.mcap"), tmp_path / "c.mcap", chunk_size=500)
    hashes = [call("hash", f"{name}.mcap", "--signals") for name in "abc"]
    assert [code for code, _, _ in hashes] == [0, 0, 0]
    lines = [
        out.replace(f"{name}.mcap", "") for (_, out, _), name in zip(hashes, "abc", strict=True)
    ]
    assert lines[0] == lines[1] == lines[2]


def test_a_changed_value_is_said_and_exits_with_1(call, tmp_path):
    """All checksums of the file fit; the recorded hash does not."""
    record(tmp_path / "a.mcap", steps=50)
    content = take_apart(tmp_path / "a.mcap")

    def change(number, values):
        if number == 30:
            values[1] += 1e-15

    change_rows(content, "plant", change)
    put_together(content, tmp_path / "b.mcap")
    code, out, err = call("hash", "b.mcap")
    recorded = open_log("a.mcap").recorded_hash
    assert code == 1
    assert out.split()[1] == "b.mcap"
    assert recorded not in out
    assert err == (
        f"b.mcap: the content hash differs from the recorded {recorded}: its signals were changed "
        "after recording\n"
    )
    shown = json.loads(call("hash", "b.mcap", "--json", "--signals")[1])
    assert (shown["recorded"], shown["equal"]) == (recorded, False)
    known = json.loads(call("hash", "a.mcap", "--json", "--signals")[1])
    assert known["equal"]
    differ = [name for name in known["signals"] if shown["signals"][name] != known["signals"][name]]
    assert differ == ["plant.x_a"]
    assert "signals" not in json.loads(call("hash", "a.mcap", "--json")[1])


def test_a_log_without_a_recorded_hash_is_said_to_have_none(call, tmp_path):
    """Another tool may leave it out; there is nothing that it could differ from."""
    record(tmp_path / "a.mcap", steps=50)
    recorded = open_log("a.mcap").recorded_hash
    content = take_apart(tmp_path / "a.mcap")
    content.metadata = [item for item in content.metadata if item[0] != "cosim.result"]
    put_together(content, tmp_path / "b.mcap")
    code, out, err = call("hash", "b.mcap")
    assert (code, out) == (0, f"{recorded}  b.mcap\n")
    assert err == "b.mcap: no content hash was recorded\n"


def test_a_file_that_is_no_log_exits_with_2(call, tmp_path):
    """One line, no traceback."""
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    for name in ("a.mcap", "b.mcap", "academic"):
        code, out, err = call("hash", name)
        assert (code, out) == (2, "")
        assert err.startswith("cosim: ")
        assert err.count("\n") == 1
