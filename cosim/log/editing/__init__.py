"""Logs from parts of logs: cut in time, merged, or recovered from a damaged file.

The result is a log like any other. Where it has not all rows of the run its status is ``partial``,
with the reason, and the result of the whole run, as far as it is known, stands in the metadata
record ``cosim.partial``: parts that are merged to all rows again are the log of the run again.
"""
