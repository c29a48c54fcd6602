"""Intervals that hold for every irregular part of the disturbance within a bound."""
