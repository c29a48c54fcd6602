"""Modules that import parts of the package which need the extra ``dask``: for the slow tests alone."""

from importlib.util import find_spec

collect_ignore = (
    [] if find_spec("distributed") else ["test_cluster_workers.py", "test_real_studies.py"]
)
