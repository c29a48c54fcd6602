"""What noise the residual of the best values is, by the tests of identification.

Where its samples have structure, as a wrong model leaves it, no interval holds
(:mod:`cosim.scenario.identification.residual`). Where they are colored noise, N samples say as much
as N over its largest power at a frequency, relative to white noise: that is so for parameters whose
effect is at that frequency, and for all others there is more. So it is where one sample follows the
last one, too, as noise does that passes a filter of first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import RunError
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.metrics import parse_metric_text
from cosim.studies.tuning.sampled_residual import SampledResidual
from cosim.studies.workers.pool import WorkerPool

LEAST_ROWS: Final = 10
SEEN: Final = 2.6  # deviations of the correlation at lag 1, which 1 of 100 white residuals has
TINY: Final = float(np.finfo(np.float64).tiny)
_OPENER: Final = "cosim.studies.tuning.sampled_residual:open_residual_runner"


@dataclass(frozen=True, slots=True)
class ResidualCheck:
    """What noise a residual is.

    Parameters
    ----------
    rows : int
        Of which the rms is.
    samples : int
        On which they rest; 0: these are not known.
    ratio : float
        Of their rms over that of all rows: lines between samples average the noise.
    neighbours : float
        The correlation of one sample with the next.
    problem : str
        Why it is not what noise leaves; empty: it is.
    independent : int
        As many samples of white noise say as much; all of them where it is white.
    freedom : float
        Degrees of freedom with which that is known.
    """

    rows: int
    samples: int
    ratio: float
    neighbours: float
    problem: str
    independent: int
    freedom: float


def check_residual(residual: SampledResidual) -> ResidualCheck | None:
    """Return what noise a residual is.

    None: there are too few rows, or all are zero. Its mean is not removed: that of noise is 0.
    """
    from cosim.scenario.identification.residual import residual_noise  # takes long to import

    rows = residual.rows
    if residual.problem:
        return ResidualCheck(rows, 0, 1.0, math.nan, residual.problem, 0, math.inf)
    largest = float(np.abs(residual.samples).max(initial=0.0))
    if rows < LEAST_ROWS or not 0.0 < largest < math.inf or not 0.0 < residual.rms < math.inf:
        return None
    scaled = residual.samples / largest
    samples = scaled.size
    if samples < LEAST_ROWS:
        few = f"{samples} samples are too few to tell whether noise explains the residual"
        return ResidualCheck(rows, samples, 1.0, math.nan, few, samples, math.inf)
    problem, power, freedom = residual_noise(residual.t, scaled)
    neighbours = float(scaled[1:] @ scaled[:-1]) / max(float(scaled @ scaled), TINY)
    size = min(abs(neighbours), 1.0 - 1.0 / samples)
    if size * math.sqrt(samples) > SEEN:  # tests of many lags let it pass in few samples
        power = max(power, (1.0 + size) / (1.0 - size))
    return ResidualCheck(
        rows=rows,
        samples=samples,
        ratio=math.sqrt(float(np.mean(scaled**2))) / (residual.rms / largest),
        neighbours=neighbours,
        problem=problem,
        independent=max(1, round(samples / power)),
        freedom=freedom,
    )


def residual_at(
    subject: StudySubject,
    objective: str,
    members: Sequence[StudyMember],
    *,
    timeout: float | None = None,
) -> tuple[SampledResidual, Matrix | None] | None:
    """Return the residual of a member at its samples, and how others differ from it.

    Parameters
    ----------
    subject : StudySubject
    objective : str
        The name of its metric that is the rms of the residual.
    members : sequence of StudyMember
        The member, and p others.
    timeout : float, optional
        Wall time that a run may take [s].

    Returns
    -------
    residual : SampledResidual
    differences : Matrix, shape (n, p), or None
        Of W' times the rows of the others; None: the samples are the rows, or not known.

    None: a run failed or could not begin, or its rows are chosen by a condition with a duration.
    """
    reduction = parse_metric_text(objective, subject.metrics[objective]).reductions[0]
    if reduction.where is not None and reduction.where.duration_ns:
        return None
    try:
        with WorkerPool(_OPENER, subject, 1, timeout=timeout) as pool:
            found, *_ = _residuals(pool, members[:1])
            if found is None or found.are_rows:
                return None if found is None else (found, None)
            others = _residuals(pool, members[1:])
    except RunError:  # such as a file that has changed: the result of the search stays
        return None
    columns = []
    for other in others:
        if other is None or not np.array_equal(other.t, found.t):
            problem = "how the residual moves with each value is not known: not all runs beside "
            return replace(found, problem=f"{problem}the best values have the same rows"), None
        columns.append(other.weighed - found.weighed)
    return found, np.stack(columns, axis=1)


def _residuals(pool: WorkerPool, members: Sequence[StudyMember]) -> list[SampledResidual | None]:
    """Return the residuals of members in their order; None: a run kept nothing."""
    ended = {member.number: outcome for member, outcome in pool.run(members)}
    return [SampledResidual.of_metrics(ended[member.number].metrics) for member in members]
