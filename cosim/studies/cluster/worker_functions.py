"""What the workers of dask are asked for: what they are, to take files, to run members of a study.

These functions go to the workers by name, and their arguments are plain values. All that takes time
is done in threads: a worker whose event loop does not answer counts as dead.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from distributed import Worker, get_worker

from cosim.studies.cluster.cluster_study import ClusterStudy
from cosim.studies.cluster.environment import describe_environment
from cosim.studies.cluster.file_copies import missing_content, store_content
from cosim.studies.cluster.storing import reaches_dataset
from cosim.studies.cluster.study_plugin import StudyPlugin
from cosim.studies.contracts import FAILED, MemberOutcome
from cosim.studies.workers.messages import decode_member

WORKER_KEY: Final = "worker"


async def describe_scheduler() -> dict[str, str]:
    """Return what a scheduler computes with."""
    return await asyncio.to_thread(describe_environment)


async def describe_worker(files: Mapping[str, str], *, dask_worker: Worker) -> dict[str, Any]:
    """Return what a worker computes with, and what it has to be sent.

    Parameters
    ----------
    files : mapping of absolute path to SHA-256
    dask_worker : Worker

    Returns
    -------
    dict
        ``environment``, as of :func:`describe_environment`; ``missing``: hashes of files.
    """
    folder = Path(dask_worker.local_directory)
    return {
        "environment": await asyncio.to_thread(describe_environment),
        "missing": await asyncio.to_thread(missing_content, folder, files),
    }


async def store_file(key: str, *, dask_worker: Worker) -> None:
    """Keep the content of a file that is among the data of the worker."""
    folder = Path(dask_worker.local_directory)
    await asyncio.to_thread(store_content, folder, dask_worker.data[key])


async def open_study(content: Mapping[str, Any], *, dask_worker: Worker) -> dict[str, Any]:
    """Open a study on a worker, and build the member that is tried.

    Parameters
    ----------
    content : mapping
        Of :meth:`ClusterStudy.to_dict`.
    dask_worker : Worker

    Returns
    -------
    dict
        ``problem``: why that cannot be, or empty; ``writes``: whether it writes the dataset.
    """
    study = ClusterStudy.from_dict(content)
    plugin = StudyPlugin(study)
    await dask_worker.plugin_add(plugin=plugin, name=study.name, catch_errors=False)
    return {"problem": await plugin.try_member(), "writes": plugin.writes}


async def close_study(name: str, *, dask_worker: Worker) -> None:
    """End the children of a study, and remove its copies."""
    if name in dask_worker.plugins:
        await dask_worker.plugin_remove(name=name)


async def reaches(logs: str) -> bool:
    """Return whether a worker reaches the dataset where logs are kept."""
    return await asyncio.to_thread(reaches_dataset, logs)


def run_members(name: str, lines: bytes, first: int | None) -> dict[str, Any]:
    """Run members of a study; the task.

    Parameters
    ----------
    name : str
    lines : bytes
        The members, a line each, as a pool writes them to its workers; compressed.
    first : int or None
        They are the part of the dataset that begins here, to be written if this worker can.

    Returns
    -------
    dict
        ``worker``; ``count``, ``seconds`` and ``failed`` of its members; ``outcomes``, or None:
        they are written. ``is_open`` is False where the study is not open here: a worker that was
        started again under its address.
    """
    worker = get_worker()
    plugin = worker.plugins.get(name)
    if plugin is None:
        return {WORKER_KEY: worker.address, "is_open": False}
    assert isinstance(plugin, StudyPlugin)
    planned = [decode_member(line) for line in zlib.decompress(lines).splitlines()]
    outcomes = plugin.run(planned)
    answer = {
        WORKER_KEY: worker.address,
        "is_open": True,
        "count": len(outcomes),
        "seconds": sum(outcome.wall_time for outcome in outcomes),
        "failed": sum(outcome.status == FAILED for outcome in outcomes),
        "outcomes": None,
    }
    if first is not None and plugin.writes:
        plugin.write(first, planned, outcomes)
    else:
        answer["outcomes"] = [plain_outcome(outcome) for outcome in outcomes]
    return answer


def plain_outcome(outcome: MemberOutcome) -> tuple[Any, ...]:
    """Return the values of an outcome in order."""
    return (
        outcome.number,
        outcome.status,
        outcome.reason,
        outcome.steps,
        dict(outcome.metrics),
        outcome.wall_time,
        outcome.designs,
        outcome.worker,
        list(outcome.warnings),
        dict(outcome.details),
    )
