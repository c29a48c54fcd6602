"""The residual form of DAE FMUs, solved to the order of its method.

The reference solutions do not use the form.
"""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.core.contracts import Stopped
from cosim.errors import FmuError, RunError
from cosim.fmi.component import load
from cosim.fmi.driving.residual import NODES, WEIGHTS
from cosim.fmi.options import FmuOptions
from cosim.testing import check_component, check_rollback
from tests.fmi.dae import ABOUT, LISTS, RATE, build, manifest

DERIVATIVES = pytest.mark.parametrize("derivatives", [True, False])


def line(t):
    """Return a ramp, so that a communication step hides nothing."""
    return 0.5 + t


def still(t):
    return np.zeros_like(t)


def run(
    h, stop=2.0, *, u=line, held=False, model="CUBIC", derivatives=True, dae="residual", start=None
):
    """Return the outputs at every communication point, and the times of the state events.

    The outputs are x (where there is one), z, q, y.
    """
    steps = round(stop / h)
    t = np.arange(steps + 1) * round(h * 1e9) / 1e9
    inputs = u(t)[:, np.newaxis]
    options = FmuOptions(dae=dae, start=start or {})
    with load(build(model, derivatives=derivatives), options) as fmu:
        component = fmu.component
        component.prepare(h, np.array([held]), {})
        first = component.initialize(0.0, inputs[0])
        y = np.vstack([first, component.advance(t, h, inputs)])
        messages = [text for *_, text in fmu.drain() if text.startswith("state event")]
    return y, [float(message.split(" = ")[1][:-2]) for message in messages]


def root(value):
    """Return the real z of z^3 + z = value."""
    roots = np.roots([1.0, 0.0, 1.0, -value])
    (z,) = (root.real for root in roots if abs(root.imag) < 1e-6)
    return z


@cache
def reference():
    """Return x and z at 2 s; their error is some 1e-14.

    Differentiated, the equation is an ordinary one: (3 z^2 + 1) z' = x' + u' = 1 - z.
    """

    def right_hand_side(t, z):
        return (1.0 - z) / (3.0 * z * z + 1.0)

    z0 = [root(1.5)]
    tolerances = {"rtol": 1e-13, "atol": 1e-15}
    solution = solve_ivp(right_hand_side, (0.0, 2.0), z0, method="DOP853", **tolerances)
    z = solution.y[0, -1]
    return np.array([z**3 + z - 2.5, z])


def test_the_coefficients_are_those_of_collocation_of_order_five():
    """B(5) and C(3) of Hairer and Wanner II, section IV.5.

    The last row is that of the quadrature (stiffly accurate).
    """
    c = np.array([*NODES, 1.0])
    for k in (1, 2, 3):
        integrals = WEIGHTS @ c ** (k - 1)
        assert integrals == pytest.approx(c**k / k, abs=2e-16)
    for k in (1, 2, 3, 4, 5):
        integral = WEIGHTS[-1] @ c ** (k - 1)
        assert integral == pytest.approx(1.0 / k, abs=2e-16)


@DERIVATIVES
def test_halving_the_step_divides_the_error_by_thirty_two(derivatives):
    """Order 5 for x and z, with the FMU's derivatives and without."""

    def error(h):
        y, _ = run(h, derivatives=derivatives)
        return abs(y[-1, :2] - reference())

    assert error(0.4) / error(0.2) == pytest.approx([32.0, 32.0], abs=4.0)


@DERIVATIVES
def test_a_nonlinear_model_is_solved_to_rounding(derivatives):
    """At 10 ms the method is wrong by 5e-10 / 40^5 = 5e-18.

    200 steps round to some 200 times 1e-16, the reference to 1e-14. The FMU's own form, with rk4,
    is wrong by h^4 times the fifth derivative over 120: below 1e-10.
    """
    rows, _ = run(0.01, derivatives=derivatives)
    x, z, _, y = rows[-1]
    assert [x, z] == pytest.approx(reference(), abs=5e-14)
    assert y == x + 2.0 * z
    rows_of_ode, _ = run(0.01, dae="ode")
    assert rows_of_ode[:, :2] == pytest.approx(rows[:, :2], abs=1e-10)


@DERIVATIVES
def test_a_state_event_of_an_algebraic_variable_is_located(derivatives):
    """z falls through 0.5, from where on x' is -4 z.

    The time is a quadrature: dt = -(3 z + 1/z)/q dz, from z(0).
    """
    rows, events = run(0.02, u=still, derivatives=derivatives, start={"p": 0.5})

    def passed(z):  # integral of 3 z + 1/z
        return 1.5 * z * z + np.log(z)

    expected = passed(root(1.0)) - passed(0.5)
    # the method: some 1e-10 at 0.4 s, by 20^5
    assert events == pytest.approx([expected], abs=1e-11)
    _, z, q, _ = rows[-1]
    assert q == 4.0
    # then nearly z' = -4 z: a step is wrong by (4 h)^6 / 7200 of z, 70 of them by 3e-9
    remaining = (passed(0.5) - passed(z)) / 4.0
    assert remaining == pytest.approx(2.0 - expected, abs=3e-9)


def steps(t):
    even = np.round(t * 10.0) % 2.0 == 0.0
    return np.where(even, 1.0, -0.5)


