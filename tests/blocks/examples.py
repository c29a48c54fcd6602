"""Disturbances with their regressions, of which identifiers estimate the parameters."""

from __future__ import annotations

import numpy as np

from cosim.blocks.regressor import Regressor
from cosim.native.numerics.expression import compile_expression
from cosim.theory.disturbances.families import Exponential, Sine, coefficients, group_by_alpha
from cosim.theory.disturbances.regression import eta, expand, mu
from cosim.theory.estimators.least_squares import least_squares, plan, recover, trapezoid_weights
from tests.blocks.stepping import times

STEP_NS = 10_000_000


H = 0.01


A = "1.35 + 0.25*sin(1.7*t)"


B = "1.1 + 0.2*cos(2.3*t)"


def amplitude(text, t):
    return (
        1.35 + 0.25 * np.sin(1.7 * t)
        if text == A
        else 1.1 + 0.2 * np.cos(2.3 * t)
        if text == B
        else np.ones_like(t)
    )


class Example:
    """A disturbance, its regression and its plan of recovery."""

    def __init__(self, alphas, families, thetas, delays, stop):
        self.delays = delays
        self.thetas = thetas
        self.groups = group_by_alpha(alphas, families)
        self.terms = expand(tuple(group.size for group in self.groups))
        self.recovery = plan(self.terms, self.groups, delays)
        self.t = times(round(stop / H), STEP_NS)
        self.steps = [round(D / H) for D in delays]
        self.delta = sum(
            amplitude(alpha, self.t)
            * (
                np.exp(theta * self.t)
                if family.v == 1
                else 0.8 * np.sin(theta * self.t) + 0.4 * np.cos(theta * self.t)
            )
            for alpha, family, theta in zip(alphas, families, thetas, strict=True)
        )
        first = max(self.steps)
        delayed = np.stack([self.delta[first - n : len(self.t) - n] for n in self.steps], axis=1)
        moments = np.stack([self.t[first:] - D for D in delays], axis=1)
        self.alpha = np.stack([amplitude(group.alpha, moments) for group in self.groups], axis=-1)
        self.mu = np.full((len(self.t), len(self.terms)), np.nan)
        self.mu[first:] = mu(self.terms, delayed, self.alpha)

    def regressor(self):
        programs = [compile_expression(group.alpha) for group in self.groups]
        return Regressor(self.terms, alphas=programs, steps=self.steps, delays=self.delays)

    def exact_eta(self):
        K = [
            coefficients(group.families, [self.thetas[i] for i in group.components], self.delays)
            for group in self.groups
        ]
        return eta(self.terms, K)

    def expected(self, start, end, prior=None, *, held=False):
        """Estimate at row ``end`` from the data since ``start`` [s], by the theory."""
        first = round(start / H)
        if held:
            computed = least_squares(self.mu[first:end], np.full(end - first, H), prior)
        else:
            computed = least_squares(
                self.mu[first : end + 1], trapezoid_weights(self.t[first : end + 1]), prior
            )
        return np.concatenate([recover(self.recovery, computed), computed])


EXAMPLES = {
    "two alphas": Example([A, B], [Exponential()] * 2, [-0.1, -0.3], [1.0, 2.0, 3.0], 12.0),
    "two exponentials of one alpha": Example(
        ["1", "1"], [Exponential()] * 2, [-0.1, -0.3], [1.0, 2.0, 3.0], 12.0
    ),
    "a sine": Example([A], [Sine()], [1.3], [0.5, 1.0, 1.5], 10.0),
    "delays in another order": Example(
        [A, B], [Exponential()] * 2, [-0.1, -0.3], [0.0, 2.0, 1.0], 8.0
    ),
}
