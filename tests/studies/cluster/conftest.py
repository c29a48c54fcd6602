"""Modules of slow tests that import parts of the package which need the extra ``dask``."""

from importlib.util import find_spec

NEED_DASK = ["test_cluster_workers.py", "test_real_studies.py"]

collect_ignore = [] if find_spec("distributed") else NEED_DASK
