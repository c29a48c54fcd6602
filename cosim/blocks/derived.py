"""Derived signals: expressions over signals of other components."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.blocks.static import CompiledStatic
from cosim.core.signals import Interface, Signal, Variability
from cosim.native.numerics.expression import Program, compile_over_signals
from cosim.native.numerics.jumps import jumps_with_signals
from cosim.native.numerics.programs import expression_step


def signals_of(texts: Sequence[str]) -> tuple[str, ...]:
    """Return the signals in expressions, each once, in their order.

    Raises
    ------
    UsageError
        If a text is no expression over signals.
    """
    names: dict[str, None] = {}
    for text in texts:
        names.update(dict.fromkeys(compile_over_signals(text).signals))
    return tuple(names)


def derived(
    texts: Sequence[str],
    *,
    variability: Variability = "inherited",
    optional: bool = False,
    unit: str | None = None,
) -> CompiledStatic:
    """Build ``y_i``, expressions over the inputs ``u1``, ``u2``, ... and ``t``.

    The inputs stand for :func:`signals_of` the texts, in their order.

    Parameters
    ----------
    texts : sequence of str
        One expression an element of y; :mod:`cosim.native.numerics.expression` describes the
        language.
    variability : {"continuous", "discrete", "inherited"}
    optional : bool
        Whether inputs, and so y, may have no value.
    unit : str or None
        Of y.

    Raises
    ------
    UsageError
        If a text is no expression over signals.
    """
    signals = signals_of(texts)
    inputs = tuple(Signal(f"u{i}", optional=optional) for i in range(1, len(signals) + 1))
    names = tuple(signal.name for signal in inputs)
    y = Signal("y", len(texts), unit, variability, optional=optional)
    programs = [_of_inputs(compile_over_signals(text), signals) for text in texts]
    jumps = variability != "discrete" and any(map(jumps_with_signals, texts))
    interface = Interface(inputs, (y,), {"y": names}, jumping=("y",) if jumps else ())
    return CompiledStatic(interface, expression_step(programs))


def _of_inputs(program: Program, signals: Sequence[str]) -> Program:
    """Return a program over the inputs, which stand for signals in their order."""
    return program.with_columns([signals.index(name) for name in program.signals])
