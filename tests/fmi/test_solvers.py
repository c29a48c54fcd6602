"""Solvers over one communication step, against closed forms."""

import gc
import math
import sys

import numpy as np
import pytest

from cosim.core.linear import LinearModel, feedthrough_of
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError, RunError
from cosim.fmi.driving.cvode import CVode
from cosim.fmi.driving.solvers import ADAPTIVE, Adaptive


def relax(t, x):
    """Return x' = -2 x + 0.3 + 2 t."""
    return -2.0 * x + 0.3 + 2.0 * t


def exact(t, x0, u0, slope):
    """Solve x' = -2 x + u0 + slope t."""
    steady = u0 / 2.0 - slope / 4.0
    decayed = (x0 - steady) * math.exp(-2.0 * t)
    return decayed + steady + slope * t / 2.0


def run(solver, ends):
    """Go from 0 through these times, with each of them as the bound of the steps until there."""
    t = 0.0
    for end in ends:
        while t < end:
            t = solver.step(end)
    return solver.at(t)


@pytest.mark.parametrize("method", ADAPTIVE)
def test_adaptive_solvers_keep_their_tolerance(method):
    """Over half a second, in one stretch and in ten, and between their steps."""
    for stretches in (1, 10):
        solver = Adaptive(method, relax, rtol=1e-9)
        solver.start(0.0, np.array([1.5]), np.ones(1))
        ends = [0.05 * k * 10 / stretches for k in range(1, stretches + 1)]
        x = run(solver, ends)
        # the tolerance 1e-9 holds for each of some dozens of inner steps, whose errors add up
        assert abs(x[0] - exact(0.5, 1.5, 0.3, 2.0)) < 1e-7
        end = solver.step(0.6)
        middle = 0.5 * (0.5 + end)
        assert abs(solver.at(middle)[0] - exact(middle, 1.5, 0.3, 2.0)) < 1e-7


@pytest.mark.parametrize("method", ADAPTIVE)
def test_adaptive_solvers_ask_for_nothing_beyond_a_step(method):
    """What the inputs do there is not known yet."""
    times = []

    def right_hand_side(t, x):
        times.append(t)
        return relax(t, x)

    solver = Adaptive(method, right_hand_side, rtol=1e-6)
    solver.start(0.0, np.array([1.5]), np.ones(1))
    for end in (1e-3, 0.1, 0.25):
        run(solver, [end])
        assert max(times) <= end
        if end == 0.1:
            solver.start(end, solver.at(end), np.ones(1))


@pytest.mark.parametrize("method", ADAPTIVE)
def test_adaptive_solvers_go_back(method):
    """What comes after ``save`` comes after ``restore`` again, bit for bit, as often as asked."""
    solver = Adaptive(method, relax, rtol=1e-9)
    solver.start(0.0, np.array([1.5]), np.ones(1))
    run(solver, [0.1, 0.2])
    saved = solver.save()
    first = run(solver, [0.3, 0.4])
    for _ in range(2):
        solver.restore(saved)
        assert np.array_equal(run(solver, [0.3, 0.4]), first)


@pytest.mark.parametrize("method", ADAPTIVE)
def test_states_within_a_step_are_the_same_after_going_back(method):
    """What it interpolates with is among what is copied."""

    def within():
        reached = solver.step(2.0)
        width = reached - 0.2
        return reached, [solver.at(0.2 + s * width).tolist() for s in (0.3, 0.7)]

    solver = Adaptive(method, relax, rtol=1e-9)
    solver.start(0.0, np.array([1.5]), np.ones(1))
    run(solver, [0.1, 0.2])
    saved = solver.save()
    first = within()
    for _ in range(2):
        solver.restore(saved)
        assert within() == first


