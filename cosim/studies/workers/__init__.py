"""Members of a study in child processes: one that crashes or hangs costs itself only."""
