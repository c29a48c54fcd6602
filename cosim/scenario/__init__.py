"""Scenarios: one TOML file that names components, connections and a clock.

In the order in which a file passes through it::

    document/      the text: its tables and their schema, where its keys stand, edits and swaps
    kinds/         what components are made of: with data_files/, user_kinds/ of users, and
                   identification/, the model and the verdicts of identifiers
    parsing        the tables of the text, checked by themselves
    context/       what components are built with: models, files, other components
    actions/       what happens in a run, checked against the components, and where it ends
    building/      the graph and the clock, the gain of loops
    swapping/      swapped components beside those that they replace
    preparing      all of that, for a run
    recordings/    what is kept of a run, and what a replay takes from there
    certification/ runs with finer steps: the error of the coupling
    running/       runs at once, paced, or begun to be advanced by hand
    exporting      a component as an FMU
    identifying, assumptions/, experiment_design/
                   what is asked of a log or a scenario beside its run
    library/       the shipped scenarios

Below them all stand ``record``, the documents that a recording keeps beside
its signals and how they are read back, and ``session``, what advances a scenario by hand. A
room imports only those above it in this list (``tests/test_architecture.py``).
"""
