"""Many runs of one scenario: designs of experiments, guarded workers, results as columns.

::

    contracts                            members of a study, and what they come to
    study_file, variations               the study as users write it: file, options, what is varied
    cases, design, checking, plan        which members there are, and whether they can be built
    metrics, measuring                   what is kept of a run: expressions over its signals
    members                              run_member: the one way a member is run
    worker, workers, cluster             where members run: child processes, workers of dask
    storage, identity, dataset           outcomes as Parquet, in folders and buckets; whose they are
    studying, kept_logs, verifying       a whole study, its logs, its members run again
    study                                a dataset as it is read
    layout, statistics, sensitivity      what members come to together
    search, standard_errors, residual    searches whose trials are members, and how sure they are
    tuning, tuning_result                ``cosim.tune``
    sweeping                             ``cosim.replay_sweep``: replays of one log, in a grid
    show, panels, plots                  tables, JSON, pictures
"""
