"""The method as pure functions on frozen data.

Reduction, observer, disturbance class, regression, estimators.
"""
