"""A graph that is advanced by hand or by actions: faults, jumps, states, the rows of steps."""
