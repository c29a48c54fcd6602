"""What is wrong with an FMU: every problem at once, foreign binaries in child processes."""
