"""Logs written: rows and messages of a run, in a thread beside it."""
