"""Print the SHA-256 of each component's topic of logs, as Rerun reads and decodes them, in Rust.

Called with the folder of the readers, a folder for files and the logs; prints a line of JSON for
each log.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np


def main(readers: Path, folder: Path, paths: list[str]) -> None:
    """Convert the logs to Rerun's format and print the hashes of what stands there."""
    program = readers / "rerun_sdk" / "rerun_cli" / "rerun"
    for path in paths:
        target = folder / f"{Path(path).stem}.rrd"
        command = [program, "mcap", "convert", path, "-o", target, "--disable-raw-fallback"]
        subprocess.run(command, capture_output=True, check=True)
        print(json.dumps(topic_hashes(target)))


def topic_hashes(path: Path) -> dict[str, str]:
    """Return the hash of the times and rows of each topic."""
    from rerun.dataframe import load_recording

    recording = load_recording(path)
    hashes = {}
    for column in recording.schema().component_columns():
        if not column.component.startswith("cosim.") or not column.component.endswith(":message"):
            continue
        view = recording.view(index="log_time", contents=column.entity_path)
        table = view.select("log_time", column).read_all()
        rows = table.column(1).combine_chunks().flatten()
        values = np.column_stack([child.to_numpy() for child in rows.flatten()])
        values[np.isnan(values)] = np.nan
        hashed = np.empty((len(values), 1 + values.shape[1]))
        hashed.view(np.int64)[:, 0] = table.column(0).to_numpy().view(np.int64)
        hashed[:, 1:] = values
        hashes[column.entity_path] = hashlib.sha256(hashed.tobytes()).hexdigest()
    return hashes


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
