"""The text of a scenario: its tables, where their keys stand, and what is changed from outside."""
