"""What a run leaves in its recording, and what a replay takes from it."""
