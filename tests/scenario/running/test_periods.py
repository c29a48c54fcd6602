"""Components with a step of their own, in a scenario."""

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from tests.scenario.refusals import check_refused

SAMPLED = """
scenario = {{ name = "sampled", stop = 1.0, step = 0.01 }}
[components]
reference = {{ kind = "ramp", slope = 1.0 }}
controller = {{ kind = "controller", A = [[-20.0]], B = [[20.0]], C = [[1.0]], period = {period} }}
lag = {{ kind = "lag", time_constant = 0.5 }}

[connections]
"controller.u" = "reference.y"
"lag.u" = "controller.y"
"""


@pytest.mark.parametrize("n", [1, 5])
def test_a_controller_with_a_period_samples_and_holds(tmp_path, n):
    """Between its samples y is held, so the lag sees steps; a period may be one communication step.

    At a sample instant x+ = x exp(-20 T) + u (1 - exp(-20 T)).
    """
    T = 0.01 * n
    run = cosim.run(parse(Document(SAMPLED.format(period=T), "sampled", tmp_path)))
    u = np.arange(100 // n + 1) * T
    y = np.zeros(len(u))
    for k in range(len(y) - 1):
        y[k + 1] = y[k] * np.exp(-20.0 * T) + u[k] * (1.0 - np.exp(-20.0 * T))
    x = np.zeros(101)
    for k in range(100):
        x[k + 1] = x[k] * np.exp(-0.02) + y[k // n] * (1.0 - np.exp(-0.02))
    # Values up to 1 over 100 steps, each rounding a few times: below 100 * 10 * 2^-53 = 1.1e-13.
    assert abs(run["controller.y"] - y).max() < 2e-13
    assert abs(run["lag.y"] - x).max() < 2e-13


def test_a_period_that_is_none_is_refused(tmp_path):
    def run(period):
        cosim.run(parse(Document(SAMPLED.format(period=period), "sampled", tmp_path)))

    cases = [(period, r"period: expected at least 1 communication") for period in (0.0, -0.01)]
    check_refused(cases, run, ScenarioError)
    check_refused(cases, lambda T: cosim.run("academic", set={"identifier.period": T}))
