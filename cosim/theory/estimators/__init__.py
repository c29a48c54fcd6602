"""Estimators of the parameters theta, one file a method."""
