"""Logs as files of other formats; one module for each family of them.

Tables (CSV, JSON Lines, Parquet) join the signals on time, as
:mod:`cosim.core.recorded.joined_rows` says. Files of arrays (NumPy's npz, MATLAB's MAT) have every
signal with the instants of its component.
"""
