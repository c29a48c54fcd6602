"""What every driver reads and prints; only the standard library, as it runs in any environment.

Reads one JSON object from standard input::

    lags            list of {"name", "fmu", "binary", "source"}, the source a number or null
    fmi_version     "2" or "3"
    interface_type  "cs" or "me"
    method          "cs", or the solver of model exchange
    step_ns         communication step [ns]
    steps           how many of them
    samples         numbers of the steps whose outputs are compared
    folder          an empty folder for its files

Prints a line with ``MARK`` and ``{"seconds", "samples"}``: the processor time of all threads of the
process from behind the initialization to the last step, what is kept of it included [s]; and pairs
of a step and the outputs of all lags there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

MARK = "measured: "  # masters print lines of their own


def task() -> dict[str, Any]:
    """Read what is to be run."""
    read: dict[str, Any] = json.load(sys.stdin)
    return read


def report(seconds: float, samples: Sequence[tuple[int, Sequence[float]]]) -> None:
    """Print the result."""
    pairs = []
    for step, outputs in samples:
        pairs.append([step, [float(value) for value in outputs]])
    print(f"\n{MARK}{json.dumps({'seconds': seconds, 'samples': pairs})}", flush=True)


def refuse(reason: str) -> None:
    """End the process: this master does not do that."""
    sys.exit(f"not available: {reason}")
