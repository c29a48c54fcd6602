"""The command line; :mod:`cosim.cli.app` has its rules, and one file each group of commands."""

from cosim.cli.app import main

__all__ = ["main"]
