"""Check any component against the contract of :class:`cosim.core.contracts.Component`.

The master, the loops and the verification of a recorded run rest on these laws; a component that
keeps them can be put anywhere in a graph. Everything is compared bit for bit.

An estimator of the parameters of a disturbance has laws of its own beside these.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Never, Protocol, cast

import numpy as np

from cosim.arrays import NAN, Mask, Matrix, Vector, read_only
from cosim.blocks.regressor import Regressor
from cosim.core.clock import nanoseconds, seconds
from cosim.core.contracts import (
    Component,
    Design,
    Native,
    Rollback,
    State,
    linearized,
    prepare,
    prepare_substeps,
)
from cosim.core.stages.calls import result_problem
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.linear import first_order_hold
from cosim.native.numerics.programs import evaluate_at
from cosim.native.step import NativeStep
from cosim.theory.disturbances.families import Exponential, Family, group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.disturbed_plant import DisturbedPlant

_SCALES: Final = (2.0**-12, 2.0**12)  # powers of two: other units, the same digits
_SCALED: Final = 1e-6  # relative difference of theta in other units


class RollbackComponent(Component, Rollback[State], Protocol[State]):
    """A component that can go back."""


def check_component(
    make: Callable[[], Component],
    *,
    inputs: Matrix | None = None,
    h: float = 1e-3,
    steps: int = 30,
    seed: int = 0,
) -> None:
    """Check that a component keeps the contract.

    Where its interface declares ``native``, the compiled step keeps the laws too: it has the bits
    of ``advance``, also in turn with it and after ``restore``, and steps that it declines are taken
    by ``advance``.

    Parameters
    ----------
    make : callable
        Returns a new component, the same every time.
    inputs : Matrix, shape (steps+1, n_u), optional
        Inputs at the communication points, for which the component must not stop; left out: seeded
        random numbers.
    h : float
        Communication step [s].
    steps : int
        Number of communication steps; that of ``inputs`` where there are any.
    seed : int
        Of the random numbers.

    Raises
    ------
    AssertionError
        At the first law that is broken, with the signal, the time and the values.

    Examples
    --------
    >>> from cosim.blocks import Delay
    >>> check_component(lambda: Delay(3))
    """
    bench = _Bench(make, inputs, h, steps, seed)
    _check_declared(bench)
    for held in bench.masks():
        case = bench.under(held)
        _check_values(case, "a value", case.expected)
        _check_values(case, "a value of initialize", case.initialize(case.prepared()))
        _check_repeatable(case)
        _check_design(case)
        _check_blocks(case)
        _check_outputs(case)
        _check_ownership(case)
        _check_feedthrough(case)
        _check_initialization(case)
        if held.any() or bench.interface.delayed:
            _check_held_inputs(case)
        if bench.interface.native:
            _check_native(case)
        if bench.interface.linearizable:
            _check_linearized(case)
        if bench.interface.substeps:
            _check_substeps(case)
    if bench.interface.rollback:
        _check_rollback(bench)


def check_rollback(
    make: Callable[[], RollbackComponent[State]],
    *,
    inputs: Matrix | None = None,
    h: float = 1e-3,
    steps: int = 30,
    seed: int = 0,
) -> None:
    """Check that ``restore(save())`` is the identity, after ``initialize`` and later, repeatedly.

    States are set back in any order; one that can be pickled goes on in another component, too.

    Parameters are those of :func:`check_component`.

    Raises
    ------
    AssertionError
        Where a run from a restored state differs.
    """
    bench = _Bench(make, inputs, h, steps, seed)
    _check_rollback(bench)


def _check_rollback(bench: _Bench) -> None:
    """Require that a restored component goes on as it did after it was saved."""
    for k in (0, bench.steps // 2):
        prepared = bench.prepared()
        # The interface is what declares save and restore; a type checker cannot follow it.
        component = cast("RollbackComponent[object]", prepared)
        bench.initialize(component)
        bench.advance(component, 0, k)
        state = component.save()
        outputs = bench.outputs(component, k)
        component.save()
        saved_twice = bench.outputs(component, k)
        bench.compare("save changes nothing", saved_twice, outputs, k)
        expected = bench.advance(component, k, bench.steps)
        for _ in range(2):
            component.restore(state)
            restored = bench.outputs(component, k)
            bench.compare("restore goes back to the outputs at save", restored, outputs, k)
            rows = bench.advance(component, k, bench.steps)
            law = "a restored component goes on as it did after save"
            bench.compare(law, rows, expected, k + 1)
        _check_later(bench, component, state, k)


def _check_later(
    bench: _Bench, component: RollbackComponent[object], state: object, k: int
) -> None:
    """Require that states are restored in any order; ``state`` is that at ``k``.

    What follows a state is compared with what followed when it was saved: a solver of several steps
    may begin anew there.
    """
    middle = (k + bench.steps) // 2
    component.restore(state)
    bench.advance(component, k, middle)
    later = component.save()
    expected = bench.advance(component, middle, bench.steps)
    component.restore(state)
    component.restore(later)
    rows = bench.advance(component, middle, bench.steps)
    law = "a later state can be restored after an earlier one"
    bench.compare(law, rows, expected, middle + 1)
    _check_another(bench, later, middle, expected)


def _check_another(bench: _Bench, state: object, k: int, expected: Matrix) -> None:
    """Require that a state that can be pickled goes on in another component."""
    try:
        pickled = pickle.dumps(state)
    except Exception:  # a state is the component's own, and may raise anything
        return
    prepared = bench.prepared()
    bench.initialize(prepared)
    # As above.
    another = cast("RollbackComponent[object]", prepared)
    another.restore(pickle.loads(pickled))
    rows = bench.advance(another, k, bench.steps)
    law = "another component goes on from a pickled state"
    bench.compare(law, rows, expected, k + 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimationCase:
    """What an estimator is told, and the signals that it may take.

    ``x' = A x + B u + sum_i Bd_i alpha_i f_i``, whose output is y; delta is the sum of all
    ``alpha_i f_i``. There is no transient of an observer in it.

    Parameters
    ----------
    plant : DisturbedPlant
    families : tuple of Family
        The components of the disturbance.
    alphas : tuple of str
        The known factor of each, an expression in t.
    delays : tuple of float
        D_j of the regressor [s].
    h : float
        Communication step [s].
    start : float
        First instant of which the regressor counts [s].
    deviation : float
        Standard deviation of the noise of y that is stated to the estimator.
    size : float
        Size of x and delta.
    signals : mapping of name to Matrix, shape (steps + 1, size)
        ``y``, ``u``, ``delta`` and the products ``regressor`` (mu, NaN before the longest delay).
    theta : Vector, shape (P,)
        The truth.
    """

    plant: DisturbedPlant
    families: tuple[Family, ...]
    alphas: tuple[str, ...]
    delays: tuple[float, ...]
    h: float
    start: float
    deviation: float
    size: float
    signals: Mapping[str, Matrix]
    theta: Vector

    @property
    def steps(self) -> int:
        """The number of communication steps."""
        return len(self.signals["y"]) - 1

    @property
    def span(self) -> float:
        """The length of the record [s]."""
        return self.steps * self.h


def check_estimator(
    make: Callable[[EstimationCase], Component], *, accuracy: float = 0.0, seed: int = 0
) -> None:
    """Check that an estimator keeps the laws that its users rely on.

    Its inputs are some of ``regressor``, ``delta``, ``y`` and ``u``, its output is ``theta``, and
    ``standard_error`` where it has one. The signals are those of two exponentials under a plant of
    first order, over 30 s.

    * It is a component: :func:`check_component`; blocks of any length give the same bits.
    * theta has no value (NaN) at the start, nor from signals that are zero.
    * Exact signals give the truth to within ``accuracy`` or four standard errors, or no value.
    * In other units of y, u and delta theta is the same.
    * From noise without a disturbance there is no standard error below 3 / span, the resolution of
      the record: no confident theta.

    Parameters
    ----------
    make : callable
        Returns a new estimator for a case, the same every time.
    accuracy : float
        Error of theta that the method is known to leave with exact signals [1/s]; infinite for one
        that need not converge.
    seed : int
        Of the noise.

    Raises
    ------
    AssertionError
        At the first law that is broken.
    """
    exact = _estimation_case()
    check_component(
        lambda: make(exact), inputs=_estimator_inputs(make(exact), exact)[:31], h=exact.h
    )
    outputs = _estimate(make, exact, exact.steps)
    for size in (1, 7):
        again = _estimate(make, exact, size)
        if again["rows"].tobytes() != outputs["rows"].tobytes():
            raise AssertionError(f"blocks of {size} give the bits of one block")
    _check_silence(make, exact, outputs)
    _check_exact(outputs, exact.theta, accuracy)
    for scale in _SCALES:
        _check_scale(make, exact, scale, outputs["theta"][-1])
    for draw in range(3):
        _check_noise(make, exact, seed + draw)


def _estimation_case() -> EstimationCase:
    h = 1e-2
    steps = 3000
    t = seconds(np.arange(steps + 1, dtype=np.int64) * nanoseconds(h))
    alphas = ("1.35 + 0.25*sin(1.7*t)", "1.1 + 0.2*cos(2.3*t)")
    families = (Exponential(), Exponential())
    theta = np.array([-0.1, -0.3])
    delays = (1.0, 2.0, 3.0)
    plant = DisturbedPlant(
        A=np.array([[-1.0]]),
        B=np.array([[0.5]]),
        Bd=np.ones((1, 2)),
        C=np.ones((1, 1)),
        D=np.array([[-1.0]]),
        Dd=np.zeros((1, 2)),
    )
    factors = evaluate_at([compile_expression(alpha) for alpha in alphas], t)
    delta = (factors * np.exp(np.multiply.outer(t, theta))).sum(axis=1)
    inputs = np.stack([np.sin(t), delta], axis=1)
    joined = np.hstack([plant.B, plant.Bd[:, :1]])
    discrete = first_order_hold(plant.A, joined, h, np.zeros(2, np.bool_))
    x = np.ones(1)
    y = np.empty((steps + 1, 1))
    for k in range(steps + 1):
        if k:
            x = discrete.Ad @ x + discrete.B0 @ inputs[k - 1] + discrete.B1 @ inputs[k]
        y[k] = plant.C @ x + plant.D @ inputs[k, :1]
    signals = {"y": y, "u": inputs[:, :1], "delta": inputs[:, 1:]}
    case = EstimationCase(
        plant=plant,
        families=families,
        alphas=alphas,
        delays=delays,
        h=h,
        start=max(delays) + h,
        deviation=1e-3,
        size=1.0,
        signals=signals,
        theta=theta,
    )
    return replace(case, signals={**signals, "regressor": _products(case)})


def _products(case: EstimationCase) -> Matrix:
    """Compute the regressor of a case."""
    groups = group_by_alpha(case.alphas, case.families)
    terms = expand(tuple(group.size for group in groups))
    programs = [compile_expression(group.alpha) for group in groups]
    steps = [round(delay / case.h) for delay in case.delays]
    regressor = Regressor(terms, alphas=programs, steps=steps, delays=case.delays)
    delta = np.ascontiguousarray(case.signals["delta"])
    t = _times(case)
    first = regressor.initialize(float(t[0]), delta[0])
    return np.vstack([first, regressor.advance(t, case.h, delta)])


def _times(case: EstimationCase) -> Vector:
    return seconds(np.arange(case.steps + 1, dtype=np.int64) * nanoseconds(case.h))


def _estimator_inputs(component: Component, case: EstimationCase) -> Matrix:
    """Return the signals that an estimator takes, side by side."""
    columns = []
    for signal in component.interface.inputs:
        values = case.signals.get(signal.name)
        if values is None or values.shape[1] != signal.size:
            listed = ", ".join(f"{name} ({rows.shape[1]})" for name, rows in case.signals.items())
            raise AssertionError(
                f"input {signal.name!r} of size {signal.size}: an estimator takes some of {listed}"
            )
        columns.append(values)
    return np.ascontiguousarray(np.hstack(columns))


def _estimate(
    make: Callable[[EstimationCase], Component], case: EstimationCase, size: int
) -> dict[str, Matrix]:
    """Run an estimator over a case in blocks; return all ``rows``, and its outputs by name."""
    component = make(case)
    u = _estimator_inputs(component, case)
    t = _times(case)
    prepare(component, case.h, np.zeros(u.shape[1], np.bool_), {})
    blocks = [component.initialize(float(t[0]), u[0])[np.newaxis]]
    for begin in range(0, case.steps, size):
        end = min(begin + size, case.steps)
        blocks.append(component.advance(t[begin : end + 1], case.h, u[begin : end + 1]))
    rows = np.vstack(blocks)
    outputs = {"rows": rows}
    for name, columns in component.interface.output_columns().items():
        outputs[name] = rows[:, columns]
    if "theta" not in outputs or outputs["theta"].shape[1] != len(case.theta):
        raise AssertionError(f"an estimator has an output 'theta' of size {len(case.theta)}")
    return outputs


def _check_silence(
    make: Callable[[EstimationCase], Component], case: EstimationCase, outputs: Mapping[str, Matrix]
) -> None:
    """Require no theta before there is information."""
    if not np.isnan(outputs["theta"][0]).all():
        raise AssertionError(f"theta at the start: expected no value, got {outputs['theta'][0]}")
    zero = {name: 0.0 * values for name, values in case.signals.items()}
    theta = _estimate(make, replace(case, signals=zero), case.steps)["theta"]
    if not np.isnan(theta).all():
        raise AssertionError(
            f"theta from signals that are zero: expected no value, got {theta[-1]}"
        )


def _check_exact(outputs: Mapping[str, Matrix], truth: Vector, accuracy: float) -> None:
    """Require the truth, to within what the method says of its error."""
    theta = outputs["theta"][-1]
    allowed = np.full(len(truth), accuracy)
    if "standard_error" in outputs:
        allowed = np.maximum(allowed, 4.0 * np.nan_to_num(outputs["standard_error"][-1]))
    rounding = 1e-9 * np.abs(truth)
    wrong = np.abs(theta - truth) > allowed + rounding  # not where there is no value
    if wrong.any():
        raise AssertionError(
            f"theta from exact signals: expected {truth} to within {allowed}, which the method "
            f"states, or no value, got {theta}"
        )


def _check_scale(
    make: Callable[[EstimationCase], Component], case: EstimationCase, scale: float, theta: Vector
) -> None:
    """Require the same theta in other units, in which everything that is stated is converted."""
    scaled = {name: scale * values for name, values in case.signals.items()}
    converted = replace(
        case, signals=scaled, deviation=scale * case.deviation, size=scale * case.size
    )
    converted_theta = _estimate(make, converted, case.steps)["theta"][-1]
    same = np.isclose(converted_theta, theta, rtol=_SCALED, atol=0.0, equal_nan=True)
    if not same.all():
        raise AssertionError(
            f"theta with y, u and delta in units of {1.0 / scale:g}: "
            f"expected {theta}, got {converted_theta}"
        )


def _check_noise(
    make: Callable[[EstimationCase], Component], case: EstimationCase, seed: int
) -> None:
    """Require no confident theta where there is no disturbance, but noise."""
    random = np.random.default_rng(seed)
    shape = case.signals["y"].shape
    noise = {name: 0.0 * values for name, values in case.signals.items()}
    noise["y"] = case.deviation * random.standard_normal(shape)
    noise["delta"] = case.deviation / case.h * random.standard_normal(shape)
    silent = replace(case, signals=noise)
    silent = replace(silent, signals={**noise, "regressor": _products(silent)})
    outputs = _estimate(make, silent, case.steps)
    if "standard_error" not in outputs:
        return
    errors = outputs["standard_error"][-1]
    confident = errors < 3.0 / case.span
    if confident.any():
        raise AssertionError(
            f"theta from noise alone, seed {seed}: expected no standard error below "
            f"{3.0 / case.span:g}, or no value, got {outputs['theta'][-1]} with standard errors "
            f"{errors}"
        )


def _check_values(bench: _Bench, what: str, rows: Matrix) -> None:
    """Require that values are finite, but for the one NaN in optional outputs."""
    optional: list[bool] = []
    for signal in bench.interface.outputs:
        optional += [signal.optional] * signal.size
    nan_bits = np.array(NAN).view(np.uint64)
    is_nan = rows.view(np.uint64) == nan_bits
    no_value = is_nan & np.array(optional, np.bool_)
    allowed = np.isfinite(rows) | no_value
    law = f"{what} is finite, or cosim.arrays.NAN in an optional output"
    for row, column in np.argwhere(~np.atleast_2d(allowed))[:1]:
        wanted = "a finite value, or cosim.arrays.NAN" if optional[column] else "a finite value"
        bench.fail(law, row, column, wanted, float(np.atleast_2d(rows)[row, column]))


def _check_repeatable(bench: _Bench) -> None:
    """Require the same run of a second component, with a recorded design, after a second start."""
    component = bench.prepared()
    rows = bench.run(component)
    bench.compare("a second component repeats the run", rows, bench.expected)
    bench.initialize(component, bench.perturbed[0])
    rows = bench.run(component)
    law = "initialize forgets the past, and an earlier initialize with other inputs"
    bench.compare(law, rows, bench.expected)


def _check_design(bench: _Bench) -> None:
    """Require that a component takes its recorded design, and computes nothing of it again.

    On this machine both give the same bits; so the design is also changed by one bit.
    """
    design = prepare(bench.make(), bench.h, bench.held, {})
    copies = {name: np.array(array) for name, array in design.items()}
    replayed = bench.make()
    prepare(replayed, bench.h, bench.held, copies)
    rows = bench.run(replayed)
    bench.compare("a component takes its recorded design", rows, bench.expected)
    changed = {name: np.nextafter(array, np.inf) for name, array in copies.items()}
    taken = prepare(bench.make(), bench.h, bench.held, changed)
    for name, array in changed.items():
        if name not in taken or not np.array_equal(taken[name], array, equal_nan=True):
            raise AssertionError(
                f"prepare returns its recorded design: {name!r} was computed again"
            )


def _check_declared(bench: _Bench) -> None:
    """Require that the optional methods are there where the interface declares them."""
    component = bench.make()
    declared = {
        "prepare": bench.interface.prepares,
        "save": bench.interface.rollback,
        "restore": bench.interface.rollback,
        "native": bench.interface.native,
        "linearized": bench.interface.linearizable,
        "prepare_substeps": bench.interface.prepares and bench.interface.substeps,
    }
    flags = {
        "prepare": "prepares",
        "native": "native",
        "linearized": "linearizable",
        "prepare_substeps": "substeps",
    }
    for method, required in declared.items():
        flag = flags.get(method, "rollback")
        if required and not callable(getattr(component, method, None)):
            raise AssertionError(f"the interface declares {flag}, but there is no {method}")
    # Whether it can go back may depend on the instance, an FMU for example; preparing may not.
    if "prepare" in vars(type(component)) and not bench.interface.prepares:
        raise AssertionError(
            "there is prepare, but it is not called: the interface does not declare prepares"
        )


def _check_blocks(bench: _Bench) -> None:
    """Require that the size of the blocks does not change the run."""
    for size in (1, 7):
        component = bench.prepared()
        blocks = [bench.start_outputs(component)[np.newaxis]]
        for begin in range(0, bench.steps, size):
            end = min(begin + size, bench.steps)
            blocks.append(bench.advance(component, begin, end))
        rows = np.vstack(blocks)
        bench.compare(f"blocks of {size} give the bits of one block", rows, bench.expected)


def _check_outputs(bench: _Bench) -> None:
    """Require that calls of outputs change nothing, whatever their inputs."""
    component = bench.prepared()
    row = bench.start_outputs(component)
    for k in range(bench.steps + 1):
        bench.outputs(component, k, bench.perturbed[k])
        again = bench.outputs(component, k)
        bench.compare("outputs gives the last row again", again, row, k)
        if k < bench.steps:
            row = bench.advance(component, k, k + 1)
            bench.compare("outputs changes nothing", row, bench.expected[k + 1], k + 1)


def _check_ownership(bench: _Bench) -> None:
    """Require that arguments are not written to nor kept, and that results are no views.

    Rows of inputs may be strided: they are columns of a larger array here.
    """
    component = bench.prepared()
    bench.initialize(component)
    wide = np.zeros((bench.steps + 1, bench.n_u + 3))
    strided = wide[:, 2 : 2 + bench.n_u]
    for begin in range(0, bench.steps, 3):
        end = min(begin + 3, bench.steps)
        block = slice(begin, end + 1)
        u = strided[block]
        u[:] = bench.u[block]
        t = bench.t[block].copy()
        outputs = component.outputs(float(t[0]), u[0])
        rows = component.advance(t, bench.h, u)
        unchanged = np.array_equal(u, bench.u[block], equal_nan=True)
        if not unchanged or not np.array_equal(t, bench.t[block]):
            raise AssertionError(
                "advance does not write to its arguments: they changed in the block "
                f"from t = {bench.t[begin]} s"
            )
        law = (
            "arguments and results of earlier calls are no part of the state, "
            "rows of inputs may be strided"
        )
        bench.compare(law, rows, bench.expected[begin + 1 : end + 1], begin + 1)
        # A component that kept one of these arrays will differ in the next block.
        for array in (u, t, rows, outputs):
            if array.flags.writeable:
                array[:] = 1e3


def _check_feedthrough(bench: _Bench) -> None:
    """Require that outputs ignore what is not declared to feed through."""
    component = bench.prepared()
    bench.initialize(component)
    for k in range(bench.steps + 1):
        if k:
            bench.advance(component, k - 1, k)
        for name in bench.input_names:
            y = bench.outputs(component, k, bench.perturbed_in(name, k))
            ignoring = np.where(bench.fed_by(name), bench.expected[k], y)
            law = f"outputs ignores {name!r}, which is not declared to feed through"
            bench.compare(law, ignoring, bench.expected[k], k)


def _check_initialization(bench: _Bench) -> None:
    """Require that initial outputs ignore what they are not declared to depend on."""
    first = bench.initialize(bench.prepared())
    for name in bench.input_names:
        component = bench.prepared()
        y = bench.initialize(component, bench.perturbed_in(name, 0))
        ignoring = np.where(bench.fed_initially(name), first, y)
        law = f"initialize ignores {name!r}, which is not declared to count there"
        bench.compare(law, ignoring, first)


def _check_held_inputs(bench: _Bench) -> None:
    """Require that a held or delayed input may be wrong at the end of a step.

    In a loop it is known there only after the step: the state must ignore it, and ``outputs``
    corrects what feeds through.
    """
    component = bench.prepared()
    bench.initialize(component)
    held = bench.held.copy()
    for name in bench.interface.delayed:
        held[bench.interface.input_columns()[name]] = True
    fed = np.zeros(bench.n_y, np.bool_)
    for name, columns in bench.interface.input_columns().items():
        if held[columns].any():
            fed |= bench.fed_by(name)
    for k in range(1, bench.steps + 1):
        end = np.where(held, bench.perturbed[k], bench.u[k])
        inputs = np.vstack([bench.u[k - 1], end])
        times = bench.t[k - 1 : k + 1]
        row = component.advance(times, bench.h, inputs)[0]
        ignoring = np.where(fed, bench.expected[k], row)
        law = (
            "advance ignores a held input at the end of the step "
            "where it is not declared to feed through"
        )
        bench.compare(law, ignoring, bench.expected[k], k)
        corrected = bench.outputs(component, k)
        law = "the state ignores a held input at the end of the step"
        bench.compare(law, corrected, bench.expected[k], k)


def _check_linearized(bench: _Bench) -> None:
    """Require that a linearization fits the interface, and that to make one changes nothing."""
    component = bench.prepared()
    first = bench.start_outputs(component)
    matrices = linearized(component, bench.start, read_only(bench.u[0].copy()))
    if matrices is not None and matrices.D.shape != (bench.n_y, bench.n_u):
        raise AssertionError(
            f"linearized fits the interface: expected D of shape ({bench.n_y}, {bench.n_u}), "
            f"got {matrices.D.shape}"
        )
    rows = np.vstack([first, bench.advance(component, 0, bench.steps)])
    bench.compare("linearized changes nothing", rows, bench.expected)


def _check_substeps(bench: _Bench) -> None:
    """Require that substeps are steps of their length, whatever the communication step is."""
    component = bench.make()
    step = 2.0 * bench.h
    prepare(component, step, bench.held, {})
    design = prepare_substeps(component, (bench.h,), {})
    bench.compare("substeps are steps of their length", bench.run(component), bench.expected)
    replayed = bench.make()
    prepare(replayed, step, bench.held, {})
    prepare_substeps(replayed, (bench.h,), {name: np.array(a) for name, a in design.items()})
    bench.compare("substeps take their recorded design", bench.run(replayed), bench.expected)
    surprised = bench.make()
    prepare(surprised, step, bench.held, {})
    prepare_substeps(surprised, (0.75 * step,), {})
    of_any_length = "substeps of other lengths than were announced are steps of their length"
    bench.compare(of_any_length, bench.run(surprised), bench.expected)


def _check_native(bench: _Bench) -> None:
    """Require that the compiled step has the bits of ``advance``, also in turn with it."""
    for alternates in (False, True):
        compiled = bench.compiled(alternates=alternates)
        try:
            _check_compiled(compiled)
            if not alternates:
                _check_taken(compiled)
        except AssertionError as error:
            turns = ", in turn with advance" if alternates else ""
            raise AssertionError(f"the compiled step{turns}: {error}") from error


def _check_compiled(bench: _Bench) -> None:
    bench.compare("has the bits of advance", bench.run(bench.prepared()), bench.expected)
    _check_blocks(bench)
    _check_outputs(bench)
    if bench.held.any() or bench.interface.delayed:
        _check_held_inputs(bench)
    if bench.interface.rollback:
        _check_rollback(bench)


def _check_taken(bench: _Bench) -> None:
    """Require that a step is compiled at all, where there is one.

    A discrete input may need an event whenever it changes, here at every step: that may be left to
    ``advance``.
    """
    component = cast(_Compiled, bench.prepared())
    bench.run(component)
    if any(signal.variability == "discrete" for signal in bench.interface.inputs):
        return
    if component.has_step and not component.steps_taken:
        raise AssertionError(f"it declined all of {bench.steps} steps")


class _Compiled:
    """Advances a component as a native stage does: by its compiled step, unless that declines.

    Parameters
    ----------
    component : Component
        Prepared; its interface declares ``native``.
    alternates : bool
        Every other block of steps is taken by the component itself.
    """

    def __init__(self, component: Component, *, alternates: bool) -> None:
        self.interface = component.interface
        self._component = component
        self._alternates = alternates
        self._blocks = 0
        self._step: NativeStep | None = None
        self.steps_taken = 0

    @property
    def has_step(self) -> bool:
        return self._step is not None

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        y = self._component.initialize(t, u)
        self._component.outputs(t, u)
        self._step = cast(Native, self._component).native()
        return y

    def outputs(self, t: float, u: Vector) -> Vector:
        if self._step is not None:
            y = self._step.outputs_at(t, u)
            if y is not None:
                return y
        return self._component.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        self._blocks += 1
        if self._step is None or (self._alternates and self._blocks % 2 == 0):
            return self._component.advance(t, h, u)
        steps = len(t) - 1
        rows = np.empty((steps, self.interface.n_y))
        k = 0
        while k < steps:
            y = self._step.advance(t[k:], h, u[k:])
            end = k + len(y)
            self.steps_taken += len(y)
            rows[k:end] = y
            if end < steps:
                ends = slice(end, end + 2)
                rows[end] = self._component.advance(t[ends], h, u[ends])[0]
                end += 1
            k = end
        return rows

    def save(self) -> object:
        return cast(Rollback[object], self._component).save()

    def restore(self, state: object) -> None:
        cast(Rollback[object], self._component).restore(state)


class _Bench:
    """A component's times and inputs, and other inputs to put in their place.

    ``held`` are the inputs with a zero-order hold, at first none.
    """

    expected: Matrix  # the rows of the run under ``held``

    def __init__(
        self, make: Callable[[], Component], inputs: Matrix | None, h: float, steps: int, seed: int
    ) -> None:
        self.make = make
        self.interface = make().interface
        self.input_names = [signal.name for signal in self.interface.inputs]
        self.n_u = self.interface.n_u
        self.n_y = self.interface.n_y
        if inputs is not None:
            self._check_inputs(inputs)
            steps = len(inputs) - 1
        self.steps = steps
        step_ns = nanoseconds(h)
        self.h = step_ns / 1e9
        self.t = seconds(np.arange(steps + 1, dtype=np.int64) * step_ns)
        self.start = float(self.t[0])
        noise = np.random.default_rng(seed).standard_normal((steps + 1, self.n_u))
        self.u = self._of_its_type(noise) if inputs is None else np.array(inputs, np.float64)
        self.perturbed = self._other_values(noise)
        self.held = np.zeros(self.n_u, np.bool_)

    def under(self, held: Mask) -> _Bench:
        """Return the same with these inputs held, and the rows of its run."""
        case = copy(self)
        case.held = held
        case.expected = case.run(case.prepared())
        return case

    def _check_inputs(self, inputs: Matrix) -> None:
        if inputs.shape[1:] != (self.n_u,) or len(inputs) < 2:
            raise AssertionError(
                f"inputs: expected shape (steps + 1, {self.n_u}) with at least one step, got "
                f"{inputs.shape}"
            )

    def _types(self) -> list[str]:
        """Return the type of every input element."""
        types: list[str] = []
        for signal in self.interface.inputs:
            types += [signal.type] * signal.size
        return types

    def _of_its_type(self, noise: Matrix) -> Matrix:
        """Return values that each input can have."""
        values = noise.copy()
        for column, signal_type in enumerate(self._types()):
            drawn = noise[:, column]
            if signal_type == "boolean":
                values[:, column] = drawn > 0.0
            elif signal_type == "integer":
                values[:, column] = np.round(5.0 * drawn)
        return values

    def _other_values(self, noise: Matrix) -> Matrix:
        """Return values that each input can have, all of them other than its own."""
        values = self.u + 1.0 + noise**2
        for column, signal_type in enumerate(self._types()):
            own = self.u[:, column]
            if signal_type == "boolean":
                values[:, column] = 1.0 - own
            elif signal_type == "integer":
                values[:, column] = own + 1.0
        return values

    def perturbed_in(self, name: str, k: int) -> Vector:
        """Return the inputs at row ``k`` with other values of one of them."""
        columns = self.interface.input_columns()[name]
        u: Vector = self.u[k].copy()
        u[columns] = self.perturbed[k, columns]
        return u

    def compiled(self, *, alternates: bool) -> _Bench:
        """Return the same with one prepared component, advanced by its compiled step."""
        component = _Compiled(self.prepared(), alternates=alternates)
        case = copy(self)
        case.make = lambda: component
        case.interface = component.interface
        return case

    def masks(self) -> list[Mask]:
        """Return masks of inputs with a zero-order hold: none, all, every other signal."""
        sizes = [signal.size for signal in self.interface.inputs]
        count = len(sizes)
        every_other = np.arange(count) % 2 == 0
        masks = [np.zeros(count, np.bool_), np.ones(count, np.bool_), every_other]
        different = masks[: 1 + min(count, 2)]
        return [np.repeat(mask, sizes) for mask in different]

    def prepared(self) -> Component:
        """Return a new component, prepared."""
        component = self.make()
        prepare(component, self.h, self.held, {})
        return component

    def run(self, component: Component) -> Matrix:
        """Return all rows of a prepared component, computed in one block."""
        first = self.start_outputs(component)
        rows = self.advance(component, 0, self.steps)
        return np.vstack([first, rows])

    def initialize(self, component: Component, u: Vector | None = None) -> Vector:
        """Return the initial outputs, for other inputs ``u`` where they are given."""
        inputs = read_only((self.u[0] if u is None else u).copy())
        call = partial(component.initialize, self.start, inputs)
        return self._result("initialize", call, (self.n_y,))

    def start_outputs(self, component: Component) -> Vector:
        """Initialize a component; return the outputs with which it starts."""
        self.initialize(component)
        return self.outputs(component, 0)

    def advance(self, component: Component, begin: int, end: int) -> Matrix:
        """Advance from row ``begin`` to row ``end`` in one call."""
        if begin == end:
            return np.empty((0, self.n_y))
        block = slice(begin, end + 1)
        times = read_only(self.t[block].copy())
        call = partial(component.advance, times, self.h, read_only(self.u[block].copy()))
        return self._result("advance", call, (end - begin, self.n_y))

    def outputs(self, component: Component, k: int, u: Vector | None = None) -> Vector:
        """Return the outputs at row ``k``, for other inputs ``u`` where they are given."""
        inputs = read_only((self.u[k] if u is None else u).copy())
        call = partial(component.outputs, float(self.t[k]), inputs)
        return self._result("outputs", call, (self.n_y,))

    def fed_by(self, name: str) -> Mask:
        """Return which output elements an input is declared to feed through to."""
        return self._output_mask(name, self.interface.feeds)

    def fed_initially(self, name: str) -> Mask:
        """Return which initial output elements are declared to depend on an input."""
        return self._output_mask(name, self.interface.feeds_initially)

    def _output_mask(self, name: str, inputs_of: Callable[[str], tuple[str, ...]]) -> Mask:
        mask: list[bool] = []
        for output in self.interface.outputs:
            mask += [name in inputs_of(output.name)] * output.size
        return np.array(mask, np.bool_)

    def compare(self, law: str, rows: Matrix, expected: Matrix, first: int = 0) -> None:
        """Require equal bits of rows, the first of them at row ``first``."""
        if rows.shape == expected.shape and rows.tobytes() == expected.tobytes():
            return
        rows = np.ascontiguousarray(np.atleast_2d(rows))
        expected = np.ascontiguousarray(np.atleast_2d(expected))
        wrong = np.argwhere(rows.view(np.uint64) != expected.view(np.uint64))
        if not len(wrong):
            return
        row, column = wrong[0]
        wanted = repr(float(expected[row, column]))
        self.fail(law, first + row, column, wanted, float(rows[row, column]))

    def fail(self, law: str, row: int, column: int, wanted: str, value: float) -> Never:
        """Report a value that breaks a law."""
        label = self._labels()[column]
        raise AssertionError(
            f"{law}: {label!r} at t = {self.t[row]} s: expected {wanted}, got {value!r}"
        )

    def _labels(self) -> list[str]:
        labels: list[str] = []
        for signal in self.interface.outputs:
            labels += signal.elements
        return labels

    @staticmethod
    def _result(method: str, call: Callable[[], Vector], shape: tuple[int, ...]) -> Vector:
        """Return a copy of what a method returns, float64 values of the right shape."""
        try:
            values = call()
        except ValueError as error:
            if "read-only" in str(error):  # as numpy says it, with the line in the traceback
                raise AssertionError(
                    f"{method} does not write to its arguments: {error}"
                ) from error
            raise
        problem = result_problem(values, shape)
        if problem:
            raise AssertionError(f"{method} {problem}")
        return values.copy()
