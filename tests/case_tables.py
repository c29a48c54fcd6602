"""Tables of cases in one test: bad inputs, seeds, radii, whatever needs no line of its own."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any

import pytest


def each_case(
    names: str | tuple[str, ...], cases: Iterable[Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for every row of a table, as one test that reports every row that fails.

    Parameters
    ----------
    names : str or tuple of str
        The arguments of the test that a row has; all others are fixtures, shared by the rows.
    cases : iterable
        A value a row where there is one name, else a tuple of as many.
    """
    columns = (names,) if isinstance(names, str) else names
    rows = [(row,) if isinstance(names, str) else tuple(row) for row in cases]
    assert rows, "a table without rows tests nothing"
    assert all(len(row) == len(columns) for row in rows)

    def of_table(test: Callable[..., None]) -> Callable[..., None]:
        @wraps(test)
        def run_all(**fixtures: Any) -> None:
            failures: list[Exception] = []
            for row in rows:
                try:
                    test(**fixtures, **dict(zip(columns, row, strict=True)))
                except (Exception, pytest.fail.Exception) as error:
                    failure = AssertionError(f"{row}: {error}")
                    failures.append(failure.with_traceback(error.__traceback__))
            if failures:
                raise ExceptionGroup(f"{len(failures)} of {len(rows)} cases fail", failures)

        signature = inspect.signature(test)
        fixtures = [one for name, one in signature.parameters.items() if name not in columns]
        run_all.__signature__ = signature.replace(parameters=fixtures)  # type: ignore[attr-defined]
        return run_all

    return of_table
