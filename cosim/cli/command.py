"""Commands made of tables of options, and how the values of options are read.

A table has an entry for each option and argument, in the order of the help. Its key is written as
in a help text, followed by what the option takes and, where it has one, its default; its value is
the help::

    "--json"                            a flag
    "--out -o PATH : Path"              an option, None where it is not given
    "--worst : int = 3"                 with a default
    "--component NAME : str = ..."      an option that must be given
    "log LOG : Path"                    an argument, with its name before its metavar
    "signals [SIGNAL]... : list[str] = None"    an argument that may be omitted

What an option takes is a key of ``KINDS``, which knows how its text is read and completed; ``~`` in
a path is the home folder, which a shell leaves in ``--out=~/run.mcap``.
"""

from __future__ import annotations

import gc
import re
from ast import literal_eval
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from decimal import Decimal, InvalidOperation
from functools import wraps
from inspect import Parameter, Signature
from keyword import iskeyword
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, TypeAlias, get_origin

import typer
from typer.core import TyperCommand, TyperOption

from cosim import completion
from cosim.errors import UsageError, nearest, option, quoted
from cosim.files import expanded
from cosim.options import Rule, check_rules

if TYPE_CHECKING:
    from cosim.report.tables.console import Shown

OptionTable: TypeAlias = Mapping[str, str]

_TUBE: Final = re.compile(r"([\d.]+(?:e[+-]?\d+)?) ?s(?:, ?([\d.]+(?:e[+-]?\d+)?) ?%)?", re.I)


# --- values ---


def read_pairs(texts: list[str], name: str) -> list[tuple[str, str]]:
    """Read the pairs KEY=VALUE of an option."""
    expected = {"set": "COMPONENT.PARAMETER=VALUE", "swap": "COMPONENT=PATH", "map": "PORT=NAME"}
    pairs = []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            missing = "no name" if equals else "no '='"
            form = expected.get(name, "NAME=VALUE")
            raise UsageError(f"{option(name)} {quoted(text)}: expected {form}, got {missing}")
        pairs.append((key.strip(), value.strip()))
    return pairs


def read_unique_pairs(texts: list[str], name: str) -> dict[str, str]:
    """Read pairs of which each key may be given once."""
    pairs = read_pairs(texts, name)
    keys = [key for key, _ in pairs]
    for key in keys:
        count = keys.count(key)
        if count > 1:
            remedy = "; 'cosim compare' runs several plants" if name == "swap" else ""
            raise UsageError(f"{option(name, key)}: expected once, given {count} times{remedy}")
    return dict(pairs)


def read_alternatives(texts: list[str], name: str) -> dict[str, list[str]]:
    """Read pairs of which a key may be given several times, each an alternative."""
    alternatives: dict[str, list[str]] = {}
    for key, value in read_pairs(texts, name):
        alternatives.setdefault(key, []).append(value)
    return alternatives


def _each(pairs: Mapping[str, str], name: str, read: Callable[[str], Any]) -> dict[str, Any]:
    """Read the values of pairs; an error names the key."""
    values = {}
    for key, text in pairs.items():
        try:
            values[key] = read(text)
        except UsageError as error:
            raise UsageError(f"{option(name, key)}: {error}") from error
    return values


def read_numbers(texts: list[str], name: str) -> dict[str, float] | None:
    """Read pairs of a signal and a number, each signal once; None: there are none."""
    return _each(read_unique_pairs(texts, name), name, _number) or None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(f"expected a number, got {quoted(text)}") from error


def read_edits(texts: list[str], name: str = "set") -> dict[str, Any]:
    """Read pairs whose values are TOML where they can be; the last one of a key counts."""
    from cosim.scenario.document.document import parse_value

    return _each(dict(read_pairs(texts, name)), name, parse_value)


def read_variations(texts: list[str], name: str) -> dict[str, Any]:
    """Read values, grids, distributions and plants, by key."""
    from cosim.studies.variations import read_vary_option

    return _each(read_unique_pairs(texts, name), name, read_vary_option)


def read_ranges(texts: list[str], name: str) -> dict[str, Any]:
    """Read KEY=LOWER:UPPER, KEY=log:LOWER:UPPER, KEY=V1,V2,... of a tuning."""
    return _each(read_unique_pairs(texts, name), name, _range)


def _range(text: str) -> Any:
    from cosim.studies.variations import read_vary_option

    parts = [part.strip() for part in text.split(":")]
    form = parts.pop(0) if parts[0] in ("log", "linear") else "linear"
    try:
        lower, upper = (float(part) for part in parts)
    except ValueError:
        values = read_vary_option(text)
        if isinstance(values, list) and len(values) > 1:
            return values
        forms = "LOWER:UPPER, log:LOWER:UPPER or comma-separated values"
        raise UsageError(f"expected {forms}, got {quoted(text)}") from None
    return {form: [lower, upper]}


