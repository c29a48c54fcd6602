"""Show scenarios, runs and comparisons: tables, summaries, inspection, pictures."""
