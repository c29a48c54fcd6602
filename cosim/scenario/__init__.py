"""Scenarios: one TOML file that names components, connections and a clock.

In the order in which a file passes through it::

    document/      the text: its tables and their schema, where its keys stand, edits and swaps
    parsing        its tables, checked by themselves
    kinds/         what components are made of: with data_files/, and user_kinds/ of users
    building/      the graph and the clock, models, the condition that ends a run, the gain of loops
    actions/       what happens in a run, checked against the components
    swapping/      swapped components beside those that they replace
    running/       runs at once, paced, or advanced by hand
    recordings/    what is kept of a run, and what a replay takes from there
    exporting      a component as an FMU
    certification/ runs with finer steps: the error of the coupling
    assumptions/, identification/, experiment_design/
                   what is asked of a scenario or a log beside its run
    library/       the shipped scenarios
"""
