"""From the tables of a scenario to its graph and clock, checked as a whole."""
