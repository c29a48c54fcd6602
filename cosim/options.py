"""Options that go together or not, in Python and in the shell: rules of which refusals are made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from cosim.errors import UsageError, flag, option


@dataclass(frozen=True)
class Rule:
    """What each of some options excludes, or needs one of, and why.

    Parameters
    ----------
    names : str
        Of the options, with blanks between.
    why : str
        Follows the name of one of them in a message.
    excludes, needs : str
        Names of others.
    """

    names: str
    why: str
    excludes: str = ""
    needs: str = ""


OF_A_LOG: Final = Rule("flush sync rotate embed", "applies to a log", needs="out")
STEP_IS_CHOSEN: Final = Rule("find_step", "chooses the step itself", excludes="step")
OF_A_RECORDER: Final = Rule(
    "recorder", "takes the run in place of a log", excludes="out embed notice"
)


def check_rules(rules: Iterable[Rule], given: Mapping[str, object]) -> None:
    """Check that options go together.

    Parameters
    ----------
    rules : iterable of Rule
    given : mapping of name to value
        None, False and an empty list are an option that was not given.

    Raises
    ------
    UsageError
        If one excludes others, or lacks what it needs; names all of them.
    """
    for rule in rules:
        for name in rule.names.split():
            if not _is_given(given[name]):
                continue
            reason = f"{_shown(name, given)} {rule.why}"
            others = [other for other in rule.excludes.split() if _is_given(given[other])]
            if others:
                found = " and ".join(_shown(other, given) for other in others)
                raise UsageError(f"{reason}; omit it or {found}")
            needed = rule.needs.split()
            if needed and not any(_is_given(given[other]) for other in needed):
                available = " or ".join(_shown(other, given) for other in needed)
                raise UsageError(f"{reason}; expected {available}, too")


def _is_given(value: object) -> bool:
    is_empty = isinstance(value, list) and not value
    return value is not None and value is not False and not is_empty


def _shown(name: str, given: Mapping[str, object]) -> str:
    """Name an option in the language of the reader; Python's keywords end with an underscore."""
    plain = name.rstrip("_")
    return flag(plain) if isinstance(given[name], bool) else option(plain)
