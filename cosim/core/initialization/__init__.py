"""The initial values of all components together."""
