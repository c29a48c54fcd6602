"""Commands whose options are given once, unless they are repeatable: the last one is no choice."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperOption

from cosim.errors import UsageError


class OnceCommand(TyperCommand):
    """A command that refuses an option with a value that is given twice."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments.

        Raises
        ------
        UsageError
            If an option that has one value is given several times.
        """
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for parameter in given:
            count = given.count(parameter)
            if isinstance(parameter, TyperOption) and not (parameter.multiple or parameter.is_flag):
                name = max(parameter.opts, key=len)
                if count > 1:
                    raise UsageError(f"{name}: given {count} times, needed once")
        return super().parse_args(ctx, args)
