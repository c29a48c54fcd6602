"""Metrics: what is kept of a run that is not recorded, such as ``rms(observer.delta - delta.y)``.

::

    kinds        the reductions that there are, and what each makes of the values of a run
    language     the text of a metric: arithmetic of reductions
    metrics      the metrics of a study, checked against signals, and of a recorded run
    recorded     those of a log, for users
    recorder     the same of a run while it advances, without keeping its rows
"""
