"""A component in Python without a master: its ``advance`` with arrays of the same sizes."""

import time

import numpy as np
import protocol

from tests.bench.masters.core_systems import PythonLag

BLOCK = 10_000  # steps of a call, outside loops


def main() -> None:
    """Run."""
    task = protocol.task()
    block = min(BLOCK, task["steps"]) if task["system"] == "python-cascade" else 1
    h = task["step_ns"] / 1e9
    component = PythonLag()
    component.initialize(0.0, np.zeros(1))
    advance = component.advance
    t = h * np.arange(block + 1)
    u = np.sin(t)[:, np.newaxis]
    calls = task["steps"] // block
    began = time.process_time()
    for _ in range(calls):
        advance(t, h, u)
    seconds = time.process_time() - began
    protocol.report(seconds * task["steps"] / (calls * block), [])


if __name__ == "__main__":
    main()
