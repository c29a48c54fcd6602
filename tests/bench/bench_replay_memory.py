"""What memory a replay of a log of 1 GB takes, with and without ``--verify``.

A loop of plant, observer and controller is recorded over two million steps and more. Run with
``python tests/bench/bench_replay_memory.py [FOLDER]``; it takes minutes, and 4 GB of disk. The
identifier of the shipped scenarios is left out: what it concludes rests on all samples at once.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from importlib import resources
from pathlib import Path

STEPS = 2_900_000
LEFT_OUT = ("regressor", "identifier")
MEASURED = """
import sys
from cosim.cli.app import main
try:
    main(sys.argv[1:])
finally:
    import resource
    sys.stderr.write(f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}")
"""


def scenario_text() -> str:
    """Return the shipped closed loop without what identifies its disturbance."""
    text = (resources.files("cosim.scenario") / "library" / "closed-loop.toml").read_text()
    kept = []
    is_kept = True
    for line in text.splitlines():
        if line.startswith("["):
            is_kept = line.split("]")[0] not in {f"[components.{name}" for name in LEFT_OUT}
        if is_kept and not line.startswith(tuple(f'"{name}.' for name in LEFT_OUT)):
            kept.append(line)
    tomllib.loads("\n".join(kept))
    return "\n".join(kept)


def peak_of(*arguments: str) -> float:
    """Return the largest resident memory of a command [MB]."""
    command = [sys.executable, "-c", MEASURED, *arguments, "--quiet"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(done.stderr.rpartition("peak ")[2]) / 1024


def main() -> None:
    """Print the memory of replays of a short log and of one of 1 GB."""
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as folder:
        scenario = Path(folder) / "loop.toml"
        scenario.write_text(scenario_text())
        logs = []
        for steps in (10, STEPS):
            log = Path(folder) / f"{steps}.mcap"
            stop = f"--stop={steps / 1000}"
            peak = peak_of("run", str(scenario), stop, f"--out={log}")
            print(f"run of {steps} steps, {log.stat().st_size / 1e6:.1f} MB: {peak:.0f} MB")
            logs.append(log)
        for options in ([], ["--verify"]):
            short, long = (peak_of("replay", str(log), *options) for log in logs)
            named = " ".join(["replay", *options])
            print(f"{named}: {long:.0f} MB, {long - short:.0f} MB more than of 10 steps")


if __name__ == "__main__":
    main()
