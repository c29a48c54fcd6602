"""The time of an elementary function of the kernels, beside that of the C library's.

Run with ``python tests/bench/bench_elementary.py``. One C program times both in turn, best of
several; the largest error of each against mpmath stands beside the time.
"""

import ctypes
import math
import subprocess
import tempfile
from pathlib import Path

import mpmath
import numpy as np

from cosim.native import build
from cosim.native.library import library

RANGES = {
    "exp": (-5.0, 5.0),
    "log": (0.1, 10.0),
    "sin": (-10.0, 10.0),
    "cos": (-10.0, 10.0),
    "tan": (-10.0, 10.0),
    "asin": (-1.0, 1.0),
    "acos": (-1.0, 1.0),
    "atan": (-5.0, 5.0),
    "sinh": (-5.0, 5.0),
    "cosh": (-5.0, 5.0),
    "tanh": (-5.0, 5.0),
    "pow": (0.1, 20.0),  # to the power of 1.7
}
POWER = 1.7
POINTS = 2000  # for the error
MAIN = r"""
#include "elementary.h"
#include <math.h>
#include <stdio.h>
#include <time.h>
#define cosim_log cosim_ln
#define CALLS 20000

typedef double (*function)(double x);

static double seconds(function f, double low, double high)
{
    struct timespec began, ended;
    volatile double keep;
    double total = 0.0;
    timespec_get(&began, TIME_UTC);
    for (int i = 0; i < CALLS; ++i)
        total += f(low + (high - low) * i / CALLS);
    timespec_get(&ended, TIME_UTC);
    keep = total;
    (void)keep;
    return (double)(ended.tv_sec - began.tv_sec) + 1e-9 * (double)(ended.tv_nsec - began.tv_nsec);
}

static double own_pow(double x) { return cosim_pow(x, POWER); }
static double library_pow(double x) { return pow(x, POWER); }

static void compare(const char *name, function own, function library, double low, double high)
{
    double best[2] = {1.0, 1.0};
    for (int k = 0; k < 100; ++k) {
        const double mine = seconds(own, low, high), other = seconds(library, low, high);
        best[0] = mine < best[0] ? mine : best[0];
        best[1] = other < best[1] ? other : best[1];
    }
    printf("%s %g %g\n", name, 1e9 * best[0] / CALLS, 1e9 * best[1] / CALLS);
}

int main(void)
{
    COMPARISONS
    return 0;
}
"""


def times() -> dict[str, tuple[float, float]]:
    """Compile and run; nanoseconds a call, ours and the C library's."""
    calls = []
    for name, (low, high) in RANGES.items():
        own = "own_pow" if name == "pow" else f"cosim_{name}"
        other = "library_pow" if name == "pow" else name
        calls.append(f'compare("{name}", {own}, {other}, {low}, {high});')
    text = MAIN.replace("COMPARISONS", "\n    ".join(calls)).replace("POWER", repr(POWER))
    with tempfile.TemporaryDirectory() as folder:
        main = Path(folder) / "main.c"
        main.write_text(text, encoding="utf-8")
        program = Path(folder) / "main"
        options = [flag for flag in build.FLAGS if flag != "-shared"]
        sources = [main, build.source("elementary.c")]
        command = [*build.compiler(), *options, *build.INCLUDES, *map(str, sources)]
        subprocess.run([*command, "-o", str(program), "-lm"], check=True)
        output = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    rows = [line.split() for line in output.splitlines()]
    return {name: (float(own), float(other)) for name, own, other in rows}


def errors(name: str) -> tuple[float, float]:
    """Return the largest error [ulp] at points of the range, ours and the C library's."""
    own = getattr(library, "cosim_ln" if name == "log" else f"cosim_{name}")
    own.restype = ctypes.c_double
    parameters = (POWER,) if name == "pow" else ()
    own.argtypes = [ctypes.c_double] * (1 + len(parameters))
    exact = getattr(mpmath, "power" if name == "pow" else name)
    largest = [0.0, 0.0]
    with mpmath.workprec(200):
        for x in np.linspace(*RANGES[name], POINTS).tolist():
            value = exact(mpmath.mpf(x), *parameters)
            for i, f in enumerate((own, getattr(math, name))):
                error = abs(f(x, *parameters) - value) / math.ulp(float(value))
                largest[i] = max(largest[i], float(error))
    return largest[0], largest[1]


def main() -> None:
    """Print times, ratios and errors."""
    for name, (own, other) in times().items():
        own_error, other_error = errors(name)
        print(
            f"{name:5s} {own:5.1f} ns {own_error:.3f} ulp   C library {other:5.1f} ns "
            f"{other_error:.3f} ulp   {own / other:4.2f} x"
        )


if __name__ == "__main__":
    main()
