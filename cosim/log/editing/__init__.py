"""Logs from parts of logs: cut in time, merged, or recovered from a damaged file.

The result is a log like any other. If it lacks rows of the run, its status is ``partial``, with
the reason, and the result of the whole run, as far as it is known, is the metadata record
``cosim.partial``: parts that are merged to all rows are the log of the run again.
"""
