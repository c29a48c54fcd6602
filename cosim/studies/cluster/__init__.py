"""The members of a study on a cluster: tasks of dask.distributed, and nothing beside it.

A worker of dask is checked first and gets the files that it lacks. A task is a part of the dataset,
or some members of one, in plain values. Its members run in a guarded child process of the worker.
"""
