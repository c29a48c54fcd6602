"""Columns of studies that were never run."""

import numpy as np

from cosim.studies.analysis.columns import MemberColumns


def columns_of(metrics, *, parameters=None, failed=(), numbers=None, reasons=None):
    """Return the columns of members with the metrics given; lists become objects."""
    arrays = {}
    for name, values in metrics.items():
        is_array = isinstance(values, np.ndarray)
        arrays[name] = values if is_array else np.array(values, object)
    count = len(next(iter(arrays.values())))
    members = np.arange(count) if numbers is None else np.array(numbers)
    lost = np.isin(members, list(failed))
    texts = ["crashed" if one else "" for one in lost] if reasons is None else reasons
    varied = {key: np.array(values) for key, values in (parameters or {}).items()}
    return MemberColumns(members, lost, texts, varied, arrays, [""] * count)