def read_failures(texts: list[str], name: str) -> frozenset[str]:
    """Read what a command fails on: some of ``completion.FAILURES``."""
    found = {part.strip() for text in texts for part in text.split(",")}
    for unknown in sorted(found.difference(completion.FAILURES)):
        remedy = nearest(unknown, completion.FAILURES)
        raise UsageError(f"{option(name)}: nothing is called {quoted(unknown)}; {remedy}")
    return frozenset(found)


def read_seconds(text: str, name: str) -> Decimal:
    """Read a time with all its digits: a double has not those of nanoseconds since 1970."""
    try:
        float(text)  # a Decimal may be more than that, such as sNaN
        return Decimal(text)
    except (ValueError, InvalidOperation) as error:
        found = f"expected a number of seconds, got {quoted(text)}"
        raise UsageError(f"{option(name.rstrip('_'))}: {found}") from error


def read_step(text: str, name: str) -> float | str:
    """Read a step as it would be in a file: a fraction is a text there."""
    try:
        return float(text)
    except ValueError:
        return text


def read_members(text: str, name: str) -> Any:
    """Read which logs are kept: numbers, or a text."""
    from cosim.scenario.document.document import parse_value

    numbers = parse_value(f"[{text}]")
    return numbers if isinstance(numbers, list) else text


def read_deviations(text: str, name: str) -> list[float]:
    """Read a number or a list of numbers."""
    from cosim.scenario.document.document import parse_value

    value = parse_value(text)
    listed = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool) or not isinstance(item, int | float) for item in listed):
        raise UsageError(f"{option(name)}: expected a number, or a list of numbers, got {text}")
    return [float(item) for item in listed]


def read_tube(text: str, name: str) -> tuple[float, float]:
    """Return how wide a tube is [s], and the tolerance in it as a part of the largest value."""
    match = _TUBE.fullmatch(text.strip())
    try:
        return float(match[1]), float(match[2] or 0.0) / 100.0  # type: ignore[index]
    except (TypeError, ValueError) as error:
        expected = "a time, and a tolerance in percent of the largest |a|: 0.02s or 0.02s,0.5%"
        raise UsageError(f"{option(name)}: expected {expected}, got {text!r}") from error


def read_size(text: str, name: str) -> tuple[float, float]:
    """Read the size of a picture [cm]."""
    width, _, height = text.partition("x")
    try:
        return float(width), float(height)
    except ValueError as error:
        found = f"expected WIDTHxHEIGHT in cm, such as 16x9, got {text!r}"
        raise UsageError(f"{option(name)}: {found}") from error


# --- options ---


class OptionKind(NamedTuple):
    """What an option takes: its type for typer, what reads and what completes a value.

    The values of an option that is repeatable are read together, also where there are none.
    """

    type: Any
    read: Callable[[Any, str], Any] | None = None
    complete: Callable[..., list[str]] | None = None


KINDS: Final = {
    "": OptionKind(bool),
    "bool": OptionKind(bool),
    "float": OptionKind(float),
    "int": OptionKind(int),
    "str": OptionKind(str),
    "Path": OptionKind(Path, lambda path, _: expanded(path)),
    "list[int]": OptionKind(list[int]),
    "list[str]": OptionKind(list[str]),
    "list[Path]": OptionKind(list[Path], lambda paths, _: list(map(expanded, paths))),
    "component": OptionKind(str, complete=completion.complete_component),
    "kind": OptionKind(str, complete=completion.complete_kind),
    "scenario": OptionKind(str, complete=completion.complete_scenario),
    "source": OptionKind(str, complete=completion.complete_source),
    "checked": OptionKind(Path, lambda path, _: expanded(path), completion.complete_checked),
    "estimators": OptionKind(list[str], complete=completion.complete_estimators),
    "alternatives": OptionKind(list[str], read_alternatives, completion.complete_swap),
    "deviations": OptionKind(str, read_deviations),
    "edits": OptionKind(list[str], read_edits, completion.complete_setting),
    "failures": OptionKind(list[str], read_failures, completion.complete_failures),
    "maps": OptionKind(list[str], read_unique_pairs, completion.complete_map),
    "members": OptionKind(str, read_members),
    "numbers": OptionKind(list[str], read_numbers),
    "pairs": OptionKind(list[str], read_unique_pairs),
    "ranges": OptionKind(list[str], read_ranges),
    "seconds": OptionKind(str, read_seconds),
    "size": OptionKind(str, read_size),
    "step": OptionKind(str, read_step),
    "tube": OptionKind(str, read_tube),
    "swaps": OptionKind(list[str], read_unique_pairs, completion.complete_swap),
    "values": OptionKind(list[str], read_edits),
    "variations": OptionKind(list[str], read_variations, completion.complete_setting),
}


