"""A replay of a long log takes no more memory than one of a short log, and prints the same."""

import json
import tracemalloc

import pytest

import cosim
from cosim.blocks import recorded_rows
from cosim.cli.app import main
from cosim.core.stages import engine
from cosim.log import open_log, store
from cosim.log import rows as log_rows
from cosim.report import recorded_rows as report_rows
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.recordings import recorded_scenario
from tests.log.recordings import make_chunks_small

SCENARIO = """
scenario = { name = "loop", stop = 10.0, step = 1e-3 }
[models.academic]
n_a = 2
A  = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
Bu = [[0], [2], [1]]
Bd = [[1], [0], [0]]
C  = [[2, 0, 1]]
[components]
u = { kind = "sine", amplitude = 1.0, rate = 3.0 }
d = { kind = "sine", amplitude = 0.5, rate = 20.0 }
plant = { kind = "descriptor", model = "academic", x_a0 = [1.0, -1.0] }
[components.observer]
kind = "unknown-input-observer"
model = "academic"
L = [4.0, 0.0]
filter = "savitzky-golay"
half_width = 0.2
[connections]
"plant.u" = "u.y"
"plant.delta" = "d.y"
"observer.u" = "u.y"
"observer.y" = "plant.y"
[truth]
"observer.delta" = "d.y"
"observer.x_a" = "plant.x_a"
"""


@pytest.fixture
def small_limits(monkeypatch):
    """Let a log of 10 000 steps be a large one."""
    monkeypatch.setattr(recorded_rows, "_MOST_BYTES", 2**14)
    monkeypatch.setattr(recorded_rows, "_LEAST_BYTES", 2**14)
    monkeypatch.setattr(report_rows, "_PART_STEPS", 2**10)
    monkeypatch.setattr(recorded_scenario, "_LARGE", 0)
    monkeypatch.setattr(engine, "BLOCK_BYTES", 2**16)
    make_chunks_small(monkeypatch, 2**16)
    monkeypatch.setattr(store, "_LARGEST_FLUSH", 2**18)
    monkeypatch.setattr(store, "_BUFFER_BYTES", 2**18)
    for limit in ("_MOST_WHOLE", "_MOST_KEPT"):
        monkeypatch.setattr(log_rows, limit, 2**14)


def recorded(folder, stop):
    """Record a run in small chunks; return its path."""
    (folder / "loop.toml").write_text(SCENARIO)
    path = folder / f"{stop}.mcap"
    with pytest.MonkeyPatch.context() as patch:
        make_chunks_small(patch, 2**16)
        cosim.run(folder / "loop.toml", out=path, set={"scenario.stop": stop})
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run of 10 000 steps; return its path."""
    return recorded(tmp_path_factory.mktemp("log"), 10.0)


@pytest.fixture(scope="module")
def long_log(tmp_path_factory):
    """Record a run of 40 000 steps; return its path."""
    return recorded(tmp_path_factory.mktemp("long"), 40.0)


def output_of(capsys, *arguments):
    """Return what a command prints, but its wall time."""
    with pytest.raises(SystemExit) as ended:
        main(["replay", *map(str, arguments), "--json"])
    assert not ended.value.code
    content = json.loads(capsys.readouterr().out)
    content.pop("wall", None)
    return content


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [[], ["--verify"]])
def test_a_replay_in_parts_prints_what_one_in_memory_does(log, capsys, request, arguments):
    """Errors of an estimate that lags too; root mean squares are sums in another order."""
    whole = output_of(capsys, log, *arguments)
    request.getfixturevalue("small_limits")
    in_parts = output_of(capsys, log, *arguments)
    sums = [
        [s.pop("rms", 0.0) for s in content.get("signals", [])] for content in (whole, in_parts)
    ]
    assert sums[1] == pytest.approx(sums[0], rel=1e-12)
    assert in_parts == whole
    assert in_parts.get("log") is None


@pytest.mark.slow
@pytest.mark.usefixtures("small_limits")
def test_the_memory_of_a_replay_does_not_grow_with_its_log(log, long_log, tmp_path):
    """Four times as long a log takes a tenth of its further rows at most."""
    peaks = []
    for number, path in enumerate((log, log, long_log)):  # the first one imports
        source = open_log(path)
        tracemalloc.start()
        again = cosim.replay(source, out=tmp_path / f"{number}.mcap")
        assert verify(source, again).passed
        summarize(again)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    added_bytes = open_log(long_log).row_bytes - open_log(log).row_bytes
    # The summaries of both logs have 250 bytes for each of their chunks of 64 kB.
    assert peaks[2] - peaks[1] < added_bytes / 10
