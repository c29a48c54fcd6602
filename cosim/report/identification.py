"""What logs say about theta, after their runs: parameters, residual, validation, irregular part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from cosim.documents import plain
from cosim.report.summary import noise_text
from cosim.scenario.identification.irregular import irregular_part
from cosim.scenario.identification.run_verdicts import verdicts_of
from cosim.scenario.identifying import IdentifierRecord, LogIdentification
from cosim.scenario.record import IrregularPart
from cosim.theory.assessment.validation import Validation, ValidationVerdict
from cosim.theory.bounded.feasible_program import Watch


@dataclass(frozen=True, kw_only=True)
class TimedPart:
    """What an irregular part within a bound leaves open, and what it cost to compute that.

    Parameters
    ----------
    part : IrregularPart
    seconds : float
    """

    part: IrregularPart
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**self.part.to_dict(), "seconds": self.seconds}


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationReport:
    """What is said of logs.

    Parameters
    ----------
    identification : LogIdentification
    validations : tuple of (IdentifierRecord, Validation)
    irregular : TimedPart or None
    """

    identification: LogIdentification
    validations: tuple[tuple[IdentifierRecord, Validation], ...] = ()
    irregular: TimedPart | None = None

    @property
    def failed(self) -> bool:
        """Whether the model does not hold for a log that was not used."""
        return any(
            validation.verdict is ValidationVerdict.FAILS for _, validation in self.validations
        )

    @property
    def noise(self) -> str:
        """What is known of the noise of y."""
        return noise_text(verdicts_of(self.identification.assessment))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content: dict[str, Any] = {
            "identifier": self.identification.records[0].identifier,
            "offset": self.identification.assessment.problem.offset,
            **self.identification.assessment.to_dict(),
            "undetected": [plain(error) for error in self.identification.undetected],
            "logs": self._logs(),
            "contradictions": list(self.identification.contradictions),
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
        fit = self.identification.assessment.fit
        logs = []
        for i, record in enumerate(self.identification.records):
            logs.append(
                {
                    "log": record.log.label,
                    "samples": record.data.samples,
                    "amplitudes": list(map(plain, self.identification.amplitudes[i])),
                    "x0": fit.x0[i].tolist(),
                    "offset": fit.offset[i].tolist(),
                }
            )
        return logs


def report_identification(
    identification: LogIdentification,
    *,
    others: Sequence[IdentifierRecord] = (),
    irregular: float | None = None,
    watch: Watch | None = None,
) -> IdentificationReport:
    """Collect what is said of a fit.

    Parameters
    ----------
    identification : LogIdentification
    others : sequence of IdentifierRecord
        Of logs that were not used, which the fit is held against.
    irregular : float, optional
        Bound of an irregular part of the disturbance.
    watch : callable, optional
        Is told after every linear program for it how many have been solved.

    Raises
    ------
    UsageError
        If one of the others is of another model, or an irregular part cannot be bounded for.
    """
    validations = tuple((other, identification.validate(other)) for other in others)
    part = None if irregular is None else _irregular_part(identification, irregular, watch)
    return IdentificationReport(
        identification=identification, validations=validations, irregular=part
    )


def _irregular_part(
    identification: LogIdentification, bound: float, watch: Watch | None
) -> TimedPart:
    began = perf_counter()
    part = irregular_part(bound, identification.guaranteed_interval(bound, watch))
    return TimedPart(part=part, seconds=perf_counter() - began)
