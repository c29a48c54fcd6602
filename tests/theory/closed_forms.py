"""The families by their closed forms: what a component is, computed without the package.

Beside each family theta, the signal by its constants, and its basis beta(t): the functions of t
whose combination by K(D) is the signal a delay ago.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Family,
    Polynomial,
    Sine,
    TExponential,
)
from cosim.theory.disturbances.linear_family import LinearFamily
from cosim.theory.disturbed_plant import DisturbedPlant

T = np.arange(1001) * 0.02
# of the terms of a mixture
ALPHAS = (
    1.0 + 0.8 * np.sin(1.7 * T),
    1.0 + 0.8 * np.cos(2.3 * T),
    1.0 + 0.8 * np.sin(0.9 * T),
    1.0 + 0.8 * np.cos(3.1 * T),
)

# x'' = -stiffness x - damping x', seen by x
OSCILLATOR = LinearFamily(
    ((0.0, 1.0), (0.0, 0.0)),
    (((0.0, 0.0), (-1.0, 0.0)), ((0.0, 0.0), (0.0, -1.0))),
    (1.0, 0.0),
    ("stiffness", "damping"),
)


@dataclass(frozen=True)
class ClosedForm:
    """A component with numbers, and its signal."""

    family: Family
    theta: tuple[float, ...]
    constants: tuple[float, ...]

    def __call__(self, t):
        """Return f(t)."""
        return _SIGNALS[self.family.name](t, self.theta, self.constants)

    def size(self, t):
        """Return the sum of the absolute parts that f(t) is made of: its rounding is of this."""
        amplitude, *others = self.constants
        if "phase" in self.family.constants:
            crest = math.pi / 2.0 - self.theta[-1] * t
            return abs(replace(self, constants=(amplitude, crest))(t))
        zeros = (0.0,) * len(others)
        parts = [replace(self, constants=(amplitude, *zeros))]
        for k, value in enumerate(others):
            parts.append(replace(self, constants=(0.0, *zeros[:k], value, *zeros[k + 1 :])))
        return sum(abs(part(t)) for part in parts)


def _oscillator(t, theta, constants):
    stiffness, damping = theta
    x, speed = constants
    decay = damping / 2.0
    squared = stiffness - decay**2
    assert squared > 0.0
    rate = math.sqrt(squared)
    sine = (speed + decay * x) / rate
    return math.exp(-decay * t) * (x * math.cos(rate * t) + sine * math.sin(rate * t))


_SIGNALS = {
    "exponential": lambda t, theta, b: b[0] * math.exp(theta[0] * t),
    "sine": lambda t, theta, b: b[0] * math.sin(theta[0] * t + b[1]),
    "damped-sine": lambda t, theta, b: (
        b[0] * math.exp(-theta[0] * t) * math.sin(theta[1] * t + b[1])
    ),
    "constant": lambda t, theta, b: b[0],
    "ramp": lambda t, theta, b: b[0] + b[1] * t,
    "polynomial": lambda t, theta, b: sum(value * t**power for power, value in enumerate(b)),
    "t-exponential": lambda t, theta, b: (b[0] + b[1] * t) * math.exp(theta[0] * t),
    "linear": _oscillator,
}

SIZES = st.floats(-2.0, 2.0)
RATES = st.floats(0.3, 3.0)
EXPONENTS = st.floats(-1.0, 0.3)


def _of(family, *theta):
    return st.builds(
        ClosedForm,
        st.just(family),
        st.tuples(*theta),
        st.tuples(*[SIZES] * family.v),
    )


FORMS = {
    "exponential": _of(Exponential(), EXPONENTS),
    "sine": _of(Sine(), RATES),
    "damped-sine": _of(DampedSine(), st.floats(-0.3, 1.0), RATES),
    "constant": _of(Polynomial(0, "constant")),
    "ramp": _of(Polynomial(1, "ramp")),
    "polynomial": _of(Polynomial(3)),
    "t-exponential": _of(TExponential(), EXPONENTS),
    "linear": _of(OSCILLATOR, st.floats(0.5, 9.0), st.floats(-0.3, 1.0)),
}


def static_plant(components, outputs=1):
    """Return a plant without states: its outputs are the sum of all components."""
    return DisturbedPlant(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 0)),
        Bd=np.zeros((0, components)),
        C=np.zeros((outputs, 0)),
        D=np.zeros((outputs, 0)),
        Dd=np.ones((outputs, components)),
    )
