"""The version of the package, for logs, wheels and people."""

__version__ = "0.4.0"
