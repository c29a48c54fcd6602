"""Identification in runs and from their logs: the model, the data, the verdicts."""
