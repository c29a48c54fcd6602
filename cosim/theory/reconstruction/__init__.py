"""Reconstruction of the disturbance: filters for (20), their noise, their choice."""
