"""Units driven over communication steps: initialization, model exchange with solvers and events, co-simulation."""
