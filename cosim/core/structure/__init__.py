"""What a graph is checked and ordered by, before it runs."""
