"""What a log keeps of what is found here: verdicts on estimates, errors of runs and of filters.

They stand apart from what finds them, which readers of logs do not need.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from cosim.documents import document


class Verdict(StrEnum):
    """What may be said about a parameter."""

    IDENTIFIABLE = "IDENTIFIABLE"
    WEAK = "WEAK"
    NOT_IDENTIFIABLE = "NOT_IDENTIFIABLE"
    INCONSISTENT = "INCONSISTENT"
    NO_ESTIMATE = "NO_ESTIMATE"

    def __repr__(self) -> str:
        return repr(self.value)

    @property
    def has_value(self) -> bool:
        """Whether there is a number."""
        return self not in (Verdict.NOT_IDENTIFIABLE, Verdict.NO_ESTIMATE)

    @property
    def has_interval(self) -> bool:
        """Whether an interval around the number holds, if the model does."""
        return self in (Verdict.IDENTIFIABLE, Verdict.WEAK)


@document
class ParameterVerdict:
    """What may be said about one parameter, amplitude or phase.

    Parameters
    ----------
    name : str
        In a summary that of its port.
    verdict : Verdict
    value : float or None
        None where the verdict has no value.
    standard_error : float or None
    lower, upper : float or None
        The 95 % interval, with what step and quantization may have moved the estimate by; None
        where the verdict has no interval.
    reason : str
        Of the verdict, a sentence.
    """

    name: str
    verdict: Verdict
    value: float | None = None
    standard_error: float | None = None
    lower: float | None = None
    upper: float | None = None
    reason: str = ""

    def __repr__(self) -> str:
        value = "no value" if self.value is None else f"{self.value:.6g}"
        width = "" if self.half_width is None else f" ± {self.half_width:.2g}"
        return f"<{self.name}: {value}{width} {self.verdict}>"

    @property
    def estimate(self) -> str:
        """The name."""
        return self.name

    @property
    def half_width(self) -> float | None:
        """Half the interval; None: there is none."""
        if self.lower is None or self.upper is None:
            return None
        return 0.5 * (self.upper - self.lower)


@document
class UndetectedError:
    """An error of the model that would just pass the tests of the residual.

    Parameters
    ----------
    error : str
    size : float
        In the unit of what it is on.
    half_widths : mapping of parameter or amplitude to float
        By how many half widths of its interval it moves each, where that is more than half of one.
    remedy : str
        What removes it; empty: nothing that is known.
    text : str
        All of that in a sentence.
    """

    error: str
    size: float
    half_widths: Mapping[str, float]
    remedy: str = ""
    text: str = ""

    def __str__(self) -> str:
        return self.text


@document
class Bias:
    """The leading error of a reconstruction: ``coefficient`` times a derivative of a signal.

    Parameters
    ----------
    coefficient : float
        [s] to that power which makes the error one of delta.
    derivative : int
    of : str
        ``delta``, at the instant that the reconstruction belongs to, or ``G w``.
    """

    coefficient: float
    derivative: int
    of: str


@document
class StepError:
    """The error of a signal by its step, as far as three runs show it.

    Parameters
    ----------
    largest : float or None
        Its largest amount; 0: the three runs are equal, bit for bit; None: there is no estimate.
    time : float or None
        When it is largest [s].
    last : float or None
        At the last instant, with its sign, by the last part of the run; None: not known.
    order : float or None
        Observed order; None: there is none.
    reason : str
        Why there is no estimate; empty where there is one.
    grows : bool
        The differences grow as the step is made smaller, by more than rounding does.
    is_rounding : bool
        The differences are those of rounding: a smaller step shows no more.
    bound : float or None
        What the error is within where there is no estimate, if that is known.
    """

    largest: float | None = None
    time: float | None = None
    last: float | None = None
    order: float | None = None
    reason: str = ""
    grows: bool = False
    is_rounding: bool = False
    bound: float | None = None
