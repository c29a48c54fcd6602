"""What the data say of an estimate: errors that are no noise, tests, verdicts."""
