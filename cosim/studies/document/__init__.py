"""The text of a study: its tables and their schema, what is varied, and options beside it."""
