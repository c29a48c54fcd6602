"""Units linearized at an operating point."""
