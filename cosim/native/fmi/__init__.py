"""Loaded FMUs, called by address: their steps, and what they call back."""
