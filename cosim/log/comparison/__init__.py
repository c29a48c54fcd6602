"""Two recorded runs compared."""
