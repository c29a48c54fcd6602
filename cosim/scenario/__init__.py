"""Scenarios: one TOML file that names components, connections and a clock."""
