"""Keep the results of trials of FMUs in the user's cache folder, by the content of the file.

One small JSON file a result. It holds its key too: a file that is damaged, or another's, is as good
as none.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from cosim.files import read_bounded
from cosim.fmi.cache import TRIALS, cache_folder, keep
from cosim.fmi.platforms import ARCHITECTURE, SYSTEM
from cosim.version import __version__

TRIAL_VERSION: Final = 2  # to be raised where the trials themselves change
LARGEST: Final = 2**16  # bytes of one file


@dataclass(frozen=True, slots=True)
class KeptTrial:
    """What is kept of a trial.

    Parameters
    ----------
    task : str
        The trial.
    sha256 : str
        Of the FMU.
    interface_type : {"me", "cs"}
    """

    task: str
    sha256: str
    interface_type: str

    def problems(self) -> tuple[str, ...] | None:
        """Return the problems that it found; None: they are not known."""
        key = self._key
        file = _file(key)
        if file is None:
            return None
        try:
            content = json.loads(read_bounded(file, LARGEST))
        except (OSError, ValueError, RecursionError):
            return None
        if not isinstance(content, dict) or content.get("key") != key:
            return None
        problems = content.get("problems")
        if not isinstance(problems, list) or not all(isinstance(text, str) for text in problems):
            return None
        return tuple(problems)

    def keep(self, problems: Sequence[str]) -> None:
        """Keep the problems that it found, if there is a folder for them."""
        file = _file(self._key)
        content = json.dumps({"key": self._key, "problems": list(problems)}).encode()
        if file is not None and len(content) <= LARGEST:
            keep(file, content)

    @property
    def _key(self) -> dict[str, str]:
        return {
            **asdict(self),
            "platform": f"{ARCHITECTURE}-{SYSTEM}",
            "version": f"{__version__}, trial {TRIAL_VERSION}",
        }


def _file(key: Mapping[str, str]) -> Path | None:
    folder = cache_folder()
    if folder is None:
        return None
    text = json.dumps(key, sort_keys=True)
    return folder / TRIALS / f"{hashlib.sha256(text.encode()).hexdigest()}.json"
