"""FMUs driven over communication steps: initialization, model exchange, co-simulation."""
