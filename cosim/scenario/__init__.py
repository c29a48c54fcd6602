"""Scenarios: one TOML file that names components, connections and a clock.

In the order in which a file passes through it::

    document, lines, places    the text, and where its keys stand
    edits, swap                what is changed in it from outside
    parsing, schema            its tables, checked by themselves
    kinds/, models             what components are made of
    build, context             the graph and the clock
      acting, settings,        its actions, checked against the components; the condition that
      timed_swaps, stopping    ends it
      coupling_check           the gain of its loops, before the run
    execution, recording       a run into a log, or again from one (replaying)
    starting, session          the same, advanced by hand
    certification/             runs with finer steps: the error of the coupling
    assumptions/, identification/, experiment_design/
                               what is asked of a scenario or a log beside its run
"""