@pytest.mark.parametrize(("method", "spared"), [("Radau", 1), ("BDF", 15)])
def test_running_on_needs_fewer_evaluations_than_starting_anew(method, spared):
    """Count the evaluations in 100 stretches of 1 ms.

    A start costs Radau two evaluations and a Jacobian matrix, BDF all the steps that it takes from
    order 1 on. How many iterations Radau saves of that depends on rounding, so on the processor:
    1.5 evaluations a stretch with OpenBLAS's kernels for Haswell, 1.8 for Nehalem. LSODA is not
    among them: it starts anew.
    """

    def count(anew):
        calls = []

        def right_hand_side(t, x):
            calls.append(t)
            return relax(t, x)

        solver = Adaptive(method, right_hand_side, rtol=1e-9)
        solver.start(0.0, np.array([1.5]), np.ones(1))
        for k in range(1, 101):
            t = 1e-3 * k
            x = run(solver, [t])
            if anew:
                solver.start(t, x, np.ones(1))
        return len(calls)

    assert count(anew=True) >= count(anew=False) + spared * 100


@pytest.mark.slow
def test_a_solver_that_fails_says_so_in_its_own_words():
    """x' = x^2 from 1 has no value at t = 1.

    The linear algebra refuses what is no number.
    """
    cases = (
        ("Radau", lambda t, x: x * x, "Required step size is less than spacing between numbers"),
        ("BDF", lambda t, x: x * np.nan, "array must not contain infs or NaNs"),
    )
    for method, right_hand_side, message in cases:
        solver = Adaptive(method, right_hand_side, rtol=1e-9)
        solver.start(0.0, np.ones(1), np.ones(1))
        with pytest.raises(RunError, match=f"solver {method}: {message}"):
            run(solver, [2.0])


@pytest.mark.parametrize("method", ["Radau", "BDF"])
def test_going_back_forgets_how_the_step_was_interpolated_that_is_left(method):
    """Within the step that ``restore`` leads back to, the states are those of that step."""
    solver = Adaptive(method, relax, rtol=1e-4)
    solver.start(0.0, np.array([1.5]), np.ones(1))
    reached = run_steps(solver, 5)
    middle = 0.5 * (reached[-2] + reached[-1])
    saved = solver.save()
    expected = solver.at(middle)
    later = solver.step(10.0)
    solver.at(0.5 * (reached[-1] + later))
    solver.restore(saved)
    assert np.array_equal(solver.at(middle), expected)


def run_steps(solver, count):
    """Take some steps of the solver's own length; return the times reached."""
    return [solver.step(10.0) for _ in range(count)]


@pytest.mark.slow
def test_a_cvode_that_was_not_made_completely_is_freed_without_complaint(monkeypatch):
    """Whatever fails in its making: the error is that of the failure, and nothing else is said."""
    complaints = []
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    for failing in ("_create_context", "_declare_functions", "_create_vectors_and_matrix", "start"):

        def fail(*_, failing=failing):
            raise RunError(f"no {failing}")

        with monkeypatch.context() as patch:
            patch.setattr(CVode, failing, fail)
            with pytest.raises(RunError, match=f"no {failing}"):
                CVode(relax, 1, rtol=1e-6)
            gc.collect()
    assert [str(complaint.exc_value) for complaint in complaints] == []


def test_feedthrough_is_read_off_the_blocks_of_d():
    """Any nonzero number in the block of an output and an input."""
    interface = Interface((Signal("a", 2), Signal("b")), (Signal("y"), Signal("z", 2)))
    D = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    assert feedthrough_of(interface, D) == {"y": ("a",), "z": ("b",)}


def test_a_matrix_of_the_wrong_shape_is_refused():
    """By name, with both shapes."""
    interface = Interface((Signal("u"),), (Signal("y"),))
    eye = np.eye(1)
    zero = np.zeros((1, 1))
    with pytest.raises(GraphError, match=r"matrix C: expected shape \(1, 1\), got \(1, 2\)"):
        LinearModel(interface, ("x",), eye, eye, np.ones((1, 2)), zero, np.zeros(1), zero)
