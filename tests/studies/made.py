"""Studies that were never run, as they are read."""

import numpy as np
import pyarrow
from scipy import stats

from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.results import results_of_study


class MadeStudy:
    """What is read of a study, of columns in memory."""

    def __init__(self, columns, parameters, metrics, *, planned=None, units=None):
        count = len(next(iter(columns.values())))
        outcome = {
            "member": np.arange(count),
            "status": ["complete"] * count,
            "reason": [""] * count,
            "warnings": pyarrow.nulls(count, "string"),
            "steps": [1000] * count,
            "wall_time": np.full(count, 0.25),
            "worker": ["1"] * count,
            "log": pyarrow.nulls(count, "string"),
        }
        self._table = pyarrow.table({**outcome, **columns})
        self.name = "tolerances"
        self.planned = count if planned is None else planned
        self.parameters = tuple(parameters)
        self.metrics = tuple(metrics)
        self.units = units or {}

    def table(self, columns=None):
        return self._table if columns is None else self._table.select(list(columns))

    def row(self, number):
        return self._table.slice(number, 1).to_pylist()[0]


def command_of(number):
    return f"cosim run academic --set observer.filter_rate={100.0 + number!r}"


def tolerances(count=200):
    """Return a random study in which some members failed, and some have no value."""
    rng = np.random.default_rng(1)
    rate = np.exp(rng.uniform(np.log(10.0), np.log(1e4), count))
    mass = rng.normal(2.0, 0.1, count)
    rms = 0.05 + 3.0 / rate + 0.02 * rng.normal(size=count) ** 2
    settling = 0.4 * mass + 0.02 * rng.normal(size=count)
    status = np.full(count, "complete", object)
    reason = np.full(count, "", object)
    status[[3, 17, 40]] = "failed"
    reason[3] = "RunawayError: the values of loop 1 grow without end at t = 0.25 s"
    reason[17] = "RunawayError: the values of loop 1 grow without end at t = 1.5 s"
    reason[40] = "crashed: signal 11 (SIGSEGV)"
    reason[60] = "ended at 3 s by the action 'stop when settled'"
    numbers = {"rms": rms, "settling": settling}
    for name, values in numbers.items():
        empty = status == "failed"
        if name == "settling":
            empty = empty | (np.arange(count) % 50 == 5)
        numbers[name] = pyarrow.array(values, mask=empty)
    verdict = pyarrow.array(np.where(rms < 0.1, "identifiable", "weak"), mask=status == "failed")
    columns = {
        "observer.filter_rate": rate,
        "plant.mass": mass,
        **numbers,
        "verdict": verdict,
        "status": pyarrow.array(status, "string"),
        "reason": pyarrow.array(reason, "string"),
    }
    parameters = ("observer.filter_rate", "plant.mass")
    study = MadeStudy(
        columns,
        parameters,
        ("rms", "settling", "verdict"),
        planned=count + 10,
        units={"settling": "s", "plant.mass": "kg", "observer.filter_rate": "rad/s"},
    )
    layout = StudyLayout("random", samples=count + 10, parameters=parameters)
    return study, results_of_study(study, layout)


def saltelli_study():
    """Return a Saltelli study of y = 3 p + 2 q, whose base point 4 has a failure."""
    rng = np.random.default_rng(0)
    points = stats.qmc.Sobol(4, rng=rng).random(256)
    of_a, of_b = points[:, :2], points[:, 2:]
    mixed = [np.column_stack([of_b[:, 0], of_a[:, 1]]), np.column_stack([of_a[:, 0], of_b[:, 1]])]
    rows = np.concatenate([of_a, of_b, *mixed])
    status = np.full(1024, "complete", object)
    status[256 + 4] = "failed"
    columns = {"p": rows[:, 0], "q": rows[:, 1], "y": rows @ [3.0, 2.0], "z": np.ones(1024)}
    study = MadeStudy({**columns, "status": list(status)}, ("p", "q"), ("y", "z"))
    layout = StudyLayout("saltelli", samples=1024, parameters=("p", "q"))
    return results_of_study(study, layout)
