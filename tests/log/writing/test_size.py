"""How large a log may become is known before its first row."""

import shutil
from itertools import product
from types import SimpleNamespace

import pytest

import cosim
from cosim.log import McapRecorder
from tests.log.recordings import blocks, layout, make_chunks_small, plan, table

SHAPES = [(0, 0), (0, 1000), (40, 500), (9000, 10)]  # further elements, steps


@pytest.mark.fast("True")
@pytest.mark.parametrize("flushed", [False, True])
def test_no_log_is_larger_than_its_bound(tmp_path, monkeypatch, flushed, subtests):
    """Also with a flush after every step, as of a run with a second of work a step."""
    if flushed:
        make_chunks_small(monkeypatch, 2000)
    for compression, (wide, count) in product(("none", "zstd", "lz4"), SHAPES):
        steps = min(count, 100) if flushed else count
        path = tmp_path / f"{compression} {wide} {steps}.mcap"
        lay = layout(wide=wide)
        flush = 0.0 if flushed else 1.0
        with McapRecorder(path, compression=compression, flush=flush) as recorder:
            recorder.begin(plan(lay))
            bound = recorder.size_bound(steps)
            if steps:
                for block, signals in blocks(table(lay, steps), 1 if flushed else 10):
                    recorder.write(block, signals)
        with subtests.test(case=(compression, wide, steps)):
            assert path.stat().st_size <= bound


@pytest.mark.fast("0-2000")
@pytest.mark.parametrize(("wide", "steps"), [(0, 2000), (9000, 10)])
def test_the_bound_of_a_large_log_is_less_than_twice_its_size(tmp_path, wide, steps):
    """Of an uncompressed one over 1 GB; its size grows as between two short ones."""
    lay = layout(wide=wide)
    sizes = []
    for count in (steps, 2 * steps):
        path = tmp_path / f"{count}.mcap"
        with McapRecorder(path, compression="none") as recorder:
            recorder.begin(plan(lay))
            for block, signals in blocks(table(lay, count), 10):
                recorder.write(block, signals)
        sizes.append(path.stat().st_size)
    step_bytes = (sizes[1] - sizes[0]) / steps
    large = int(1e9 / step_bytes)
    with McapRecorder(tmp_path / "large.mcap", compression="none") as recorder:
        recorder.begin(plan(lay))
        assert large * step_bytes < recorder.size_bound(large) < 2.0 * large * step_bytes


def test_a_large_log_is_announced_before_the_first_step(tmp_path, monkeypatch):
    """Over 1 GB, and where the disk has less; otherwise nothing is said."""

    class Begun(Exception):
        pass

    def stop(time, end):
        raise Begun

    def notices(stop_time, free):
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
        said = []
        with pytest.raises(Begun):
            cosim.run(
                "academic",
                out=tmp_path / "a.mcap",
                force=True,
                set={"scenario.stop": stop_time},
                notice=said.append,
                progress=stop,
            )
        return said

    assert notices(1.0, 10**12) == []
    (text,) = notices(10_000.0, 10**12)
    assert text.startswith(f"{tmp_path}/a.mcap ")
    assert " GB" in text
    (text,) = notices(1.0, 10_000)
    assert text.startswith("warning: ")
    assert "1e-05 GB" in text
