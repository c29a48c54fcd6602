"""Commands whose options are given once, unless they are repeatable: the last one is no choice.

``~`` in their paths is the home folder: a shell leaves it in ``--out=~/run.mcap``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperOption

from cosim.errors import UsageError
from cosim.files import expanded


class OnceCommand(TyperCommand):
    """A command that refuses an option with a value that is given twice."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments.

        Raises
        ------
        UsageError
            If an option that has one value is given several times.
        """
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
        left = super().parse_args(ctx, args)
        for name, value in ctx.params.items():
            ctx.params[name] = _expanded(value)
        return left


def _expanded(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_expanded, value))
    return expanded(value) if isinstance(value, Path) else value
