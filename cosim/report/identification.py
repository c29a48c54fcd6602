"""What logs say about theta, after their runs: parameters, residual, validation, irregular part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any, Final

import numpy as np

from cosim.report.summary import noise_text
from cosim.scenario.assessing import plain_amplitudes
from cosim.scenario.identifying import (
    IdentifierRecord,
    LogIdentification,
    irregular_interval,
    validate_record,
)
from cosim.scenario.recorded_metadata import IdentificationRecord
from cosim.theory.validation import Validation, ValidationVerdict

# relative difference of both sides of an interval around an estimate up to which the first order,
# which has two equal ones, is said to hold
FIRST_ORDER: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class IrregularEffect:
    """What an irregular part of the disturbance within a bound leaves open of one theta.

    Parameters
    ----------
    name : str
    first_order : float
        Half width around the estimate.
    holds : bool
        Whether the first order does: the truths behind this estimate reach as far to both sides.
    lower, upper : float or None
        What the data and the estimate allow, by linear programs; None: no theta explains them with
        this bound.
    """

    name: str
    first_order: float
    holds: bool
    lower: float | None
    upper: float | None


@dataclass(frozen=True, kw_only=True)
class IrregularPart:
    """What ``|delta_0| <= bound`` leaves open, and what it cost to compute that.

    Parameters
    ----------
    bound : float
    effects : tuple of IrregularEffect
    confidence : float
        Probability of the bounds of the noise.
    seconds : float
    """

    bound: float
    effects: tuple[IrregularEffect, ...]
    confidence: float
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationReport:
    """What is said of logs.

    Parameters
    ----------
    found : LogIdentification
    validations : tuple of (IdentifierRecord, Validation)
    irregular : IrregularPart or None
    """

    found: LogIdentification
    validations: tuple[tuple[IdentifierRecord, Validation], ...] = ()
    irregular: IrregularPart | None = None

    @property
    def failed(self) -> bool:
        """Whether the model does not hold for a log that was not used."""
        return any(
            validation.verdict is ValidationVerdict.FAILS for _, validation in self.validations
        )

    @property
    def noise(self) -> str:
        """What is known of the noise of y."""
        record = IdentificationRecord.model_validate(self.found.assessment.to_dict())
        return noise_text(record)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content: dict[str, Any] = {
            "identifier": self.found.records[0].identifier,
            "offset": self.found.offset,
            **self.found.assessment.to_dict(),
            "logs": self._logs(),
        }
        if self.validations:
            content["validation"] = [
                {"log": record.log.label, **validation.to_dict()}
                for record, validation in self.validations
            ]
        if self.irregular is not None:
            content["irregular"] = self.irregular.to_dict()
        return content

    def _logs(self) -> list[dict[str, Any]]:
        fit = self.found.assessment.fit
        amplitudes = plain_amplitudes(self.found.amplitudes)
        logs = []
        for i, record in enumerate(self.found.records):
            logs.append(
                {
                    "log": record.log.label,
                    "samples": record.data.samples,
                    "amplitudes": amplitudes[i],
                    "x0": fit.x0[i].tolist(),
                    "offset": fit.offset[i].tolist(),
                }
            )
        return logs


def report_identification(
    found: LogIdentification,
    *,
    others: Sequence[IdentifierRecord] = (),
    irregular: float | None = None,
) -> IdentificationReport:
    """Collect what is said of a fit.

    Parameters
    ----------
    found : LogIdentification
    others : sequence of IdentifierRecord
        Of logs that were not used, which the fit is held against.
    irregular : float, optional
        Bound of an irregular part of the disturbance.

    Raises
    ------
    UsageError
        If one of the others is of another model, or an irregular part cannot be bounded for.
    """
    validations = tuple((other, validate_record(found, other)) for other in others)
    part = None if irregular is None else _irregular_part(found, irregular)
    return IdentificationReport(found=found, validations=validations, irregular=part)


def _irregular_part(found: LogIdentification, bound: float) -> IrregularPart:
    began = perf_counter()
    result = irregular_interval(found, bound)
    seconds = perf_counter() - began
    theta = found.assessment.fit.theta
    effects = []
    for j, half_width in enumerate(result.half_width.tolist()):
        below, above = np.abs(result.around_estimate[j] - theta[j]).tolist()
        lower = float(result.lower[j])
        upper = float(result.upper[j])
        is_known = not np.isnan(lower + upper)
        effects.append(
            IrregularEffect(
                name=f"theta[{j}]",
                first_order=half_width,
                holds=bool(abs(above - below) <= FIRST_ORDER * (above + below)),
                lower=lower if is_known else None,
                upper=upper if is_known else None,
            )
        )
    return IrregularPart(
        bound=bound, effects=tuple(effects), confidence=result.confidence, seconds=seconds
    )
