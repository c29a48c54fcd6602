"""Units linearised at an operating point."""
