"""Swapped components beside those that they replace, port by port and as a whole."""
