"""The certificate of a run, from its recording: what is the error of the step, and what not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import RecordedRun
from cosim.core.recording import Recording
from cosim.errors import LogError, UnknownSignalError, command, flag, listing, nearest
from cosim.report.summary import Summary, summarize
from cosim.scenario.record import StepSearch, StepTrial, recorded_certificate
from cosim.theory.documents import StepError


@dataclass(frozen=True)
class SignalCertificate(StepError):
    """The error of the step in one element of an output, ``signal``, in ``unit``.

    ``largest`` is an estimate. Where it is None the error is within ``bound``; if that is None,
    too, nothing is known.
    """

    signal: str = ""
    unit: str | None = None

    @property
    def is_bounded(self) -> bool:
        """Whether there is an upper bound in place of an estimate, and not that of rounding."""
        return self.bound is not None and not self.is_rounding


@dataclass(frozen=True)
class CouplingShare:
    """How much of the error of an estimate at the end of a run is the error of the step.

    Parameters
    ----------
    estimate : str
    error : float
        The estimate less the truth.
    coupling : float or None
        Of that, the error of the step; None: there is no estimate of it.
    """

    estimate: str
    error: float
    coupling: float | None

    def __str__(self) -> str:
        if not self.error:
            return "no error at the end"
        text = f"error {self.error:+.3g} at the end"
        if self.coupling is None:
            return f"{text}; the share of the coupling is not known"
        percent = float(f"{100.0 * self.coupling / self.error:.2g}")
        return f"{text}, of which {self.coupling:+.3g} ({percent:g} %) is coupling error"


@dataclass(frozen=True)
class StepCertificate(Mapping[str, SignalCertificate]):
    """How large the error of the communication step is in a run, signal by signal.

    A mapping of the elements of outputs by their names, as a run is one of its signals: empty where
    nothing was compared.

    Parameters
    ----------
    step : float
        Of the run [s].
    finer_steps : tuple of float
        Of the others [s].
    every : int
        Every so many communication points were compared.
    ends : tuple of float
        The instants [s] at which the runs ended; they were compared up to the first.
    problem : str
        Why nothing was compared; empty where something was.
    solvers : tuple of str
        Components whose own solvers err too: that is in the figures.
    signals : tuple of SignalCertificate
        The outputs by their elements.
    shares : tuple of CouplingShare
        Of the estimates of which the truth is a number.
    tolerances : mapping of signal to float
        Of the search for the step; empty where the scenario gives it.
    trials : tuple of StepTrial
        Of that search.
    """

    step: float
    finer_steps: tuple[float, ...]
    every: int
    ends: tuple[float, ...]
    problem: str
    solvers: tuple[str, ...]
    signals: tuple[SignalCertificate, ...]
    shares: tuple[CouplingShare, ...]
    tolerances: Mapping[str, float] = field(default_factory=dict)
    trials: tuple[StepTrial, ...] = ()

    def __getitem__(self, signal: str) -> SignalCertificate:
        """Return the element of a signal.

        Raises
        ------
        UnknownSignalError
            If there is none of that name; names the nearest, or the elements of a signal.
        """
        for entry in self.signals:
            if entry.signal == signal:
                return entry
        names = list(self)
        elements = [name for name in names if name.startswith(f"{signal}[")]
        suggestion = f"available: {listing(elements)}" if elements else nearest(str(signal), names)
        reason = f": {self.problem}" if self.problem else f"; {suggestion}"
        raise UnknownSignalError(f"no error estimate of {signal!r}{reason}")

    def __iter__(self) -> Iterator[str]:
        return (entry.signal for entry in self.signals)

    def __len__(self) -> int:
        return len(self.signals)

    def search(self) -> Iterator[tuple[str, str]]:
        """Yield the steps that were tried, and what was found."""
        wanted = ", ".join(f"{signal} {value:g}" for signal, value in self.tolerances.items())
        for trial in sorted(self.trials, key=lambda trial: -trial.step):
            text = trial.failure or f"within {wanted}"
            if trial.step == self.step and not trial.failure:
                text += ": the largest such step that divides all given times"
            yield f"step {trial.step:g} s", text

    def notes(self) -> Iterator[str]:
        """Yield what is to be known of the figures."""
        if self.solvers:
            yield f"includes the solver errors of {', '.join(self.solvers)}"
        if len(set(self.ends)) > 1:
            ends = ", ".join(f"{end:g} s" for end in self.ends)
            yield f"the three runs ended at {ends}; compared up to {min(self.ends):g} s"
        if self.every > 1:
            yield f"compared at every {self.every}th communication point"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = asdict(self)
        content["signals"] = [
            {"signal": one.pop("signal"), "unit": one.pop("unit"), **one}
            for one in content["signals"]
        ]
        for trial in content["trials"]:
            del trial["largest"]
        return content


def certificate(recording: RecordedRun) -> StepCertificate:
    """Return the certificate of a run: the error of its communication step, signal by signal.

    It is Richardson's estimate from runs with half the step and a quarter, where these show one:
    :mod:`cosim.theory.richardson` and :mod:`cosim.scenario.running.certificate`.

    Raises
    ------
    LogError
        If the run has none.
    """
    content = certificate_of(recording, summarize(recording))
    if content is None:
        raise LogError(
            f"{recording.label} has no error estimate; {command('run')} with {flag('certify')} "
            "makes one"
        )
    return content


def certificate_of(recording: Recording, summary: Summary) -> StepCertificate | None:
    """Return the certificate of a run that is summarized already; None: it has none."""
    record = recorded_certificate(recording)
    if record is None:
        return None
    signals = []
    for channel in declared_channels(recording.channels).values():
        for signal in channel.interface.outputs:
            for element, unit in zip(signal.elements, signal.measures, strict=True):
                name = f"{channel.name}.{element}"
                if name in record.signals:
                    error = vars(record.signals[name])
                    signals.append(SignalCertificate(**error, signal=name, unit=unit.name))
    shares = []
    for value in summary.values:
        if value.value is not None and value.estimate in record.signals:
            coupling = record.signals[value.estimate].last
            shares.append(CouplingShare(value.estimate, value.value - value.truth, coupling))
    content = {**vars(record), "signals": tuple(signals), "shares": tuple(shares)}
    search = content.pop("search") or StepSearch()
    return StepCertificate(**content, **vars(search))
