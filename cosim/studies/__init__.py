"""Many runs of one scenario: designs of experiments, guarded workers, results as columns."""
