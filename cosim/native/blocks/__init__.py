"""The steps of the components of :mod:`cosim.blocks`, without those of estimators."""
