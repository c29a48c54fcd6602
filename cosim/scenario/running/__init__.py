"""Runs of a scenario: at once, at the pace of the wall clock, or advanced by hand."""
