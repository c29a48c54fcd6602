"""FMI in both directions: an FMU as a component, a model of ours as an FMU.

fmpy is imported in here only, and only when an FMU is opened or written.
"""
