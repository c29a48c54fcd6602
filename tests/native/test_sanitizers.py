"""The compiled master has no memory error, no undefined behavior and no data race.

A driver in C is compiled with each sanitizer and run; what the sanitizers find ends it with an
error. Its numbers are those of a plain computation here.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from cosim.native import build

DRIVER = Path(__file__).parent / "c" / "stage_driver.c"
SOURCES = ("stage.c", "loop_solver.c", "linear.c")
LAGS = 20
STEPS = 500

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc'")


def compiled(folder, *options):
    """Return the driver, compiled with some options; skip where the compiler lacks them."""
    target = folder / "driver"
    sources = [str(build.source(name)) for name in SOURCES]
    command = ["cc", "-std=gnu11", "-g", "-O1", "-ffp-contract=off", "-pthread", *build.INCLUDES]
    command += ["-Wall", "-Werror", *options, str(DRIVER), *sources, "-o", str(target), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode and "cannot find" in result.stderr:
        pytest.skip(f"the libraries of {options} are not installed")
    assert result.returncode == 0, result.stderr
    return target


def last_row():
    """Compute the last row of the driver's system step by step."""
    states = [1.0 + i for i in range(LAGS)]
    outputs = [*states, 0.0, 0.0]
    inputs = [0.0] * (LAGS + 2)
    ring = [0.0] * 4
    for _ in range(STEPS):
        new_inputs = list(inputs)
        for i in range(LAGS):
            new_inputs[i] = outputs[i - 1] if i else outputs[LAGS + 1]
            states[i] = 0.998 * states[i] + 0.001 * inputs[i] + 0.001 * new_inputs[i]
            outputs[i] = states[i]
        new_inputs[LAGS] = outputs[LAGS - 1]
        ring.append(inputs[LAGS])
        outputs[LAGS] = ring[-4]
        new_inputs[LAGS + 1] = 0.1 + 0.5 * outputs[3] + -0.25 * outputs[LAGS]
        outputs[LAGS + 1] = 0.5 * new_inputs[LAGS + 1]
        new_inputs[0] = outputs[LAGS + 1]  # the first lag is refreshed
        inputs = new_inputs
    row = []
    for u, y in zip(inputs, outputs, strict=True):
        row += [u, y]
    return row


@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_two_stages_in_two_threads_are_clean(tmp_path, sanitizer):
    """Under the address, undefined-behavior and thread sanitizers, with the right numbers."""
    driver = compiled(tmp_path, f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all")
    result = subprocess.run([driver], capture_output=True, text=True, check=False, timeout=120)
    if "unexpected memory mapping" in result.stderr:
        pytest.skip("this kernel's memory layout is not that of the thread sanitizer")
    assert result.returncode == 0, result.stderr
    values = [float.fromhex(line) for line in result.stdout.split()]
    assert values == last_row() * 2
