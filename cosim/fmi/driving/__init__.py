"""Units driven over communication steps: initialisation, model exchange with solvers and events, co-simulation."""
