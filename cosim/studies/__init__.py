"""Many runs of one scenario: designs of experiments, guarded workers, results as columns.

::

    contracts   what the parts hand to each other: members, their outcomes, what runs them
    metrics     what is kept of a run: expressions over its signals
    document    the study as users write it: file, options, variations
    dataset     outcomes as Parquet, in folders and buckets
    workers     child processes that run members; a crash affects only its member
    members     one member after the other in one process
    design      which members there are, and whether they can be built
    cluster     members on the workers of dask.distributed
    analysis    statistics and sensitivity of what members came to
    running     a whole study: plan, run, keep logs
    tuning      searches whose trials are members
    verification  members that run again alone, with the same bits
    plots       pictures of a study
    tables      what the command line prints
"""
