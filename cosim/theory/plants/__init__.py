"""Descriptor plants: what they are given by, their coordinates, their reduction."""
