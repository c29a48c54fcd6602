"""The compiled master and reductions have no memory error, no undefined behavior, no data race.

A driver in C is compiled with each sanitizer and run; what the sanitizers find ends it with an
error. Its numbers are those of a plain computation here.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cosim.native import build

DRIVERS = Path(__file__).parent / "c"
SOURCES = {
    "stage_driver.c": ("stage.c", "loop_solver.c", "linear.c"),
    "reductions_driver.c": ("reductions.c", "elementary.c"),
}
LAGS = 20
STEPS = 500

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc'"),
]


def compiled(folder, driver, *options):
    """Return a driver, compiled with some options; skip where the compiler lacks them."""
    target = folder / "driver"
    sources = [str(build.source(name)) for name in SOURCES[driver]]
    command = ["cc", "-std=gnu11", "-g", "-O1", "-ffp-contract=off", "-pthread", *build.INCLUDES]
    command += [
        "-Wall",
        "-Werror",
        *options,
        str(DRIVERS / driver),
        *sources,
        "-o",
        str(target),
        "-lm",
    ]
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
    driver = compiled(
        tmp_path, "stage_driver.c", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all"
    )
    result = subprocess.run([driver], capture_output=True, text=True, check=False, timeout=120)
    if "unexpected memory mapping" in result.stderr:
        pytest.skip("this kernel's memory layout is not that of the thread sanitizer")
    assert result.returncode == 0, result.stderr
    values = [float.fromhex(line) for line in result.stdout.split()]
    assert values == last_row() * 2


def reductions_of(values, t):
    """Return what the driver prints of values, by numpy."""
    chosen = values[~np.isnan(values)]
    shifted = chosen - chosen[0]
    parts = 0.5 * np.diff(t) * (values[:-1] + values[1:])
    sums = [chosen.sum(), (chosen**2).sum(), shifted.sum(), (shifted**2).sum(), np.nansum(parts)]
    outside = np.flatnonzero(np.abs(values - chosen[-1]) > 1e-3)
    behind = np.flatnonzero(~np.isnan(values[outside[-1] + 1 :])) + outside[-1] + 1
    ends = [chosen[0], chosen[-1], chosen.min(), chosen.max()]
    return [len(chosen), *ends, *sums, behind[0]]


def test_reductions_of_blocks_of_rows_are_clean(tmp_path):
    """Under the address and undefined-behavior sanitizers; numpy's sums differ by roundings.

    Each of the 1000 additions rounds a sum of at most 48^2 times 1000.
    """
    options = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    driver = compiled(tmp_path, "reductions_driver.c", *options)
    result = subprocess.run([driver], capture_output=True, text=True, check=False, timeout=120)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[:3] == lines[3:]  # whatever the blocks
    k = np.arange(1000)
    t = k * 10**6 / 1e9
    y = k * k % 97 - 48.0
    gap = np.where(k % 7, 1.0 / (1.0 + k), np.nan)
    is_true = np.concatenate([[False, False], (y > 0)[2:] & (y > 0)[1:-1] & (y > 0)[:-2]])
    for line, values in zip(lines, (y, y + gap, np.where(is_true, gap, np.nan)), strict=False):
        found = [float.fromhex(word) if "x" in word else float(word) for word in line.split()]
        expected = reductions_of(values, t)
        assert found[:5] == expected[:5]
        np.testing.assert_allclose(found[5:], expected[5:], rtol=0, atol=1000 * 2.0**-52 * 2.4e6)
        assert found[-1] == expected[-1]
