"""Run members of a study again, each alone, and compare bit for bit."""
