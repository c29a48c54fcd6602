"""What the outcomes of a tuning depend on: its scenario with all edits, and the files it names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.scenario.parsing import Scenario
from cosim.studies.dataset.identity import digest_of


def scenario_digests(scenario: Scenario, choices: Sequence[Any] = ()) -> dict[str, str]:
    """Return the SHA-256 of a scenario, and of every file that a text in its tables names.

    Parameters
    ----------
    scenario : Scenario
        Edits applied.
    choices : sequence
        Values beside those of the scenario, such as paths of swaps.
    """
    digests = {"the scenario": digest_of(json.loads(json.dumps(scenario.tree, default=str)))}
    for text in _texts([scenario.tree, list(choices)]):
        path = scenario.document.folder / text.partition("#")[0]
        try:
            if path.is_file():
                digests[f"file {path.name}"] = _sha256(path)
        except (OSError, ValueError):  # a text that is no path
            continue
    return digests


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in tables and lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from _texts(list(value.values()))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)
