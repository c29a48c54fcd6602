"""Estimators: regression, Kalman filters, output error."""
