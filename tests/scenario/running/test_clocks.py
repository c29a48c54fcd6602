"""Clocks of FMUs in a scenario: one content hash, replays, both values of a jump."""

import pytest

import cosim
from cosim.report.verification import verify
from tests.fmi import clocked

SCENARIO = """
actions = [
  { at = 1.0, signal = "b.in", override = 1.0 },
  { at = 1.08, signal = "b.in", release = true },
]
scenario = { name = "clocks", stop = 2.0, step = 0.04 }
[components]
u = { kind = "sine", rate = 1.0 }
a = { kind = "fmu", path = "a.fmu", interface_type = "A" }
b = { kind = "fmu", path = "b.fmu", interface_type = "B" }
[connections]
"a.u" = "u.y"
"b.in" = "a.out"
"b.v" = "a.shown"
"""


@pytest.mark.parametrize("types", [("cs", "me"), ("me", "cs")])
def test_clocks_between_fmus(types, tmp_path):
    """In blocks of any length; a clock that is overridden ticks, with both values in the log."""
    can = ("any step", "events", "state")
    clocked.build(tmp_path / "a.fmu", "sample", "out", can=can)
    clocked.build(tmp_path / "b.fmu", "in", "later", can=can)
    path = tmp_path / "clocks.toml"
    text = SCENARIO.replace('"A"', f'"{types[0]}"').replace('"B"', f'"{types[1]}"')
    path.write_text(text, encoding="utf-8")
    logs = []
    for block in (None, 1, 7):
        out = tmp_path / f"{block}.mcap"
        logs.append(cosim.run(path, out=out, block=block))
    assert len({log.content_hash() for log in logs}) == 1
    log = logs[0]
    # out ticks at 0.1 s, 0.3 s, ...: it is 1 at the ends of steps of 40 ms, 0.12 s, 0.32 s, ...
    ends = [(100 + 200 * i + 39) // 40 for i in range(10)]
    assert [k for k, tick in enumerate(log["a.out"]) if tick] == ends
    # Beside them b ticks at 1 s, behind the row there, and at 1.04 s.
    before = sum(end <= 25 for end in ends)
    assert log["b.in_count"][25] == before
    assert log["b.in_count"][26] == before + 2
    events = [event for event in log.events() if event.time_ns == 1_000_000_000]
    assert [(event.cause, event.signal, event.values) for event in events] == [
        ("override", "b.in", (1.0,)),
        ("follow", "b.in_count", (before + 1.0,)),
    ]
    assert verify(log, cosim.replay(log)).passed
