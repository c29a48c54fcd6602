"""What one of 100, 1000 and 3000 components costs a user: processor time, and its ratios.

Run with ``python tests/bench/bench_growth.py``. A scenario file with a chain of lags, and one with
a star of them: read, run for 100 steps, replayed, compared, hashed, described. The smallest of
three, in turn: other processes, and a processor that changes its speed, only add time.
"""

import contextlib
import gc
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cosim
from cosim.cli import main as command

RUNS = 3
COUNTS = (100, 1000, 3000)
HEAD = """
[scenario]
name = "growth"
stop = 0.1
step = 0.001
[components]
r = { kind = "sine", rate = 1.0 }
"""


def scenario(count: int, *, chained: bool) -> str:
    """Return a chain of lags, or as many behind one source."""
    lines = [HEAD]
    for i in range(count):
        lines.append(f'x{i} = {{ kind = "lag", time_constant = 0.5 }}')
    lines.append("[connections]")
    for i in range(count):
        source = f"x{i - 1}.y" if chained and i else "r.y"
        lines.append(f'"x{i}.u" = "{source}"')
    return "\n".join(lines)


def one_by_one(path: Path) -> None:
    """Read the rows of one component after another."""
    log = cosim.open_log(path)
    for name in log.channels:
        log.rows(name)


def info(path: Path) -> None:
    """Print what ``cosim info`` prints, to nowhere."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        command(["info", str(path)])


def costs(count: int, folder: Path, *, chained: bool) -> dict[str, float]:
    """Return the processor time [ms] of each step on the way, for each component."""
    source = folder / "growth.toml"
    source.write_text(scenario(count, chained=chained))
    first = folder / "first.mcap"
    again = folder / "again.mcap"
    steps: dict[str, Callable[[], object]] = {
        "load": lambda: cosim.load(source),
        "run": lambda: cosim.run(source, out=first, force=True),
        "replay": lambda: cosim.replay(first, out=again, force=True),
        "open": lambda: cosim.open_log(first),
        "open and hash": lambda: cosim.open_log(first).content_hash(),
        "rows one by one": lambda: one_by_one(first),
        "diff": lambda: cosim.diff(cosim.open_log(first), cosim.open_log(again)),
        "info": lambda: info(first),
    }
    spent = {}
    for name, step in steps.items():
        gc.collect()
        began = time.process_time()
        step()
        spent[name] = (time.process_time() - began) / count * 1e3
    return spent


def main() -> None:
    """Print times and ratios."""
    with tempfile.TemporaryDirectory() as folder:
        costs(10, Path(folder), chained=True)  # imports
        for chained in (True, False):
            print("chain" if chained else "star")
            samples: dict[int, list[dict[str, float]]] = {count: [] for count in COUNTS}
            for _ in range(RUNS):
                for count in COUNTS:
                    samples[count].append(costs(count, Path(folder), chained=chained))
            for name in samples[COUNTS[0]][0]:
                smallest = []
                for count in COUNTS:
                    smallest.append(min(sample[name] for sample in samples[count]))
                times = " ".join(f"{time:7.3f} ms" for time in smallest)
                ratios = " ".join(f"x{time / smallest[0]:.2f}" for time in smallest[1:])
                print(f"  {name:16s} {times}  {ratios}")


if __name__ == "__main__":
    main()
