"""Designs: which members a study has, by number."""
