"""The method: reduction, observer, disturbance class, regression and estimators as pure functions on frozen data."""
