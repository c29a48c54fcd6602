"""Scenarios: one TOML file that names components, connections and a clock; the only layer that knows all the others."""
