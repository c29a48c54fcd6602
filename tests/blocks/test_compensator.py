"""The compensator as a component: contract, bumpless start, what it takes as a good estimate."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cosim.arrays import NAN
from cosim.blocks.compensator import Compensator, CompensatorOptions
from cosim.blocks.observer import observer_model
from cosim.blocks.plant import descriptor_model
from cosim.blocks.source import constant
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import AssumptionError, UsageError
from cosim.testing import check_component
from cosim.theory.compensation.design import scheduled
from cosim.theory.observers.observer import design
from cosim.theory.plants.descriptor import DescriptorSystem
from tests.theory.compensated import (
    FILTER_RATE,
    designed,
    drive,
    growth,
    loop_matrix,
    observer_of,
    plant_of,
)

H = 1e-2
DRIVE = drive()


cached = cache(designed)


def compensator(*, internal=True, feedforward=False, upper=np.inf, interval=(1.0, 2.0), **options):
    gains = cached(DRIVE, lower=interval[0], upper=interval[1], ff=feedforward)
    if not internal:
        gains = replace(gains, decay_rate=None)
    given = {
        "state": "x_a",
        "R": np.eye(4),
        "largest_error": 0.05,
        "lower": np.array([-upper]),
        "upper": np.array([upper]),
        "anti_windup": True,
        "regulated": (0,),
        "n_y": 2,
    }
    own = CompensatorOptions(**{**given, **options})
    observer = observer_of(DRIVE, delta=feedforward)
    return Compensator(gains, plant_of(DRIVE), observer, own)


def inputs(steps, theta, error, seed=1):
    """Return inputs at so many points: x_a, delta, y, theta, standard_error, r."""
    signals = np.random.default_rng(seed).normal(size=(steps + 1, 10))
    signals[:, 7] = theta
    signals[:, 8] = error
    return signals


def advanced(component, u):
    """Return the outputs after every step, by name."""
    component.prepare(H, np.zeros(u.shape[1], np.bool_), {})
    component.initialize(0.0, u[0])
    rows = component.advance(H * np.arange(len(u)), H, u)
    columns = component.interface.output_columns()
    return {name: rows[:, block] for name, block in columns.items()}


@pytest.mark.fast("False-False")
@pytest.mark.parametrize(("internal", "feedforward"), [(True, True), (False, False)])
def test_it_keeps_the_contract(internal, feedforward):
    """With theta that becomes good enough on the way, and u at its limits now and then."""
    u = inputs(30, 1.5, 0.0)
    u[:7, 7:9] = NAN
    u[20:, 7:9] = NAN

    def make():
        return compensator(
            internal=internal, feedforward=feedforward, upper=2.0, interval=(1.5, 1.5)
        )

    check_component(make, inputs=u, h=H)


@pytest.mark.parametrize(
    ("theta", "error", "active"),
    [
        (1.5, 0.01, True),
        (1.5, 0.0, True),
        (NAN, NAN, False),
        (1.5, NAN, False),
        (1.98, 0.0099, True),  # 1.98 + 1.96 * 0.0099 < 2
        (1.98, 0.0105, False),  # 1.98 + 1.96 * 0.0105 > 2
        (0.98, 0.0, False),
        (1.5, 0.0751, False),  # more than 5 %
    ],
)
def test_the_internal_model_needs_an_estimate_that_is_good_enough(theta, error, active):
    """Its 95 % interval in the certified one, its standard error small; else it stays out."""
    outputs = advanced(compensator(), inputs(3, theta, error))
    assert outputs["active"].ravel().tolist() == [float(active)] * 3
    assert np.isnan(outputs["model_theta"]).all() != active


def test_u_does_not_jump_when_the_internal_model_begins():
    """At that point u is what it would be without it; from then on it differs."""
    u = inputs(8, 1.5, 0.0)
    u[:5, 7] = NAN
    outputs = advanced(compensator(), u)
    without = advanced(compensator(internal=False), u)
    assert outputs["active"].ravel().tolist() == [0, 0, 0, 0, 0, 1, 1, 1]
    scale = np.abs(without["u"]).max()
    assert np.allclose(outputs["u"][:6], without["u"][:6], rtol=0.0, atol=1e-13 * scale)
    assert np.abs(outputs["u"][6:] - without["u"][6:]).max() > 1e-6 * scale


def test_it_follows_theta_and_keeps_the_last_good_one():
    """A better estimate is taken at once; one outside its interval, or none, is not."""
    u = inputs(6, [1.5, 1.55, 2.5, NAN, 1.6, 1.6, 1.6], 0.0)
    outputs = advanced(compensator(), u)
    assert outputs["model_theta"].ravel().tolist() == [1.5, 1.55, 1.55, 1.55, 1.6, 1.6]


def test_u_stays_within_its_limits_from_the_start():
    """Also where 0 is outside of them."""
    component = compensator(lower=np.array([0.5]), upper=0.7)
    u = inputs(20, 1.5, 0.0)
    component.prepare(H, np.zeros(10, np.bool_), {})
    assert component.initialize(0.0, u[0])[0] == 0.5
    outputs = advanced(component, u)
    assert outputs["u"].min() >= 0.5
    assert outputs["u"].max() <= 0.7


def test_a_recorded_design_is_taken_without_proving_anything_again():
    """A replay needs no linear algebra; one of other shapes is refused."""
    component = compensator()
    held = np.zeros(10, np.bool_)
    design = dict(component.prepare(H, held, {}))
    changed = {**design, "before": design["before"] * 0.0}
    assert component.prepare(H, held, changed) == changed
    u = inputs(3, NAN, NAN)
    component.initialize(0.0, u[0])
    assert not component.advance(H * np.arange(4), H, u)[:, 0].any()


def test_an_unstable_interval_is_refused_before_the_run():
    """With the theta that fails: the certificate is part of the design."""
    reduced = drive()
    gains = designed(reduced, lower=1.0, upper=7.0)
    options = compensator().options
    component = Compensator(gains, plant_of(reduced), observer_of(reduced), options)
    with pytest.raises(AssumptionError, match="NOT_STABLE_IN_THE_INTERVAL"):
        component.prepare(0.2, np.zeros(10, np.bool_), {})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"largest_error": 0.0}, r"largest_error:.*0\.0"),
        ({"lower": np.array([1.0]), "upper": 1.0}, "lower < upper"),
    ],
)
def test_options_of_no_controller_are_refused(options, message):
    """With what was found."""
    with pytest.raises(UsageError, match=message):
        compensator(**options)


def test_the_loop_grows_where_the_certificate_says_so():
    """At theta = 0.5, at the rate of the eigenvalues of a loop written with other tools.

    Only a design that claims to be certified there, with the gains of 1.4, lets the internal model
    in.
    """
    system = DescriptorSystem.partitioned(
        A=DRIVE.A_a, Bu=DRIVE.B_1a, Bd=DRIVE.B_2a, C=DRIVE.C3, n_a=4
    )
    designed_observer = design(DRIVE, poles=[-6.0, -8.0], filter_rate=FILTER_RATE)
    component = compensator(interval=(1.4, 1.6))
    honest = component.prepare(H, np.zeros(10, np.bool_), {})
    one = {name: honest[name][:1] for name in ("K_w", "X", "H")}
    forged = {**honest, **one, "theta": np.array([[0.4], [1.6]])}
    parts = {
        "plant": Linear(descriptor_model(system, [0.1, 0.0, 0.0, 0.0])),
        "observer": Linear(observer_model(DRIVE, designed_observer)),
        "compensator": component,
        "delta": constant([0.0]),
        "theta": constant([0.5]),
        "error": constant([0.0]),
    }
    connections = {
        "plant.u": "compensator.u",
        "plant.delta": "delta.y",
        "observer.u": "compensator.u",
        "observer.y": "plant.y",
        "compensator.x_a": "observer.x_a",
        "compensator.y": "plant.y",
        "compensator.theta": "theta.y",
        "compensator.standard_error": "error.y",
    }
    memory = Memory()
    designs = {"compensator": forged}
    run(Graph(parts, connections), Clock(40.0, H), memory, designs=designs)
    assert memory["compensator.active"][-1] == 1.0
    gains = cached(DRIVE, lower=1.4, upper=1.6, ff=False)
    at = scheduled(gains, gains.box, 4).at(gains.box.lower)
    rate = growth(loop_matrix(DRIVE, gains, 0.5, H, at=at), H)
    assert rate > 0.1
    size = np.linalg.norm(memory["compensator.w"], axis=1)
    # over whole periods of the growing mode, close to theta: its envelope alone
    early = size[1500:2500].max()
    late = size[3000:4000].max()
    assert np.log(late / early) / 15.0 == pytest.approx(rate, rel=0.05)
