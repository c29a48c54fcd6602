"""Finished runs, in memory or from file: signals by name, windows, selections and tables."""
