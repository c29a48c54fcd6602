"""The benchmark of masters compares like with like: the C program computes what cosim computes."""

import math
import shutil
import sys

import pytest

from tests.bench.bench_masters import arguments
from tests.bench.masters.cases import FLOOR, FmuCase
from tests.bench.masters.core_cases import LagsCase
from tests.bench.masters.environments import Command, Unavailable, run
from tests.bench.masters.systems import STEP_NS, chain, ring

STEPS = 200
STEP = STEP_NS / 1e9

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]


@pytest.mark.parametrize(
    ("system", "version", "method"),
    [
        (ring(3), "2", "cs"),
        (ring(3), "3", "cs"),
        (ring(3), "2", "RK45"),
        (chain(3), "3", "rk4"),
    ],
)
def test_the_c_program_and_cosim_agree_to_the_last_bit(system, version, method, tmp_path):
    """So both make the same calls with the same numbers, and the ratio of their times says it."""
    case = FmuCase(system, version, method)
    case.build(tmp_path)
    floor = run(case.command(FLOOR, STEPS))
    ours = run(case.command("cosim", STEPS))
    assert floor.samples == ours.samples
    ((step, _),) = floor.samples
    assert step == STEPS
    # An input that is extrapolated over a step of h is wrong by h |y'| / 2 in the mean, where |y'|
    # is at most 1; a lag integrates 1.9 times that. All other errors are of second order.
    assert case.error(floor) < 1.9 * STEP / 2 * STEPS * STEP


def test_a_loop_of_lags_in_c_and_in_cosim_agrees_to_the_last_bit(tmp_path):
    """Without FMUs, too."""
    case = LagsCase(10)
    case.build(tmp_path)
    floor = run(case.command(FLOOR, STEPS))
    ours = run(case.command("cosim", STEPS))
    assert floor.samples == ours.samples


def test_the_closed_form_solves_the_equations():
    """The derivative of the closed form is what the lags say, to the error of differences."""
    for system in (ring(3), chain(20)):
        before, y, after = system.exact([699, 700, 701])
        slopes = (after - before) / (2.0 * STEP)
        for i, lag in enumerate(system.lags):
            u = 0.0 if lag.source is None else y[lag.source]
            # Third derivatives are below 10, so that the differences err by 10 STEP**2 / 6.
            assert slopes[i] == pytest.approx(lag.gain * u + lag.bias - y[i], abs=2e-6)
    # of the first lag of a chain y' = 1 - y, by itself
    assert chain(2).exact([500])[0, 0] == pytest.approx(-math.expm1(-0.5), abs=1e-14)


def test_a_master_that_fails_is_reported_with_its_last_line():
    """One line with the reason, as the table has it."""
    program = "import sys; sys.exit('a trace\\nnot today')"
    with pytest.raises(Unavailable, match=r"^not today$"):
        run(Command((sys.executable, "-c", program)))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--peers", "cosim,simulink"], "--peers: found 'simulink'; there is: cosim, ecos"),
        (["--cases", "ring-9"], "--cases: found 'ring-9', which is in no name; there is: ring-3"),
        (["--rounds", "0"], "argument --rounds: found 0; needed a whole number from 1 on"),
        (["--steps", "10"], "argument --steps: found 10; needed at least 1000"),
    ],
)
def test_wrong_options_of_the_benchmark_are_refused(options, text, capsys):
    """An empty table would look as if there were nothing to say."""
    with pytest.raises(SystemExit):
        arguments(options)
    assert text in capsys.readouterr().err