@pytest.mark.parametrize("held", [True, False])
def test_z_solves_the_equation_with_the_inputs_of_its_time(held):
    """Held inputs jump at communication points: z jumps with them, and y shows it; x does not."""
    with load(build(), FmuOptions(dae="residual")) as fmu:
        component = fmu.component
        t = np.arange(21) / 10.0
        inputs = steps(t)[:, np.newaxis]
        component.prepare(0.1, np.array([held]), {})
        first = component.initialize(0.0, inputs[0])
        rows = np.vstack([first, component.advance(t, 0.1, inputs)])
        x, z, _, y = rows.T
        assert z**3 + z - x == pytest.approx(inputs[:, 0], abs=4e-15)
        assert np.array_equal(y, x + 2.0 * z)
        z_for_7 = component.outputs(2.0, np.array([7.0]))[1]
        assert z_for_7 == pytest.approx(root(x[-1] + 7.0), abs=4e-15)
        assert np.array_equal(component.outputs(2.0, inputs[-1]), rows[-1])


def test_a_form_without_states_is_its_equation():
    """z^3 + z = u at every time."""
    rows, _ = run(0.1, model="STATIC")
    expected = [root(u) for u in line(np.arange(21) / 10.0)]
    assert rows[:, 0] == pytest.approx(expected, abs=4e-15)


@pytest.mark.slow
@DERIVATIVES
def test_the_contract_of_components_holds(derivatives):
    """One call of K steps is K calls of one, bit for bit; outputs change nothing.

    What was saved comes back.
    """
    path = build(derivatives=derivatives)
    options = FmuOptions(dae="residual", start={"p": 0.5})
    with load(path, options) as fmu:
        check_component(lambda: fmu.component, steps=10, h=0.1)
    with load(path, options) as fmu:
        check_rollback(lambda: fmu.component, steps=10, h=0.1)


def test_where_there_is_no_solution_the_run_stops():
    """0 = z^2 - x with x = 1 - t: z = sqrt(1 - t) as long as there is one."""
    with pytest.raises(Stopped) as stopped:
        run(0.01, model="FOLD")
    rows = stopped.value.outputs
    message = str(stopped.value)
    assert message.startswith("FOLD: no solution of the residual form at t = 1.0")
    assert "largest residual" in message
    problem = "Newton's iteration: corrections do not vanish in 25 iterations, the last is"
    assert problem in message
    t = np.arange(1, 91) / 100.0
    assert rows[:90, 1] == pytest.approx(np.sqrt(1.0 - t), abs=1e-14)


def test_a_start_at_which_z_is_not_determined_is_an_error():
    """At z = 0 a small z changes z^2 by nothing."""
    message = (
        "FOLD: no solution of the residual form at t = 0.0 s: largest residual 1; "
        "Newton's iteration: its matrix is singular"
    )
    with load(build("FOLD"), FmuOptions(dae="residual", start={"z": 0.0})) as fmu:
        fmu.component.prepare(0.1, np.array([False]), {})
        fmu.component.initialize(0.0, np.zeros(1))
        with pytest.raises(RunError, match=message):
            fmu.component.outputs(0.0, np.zeros(1))


TWICE = (
    '<Residual><Formulation valueReference="4" index="2"/><Formulation valueReference="7"/>'
    "</Residual>"
)
IMPLICIT = '<Residual><Formulation valueReference="4" dependencies="2 3"/></Residual>'


@pytest.mark.slow
def test_a_form_that_cannot_be_integrated_is_refused(subtests):
    """The message says what is missing; as an ordinary FMU it runs all the same."""
    for extra, message in [
        (
            None,
            r'expected the manifest extra/.*/fmi-ls-manifest.xml; use "ode"',
        ),
        (
            manifest("", "fmi-dae", f'{ABOUT} isDaeFmu="false"'),
            "the FMU declares no residual form",
        ),
        (
            manifest("", "fmi-dae", f'{ABOUT} isDaeFmu="true"'),
            "lists no AlgebraicVariables and no Residual, so that the form is not",
        ),
        (
            manifest(LISTS, "fmi-dae", f'{ABOUT} isDaeFmu="true"'),
            r"expected as many residuals as algebraic variables \(1\), got 0",
        ),
        (
            manifest(LISTS + f"<ModelStructure>{RATE}{TWICE}</ModelStructure>"),
            "'r' is an equation of higher index; expected index 1",
        ),
        (
            manifest(LISTS + f"<ModelStructure>{RATE}{IMPLICIT}</ModelStructure>"),
            "'r' depends on derivatives of states; expected explicit",
        ),
    ]:
        with subtests.test(message=message):
            path = build(extra=extra)
            with pytest.raises(FmuError, match=f'CUBIC: dae = "residual": .*{message}'):
                load(path, FmuOptions(dae="residual"))
            load(path).close()


def test_only_model_exchange_of_fmi_3_without_another_solver_has_a_residual_form(request):
    """A solver of one's own would not be used; other choices do not exist."""
    message = "solver 'rk4': the residual form has its own, Radau IIA; leave one of both out"
    with pytest.raises(FmuError, match=message):
        load(build(), FmuOptions(dae="residual", solver="rk4"))
    with pytest.raises(FmuError, match="no solver 'Radau IIA'"):
        load(build(), FmuOptions(solver="Radau IIA"))
    with pytest.raises(FmuError, match=r"dae = 'dae'; "):
        load(build(), FmuOptions(dae="dae"))
    exported = request.getfixturevalue("exported")
    message = (
        'dae = "residual": FMI 2.0 has no residual form, the layered standard is on top of FMI 3'
    )
    with pytest.raises(FmuError, match=message):
        load(exported, FmuOptions(interface_type="me", dae="residual"))
    message = 'dae = "residual": a co-simulation FMU solves for itself; use interface_type = "me"'
    with pytest.raises(FmuError, match=message):
        load(exported, FmuOptions(interface_type="cs", dae="residual"))


def test_the_log_says_which_form_is_integrated():
    """The solver's name says it."""
    with load(build(), FmuOptions(dae="residual")) as fmu:
        assert fmu.metadata["solver"] == "Radau IIA"
