"""The step gain of loops: how much the coupling of one multiplies an error, before the run."""
