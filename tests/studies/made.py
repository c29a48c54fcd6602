"""Studies that were never run, as they are read."""

import numpy as np
import pyarrow
from scipy import stats

from cosim.studies.layout import MemberColumns, StudyLayout, results_of_study


class MadeStudy:
    """What is read of a study, of columns in memory."""

    def __init__(self, columns, parameters, metrics, *, planned=None, units=None):
        count = len(next(iter(columns.values())))
        outcome = {
            "member": np.arange(count),
            "status": pyarrow.array(["complete"] * count, "string"),
            "reason": pyarrow.array([""] * count, "string"),
            "warnings": pyarrow.nulls(count, "string"),
            "steps": [1000] * count,
            "wall_time": np.full(count, 0.25),
        }
        self._table = pyarrow.table({**outcome, **columns})
        self.name = "tolerances"
        self.planned = count if planned is None else planned
        self.parameters = tuple(parameters)
        self.metrics = tuple(metrics)
        self.units = units or {}

    def table(self, columns=None, members=None):
        table = self._table if members is None else self._table.take(list(members))
        return table if columns is None else table.select(list(columns))


def columns_of(metrics, *, parameters=None, failed=()):
    """Return the columns of members with the metrics given: numbers, or texts and None."""
    arrays = {}
    for name, values in metrics.items():
        is_text = any(isinstance(value, str) for value in values)
        arrays[name] = np.array(values, object if is_text else np.float64)
    numbers = np.arange(len(next(iter(arrays.values()))))
    none = np.full(len(numbers), "", object)
    varied = {key: np.array(values) for key, values in (parameters or {}).items()}
    return MemberColumns(numbers, np.isin(numbers, list(failed)), none, varied, arrays, none)


def command_of(number):
    return f"cosim run academic --set observer.filter_rate={100.0 + number!r}"


def tolerances(count=200):
    """Return a random study in which members 3, 17 and 40 failed, and some have no value."""
    rng = np.random.default_rng(1)
    failed = np.isin(np.arange(count), [3, 17, 40])
    rate = np.exp(rng.uniform(np.log(10.0), np.log(1e4), count))
    mass = rng.normal(2.0, 0.1, count)
    rms = 0.05 + 3.0 / rate + 0.02 * rng.normal(size=count) ** 2
    settling = 0.4 * mass + 0.02 * rng.normal(size=count)
    reason = np.full(count, "", object)
    reason[[3, 17, 40, 60]] = (
        "RunawayError: the values of loop 1 grow without end at t = 0.25 s",
        "RunawayError: the values of loop 1 grow without end at t = 1.5 s",
        "crashed: signal 11 (SIGSEGV)",
        "ended at 3 s by the action 'stop when settled'",
    )
    columns = {
        "observer.filter_rate": rate,
        "plant.mass": mass,
        "rms": pyarrow.array(rms, mask=failed),
        "settling": pyarrow.array(settling, mask=failed | (np.arange(count) % 50 == 5)),
        "verdict": pyarrow.array(np.where(rms < 0.1, "identifiable", "weak"), mask=failed),
        "status": pyarrow.array(np.where(failed, "failed", "complete")),
        "reason": pyarrow.array(reason, "string"),
    }
    parameters = ("observer.filter_rate", "plant.mass")
    units = {"settling": "s", "plant.mass": "kg", "observer.filter_rate": "rad/s"}
    metrics = ("rms", "settling", "verdict")
    study = MadeStudy(columns, parameters, metrics, planned=count + 10, units=units)
    layout = StudyLayout("random", samples=count + 10, parameters=parameters)
    return study, results_of_study(study, layout)


def rows_of_matrices(dimension, count, seed=0, *, independent=False):
    """Return points of the unit cube in the rows A, B, AB_1, ..., AB_d: shape (d, d + 2, n)."""
    rng = np.random.default_rng(seed)
    sobol = stats.qmc.Sobol(2 * dimension, rng=rng)
    points = (rng.random((count, 2 * dimension)) if independent else sobol.random(count)).T
    of_a, of_b = points[:dimension], points[dimension:]
    rows = np.arange(dimension)[:, np.newaxis]
    mixed = [np.where(rows == k, of_b, of_a) for k in range(dimension)]
    return np.stack([of_a, of_b, *mixed], axis=1)


def saltelli():
    """Return a Saltelli study of y = 3 p + 2 q, whose base point 4 failed."""
    p, q = rows_of_matrices(2, 256).reshape(2, -1)
    status = ["complete"] * 1024
    status[256 + 4] = "failed"
    columns = {"p": p, "q": q, "y": 3.0 * p + 2.0 * q, "z": np.ones(1024), "status": status}
    study = MadeStudy(columns, ("p", "q"), ("y", "z"))
    layout = StudyLayout("saltelli", samples=1024, parameters=("p", "q"))
    return study, results_of_study(study, layout)
