"""Nothing computed changes.

Times and rows of every signal are compared with recorded hashes.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.scenario.exporting import export_component
from tests.scenario.renamed import MAP, PACKED, packed, renamed

RECORDED = Path(__file__).with_name("same_rows.json")
# run: name of a signal then -> its name now
RENAMED: dict[str, dict[str, str]] = {
    "other names": {
        "plant.force": "plant.u",
        "plant.push": "plant.delta",
        "plant.out1": "plant.y",
        "plant.s": "plant.x_a",
    },
    "packed": {"plant.force": "plant.u", "plant.push": "plant.delta", "plant.s": "plant.x_a"},
}
# run: signals that were part of others -> a signal with the same values that was there
ADDED = {"packed": {"plant.y": "observer.y"}}
SHORT = {"scenario.stop": 9.0}


def hashes(recording):
    """Return the hash of times and rows of every signal."""
    found = {}
    for name, channel in recording.channels.items():
        times = recording.time_ns(name).tobytes()
        for signal in channel.signals:
            rows = np.ascontiguousarray(recording[f"{name}.{signal.name}"]).tobytes()
            found[f"{name}.{signal.name}"] = hashlib.sha256(times + rows).hexdigest()
    return found


def runs(folder, foreign2, foreign3):
    """Yield the name of a run, and how it is made."""
    for name in ("academic", "academic-as-printed", "closed-loop"):
        yield name, lambda name=name: cosim.run(name)
    for version in "23":
        path = folder / f"fmi{version}.fmu"
        export_component("academic", "plant", path, fmi=version)
        for interface_type in ("me", "cs"):
            swap = {"plant": f"{path}#{interface_type}"}
            yield (
                f"academic, FMI {version} {interface_type}",
                lambda swap=swap: cosim.run("academic", set=SHORT, swap=swap),
            )
            yield (
                f"closed-loop, FMI {version} {interface_type}",
                lambda swap=swap: cosim.run("closed-loop", set=SHORT, swap=swap),
            )
    other = renamed(folder / "x.fmu")
    yield "other names", lambda: cosim.run("academic", set=SHORT, swap={"plant": other}, map=MAP)
    vector = packed(folder / "y.fmu")
    yield "packed", lambda: cosim.run("academic", set=SHORT, swap={"plant": vector}, map=PACKED)
    for interface_type in ("me", "cs"):
        swap = {"plant": f"{foreign3}#{interface_type}"}
        yield (
            f"pythonfmu3 {interface_type}",
            lambda swap=swap: cosim.run("academic", set=SHORT, swap=swap),
        )


@pytest.fixture(scope="module")
def found(tmp_path_factory, foreign2, foreign3):
    """Run everything once."""
    folder = tmp_path_factory.mktemp("same")
    return {name: hashes(run()) for name, run in runs(folder, foreign2, foreign3)}


def test_times_and_rows_have_the_bits_they_had(found):
    """Every recorded signal has the times and rows it had."""
    before = json.loads(RECORDED.read_text())
    assert before.keys() == found.keys()
    for run, signals in before.items():
        names = RENAMED.get(run, {})
        expected = {names.get(name, name): value for name, value in signals.items()}
        for added, same in ADDED.get(run, {}).items():
            expected[added] = signals[same]
        assert expected == found[run], run
