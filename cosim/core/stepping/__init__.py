"""A graph that is advanced by hand: jumps, states, the rows of steps."""
