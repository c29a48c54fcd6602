"""The condition that ends a run: ``[scenario] until``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from cosim.core.conditions import Condition
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.stages.looking_ahead import bound_to_steps
from cosim.core.structure.ports import layout_of
from cosim.errors import CosimError, UsageError
from cosim.instants import StepNs
from cosim.native.numerics.expression import compile_condition
from cosim.scenario.document.places import Problem

UNTIL = ("scenario", "until")


def check_until(
    text: str | None, components: Mapping[str, Component], unknown: Collection[str], step_ns: StepNs
) -> Iterator[Problem]:
    """Yield the problem of the condition that ends a run, if it has one.

    Parameters
    ----------
    text : str or None
        None: there is none.
    components : mapping of component name to Component
    unknown : collection of str
        Components whose signals are not known.
    step_ns : int
        Communication step [ns].
    """
    problem = None if text is None else condition_problem(text, components, unknown, step_ns)
    if problem is not None:
        yield UNTIL, problem


def condition_problem(
    text: str, components: Mapping[str, Component], unknown: Collection[str], step_ns: StepNs
) -> str | None:
    """Return what is wrong with a condition; parameters as of :func:`check_until`."""
    try:
        names = compile_condition(text).program.signals
        if not any(_component_of(name) in unknown for name in names):
            Condition(text, layout_of(dict(components)), step_ns)
    except UsageError as error:
        return str(error)
    return None


def _component_of(name: str) -> str:
    """Return the component of a signal; the name itself where it has none."""
    try:
        return Port.parse(name).component
    except CosimError:
        return name


def until_warnings(keys: Collection[str], graph: Graph) -> Iterator[tuple[str, str]]:
    """Yield (component, text) where conditions cost time; ``keys``: of these, 'until', 'when'."""
    if not keys:
        return
    what = " or ".join(map(repr, keys))
    for name in bound_to_steps(graph):
        yield (
            name,
            f"cannot go back from behind the row where {what} comes true, so that the run advances "
            "by single steps, which takes longer",
        )