def _parameter(key: str, text: str) -> tuple[Parameter, OptionKind]:
    """Return the parameter of an entry of a table, and its kind."""
    spelled, _, taken = key.partition(" : ")
    kind_name, _, default = taken.partition(" = ")
    kind = KINDS[kind_name]
    flags = [word for word in spelled.split() if word.startswith("-")]
    shown: Any
    if flags:
        metavar = spelled.removeprefix(" ".join(flags)).strip() or None
        name = max(flags, key=len).partition("/")[0].lstrip("-").replace("-", "_")
        shown = typer.Option(*flags, metavar=metavar, help=text, autocompletion=kind.complete)
        value: Any = None if kind_name else False
    else:
        name, _, metavar = spelled.partition(" ")
        shown = typer.Argument(metavar=metavar, help=text, autocompletion=kind.complete)
        value = ...
    if default:
        value = literal_eval(default)
    parameter = Parameter(
        f"{name}_" if iskeyword(name) else name,
        Parameter.KEYWORD_ONLY,
        default=Parameter.empty if value is ... else value,
        annotation=Annotated[kind.type | None if value is None else kind.type, shown],
    )
    return parameter, kind


class Given(SimpleNamespace):
    """The values of a command's options by name, those of Python's keywords as ``from_``."""

    def only(self, names: str) -> dict[str, Any]:
        """Return some of them, to be handed on."""
        return {name: getattr(self, name) for name in names.split()}

    def print_shown(self, shown: Shown) -> None:
        """Print what ``--json`` asks for, or the lines and tables behind it."""
        from cosim.report.tables.console import print_shown

        print_shown(shown, as_json=self.json)


CommandBody: TypeAlias = Callable[[Given], bool | None]


def command(table: OptionTable, *rules: Rule) -> Callable[[CommandBody], Callable[..., None]]:
    """Make a command of a function and a table of options.

    The function is called with the values of the options, read as their kinds say. Those of --stop
    and --step, and what --no-verdicts sets, are in those of --set; ``arguments`` are those of the
    command line. Where it returns True, the exit code is 1.

    Parameters
    ----------
    table : mapping of str to str
        As the module describes it.
    *rules : Rule
        Which options exclude or need each other.
    """
    entries = [_parameter(key, text) for key, text in table.items()]

    def make(function: CommandBody) -> Callable[..., None]:
        @wraps(function)
        def called(context: typer.Context, **values: Any) -> None:
            check_rules(rules, values)
            for entry, kind in entries:
                value = values[entry.name]
                if value is None and get_origin(kind.type) is list:
                    value = []
                if kind.read is not None and value is not None:
                    values[entry.name] = kind.read(value, entry.name)
            given = Given(**values, arguments=[str(context.info_name), *context.obj])
            with ExitStack() as resources:
                if "set" in values:
                    from cosim.arguments import setting_arguments

                    own = {name: values.get(name) for name in ("stop", "step")}
                    own["verdicts"] = False if values.get("no_verdicts") else None
                    given.set = resources.enter_context(setting_arguments(given.set, **own))
                failed = function(given)
            if failed:
                raise typer.Exit(1)

        context = Parameter("context", Parameter.KEYWORD_ONLY, annotation=typer.Context)
        parameters = [context, *(entry for entry, _ in entries)]
        called.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {entry.name: entry.annotation for entry in parameters}
        return called

    return make


class OnceCommand(TyperCommand):
    """A command whose options are given once, unless they are repeatable: the last is no choice."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, and keep them as they are in ``obj`` of the context.

        Raises
        ------
        UsageError
            If an option that has one value is given several times.
        """
        ctx.obj = list(args)
        if ctx.resilient_parsing:  # for completion
            return super().parse_args(ctx, args)
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for parameter in given:
            if not isinstance(parameter, TyperOption) or parameter.multiple or parameter.is_flag:
                continue
            count = given.count(parameter)
            if count > 1:
                name = max(parameter.opts, key=len)
                raise UsageError(f"{name}: expected once, given {count} times")
        return super().parse_args(ctx, args)


def start_collecting() -> None:
    """Start the garbage collector if it is off; what there is by then is never walked over.

    What imports make stays, so that walking over it is in vain, and takes a tenth of a short run.
    The process begins without the collector (:mod:`cosim.__main__`), and a command starts it when
    it has imported what it needs.
    """
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
