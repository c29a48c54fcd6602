"""Instances of FMUs linearized at an operating point."""
