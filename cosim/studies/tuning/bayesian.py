"""Search by optuna's tree-structured Parzen estimator, also over lists of values and swaps.

Optuna's study lives in memory only. It is asked for batches of one fixed size and told all their
costs in order: so it proposes the same points whenever it begins again with the same seed.
"""

from __future__ import annotations

import math
from typing import Any, Final

from cosim.errors import UsageError
from cosim.studies.tuning.points import value_name
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.trials import Trials

BATCH: Final = 4


def need_optuna() -> Any:
    """Return the module optuna.

    Raises
    ------
    UsageError
        If it is not installed.
    """
    try:
        import optuna
    except ImportError as error:
        raise UsageError(
            "the method 'optuna' needs optuna, which is not installed: pip install optuna, or, in "
            "a clone of cosim, pip install -e '.[optuna]'"
        ) from error
    return optuna


def search_with_optuna(space: SearchSpace, trials: Trials, first: dict[str, Any], seed: int) -> str:
    """Search until the trials have ended, or all points were tried; return that.

    Parameters
    ----------
    space : SearchSpace
    trials : Trials
    first : mapping of key to value
        Tried before all others; keys that are missing are chosen by optuna.
    seed : int

    Raises
    ------
    SearchEnded
        If the trials have ended.
    """
    optuna = need_optuna()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    distributions = {key.key: _distribution(optuna, key) for key in space.keys}
    study.enqueue_trial(_encoded(space, first))
    while len(trials.all) < _points(space):
        asked = [study.ask(distributions) for _ in range(BATCH)]
        points = [_decoded(space, each.params) for each in asked]
        for each, cost in zip(asked, trials.costs(points), strict=True):
            study.tell(each, cost)
    return "all combinations of the values were tried"


def _points(space: SearchSpace) -> float:
    """Return how many points there are: infinitely many between bounds."""
    return math.inf if space.bounded else math.prod(len(key.choices) for key in space.choices)


def _distribution(optuna: Any, key: Any) -> Any:
    """Return coordinates from 0 to 1, or the numbers of the choices."""
    if isinstance(key, BoundedKey):
        return optuna.distributions.FloatDistribution(0.0, 1.0)
    return optuna.distributions.CategoricalDistribution(range(len(key.choices)))


def _decoded(space: SearchSpace, found: dict[str, Any]) -> dict[str, Any]:
    point = {}
    for key in space.keys:
        value = found[key.key]
        if isinstance(key, BoundedKey):
            point[key.key] = key.value(value)
        else:
            point[key.key] = key.choices[value]
    return point


def _encoded(space: SearchSpace, point: dict[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key in space.keys:
        if key.key not in point:
            continue
        value = point[key.key]
        if isinstance(key, BoundedKey):
            values[key.key] = key.coordinate(value)
            continue
        names = [value_name(choice) for choice in key.choices]
        if value_name(value) in names:
            values[key.key] = names.index(value_name(value))
    return values
