"""Experiments of a scenario compared by the error of theta that they are to have."""
