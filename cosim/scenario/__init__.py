"""Scenarios: one TOML file that names components, connections and a clock.

Its rooms, each of which imports only those above it (``tests/test_architecture.py``)::

    document/      the text: its tables and their schema, where its keys stand, edits and swaps
    data_files/    tables of samples as the field writes them
    record         the documents that a recording keeps beside its signals, read back
    session        a scenario that is advanced by hand
    kinds/         the tables of components, and what these are built with
    building/      from tables to a graph and a clock; actions; the gain of loops
    recordings/    what is kept of a run, what a replay takes from there, reports of swaps
    running/       runs, replays, certificates, identification from logs
    exporting      a component as an FMU
    assumptions/, experiment_design/
                   what is asked of a scenario before its run
    library/       the shipped scenarios
"""
