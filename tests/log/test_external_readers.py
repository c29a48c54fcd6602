"""Readers of MCAP in other languages decode logs to the same values, also what a kill left.

They are looked for in the folder that ``COSIM_READERS`` names, where ``.ci/run`` installs them.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import subprocess
import sys
from collections import defaultdict
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.log import open_log
from cosim.log.metadata import hash_input
from cosim.scenario.document.document import shipped
from tests.log.decoding import message_class
from tests.log.killed import Job, killed_run, whole_run
from tests.log.recordings import STEP_NS, same_bits

pytestmark = pytest.mark.external
READERS = Path(os.environ.get("COSIM_READERS", "not-given"))
MODULES = READERS / "node_modules"
GO = READERS / "databeam_mcap_reader" / "mcap_cli"
RUST = READERS / "rerun_sdk"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Write the log of every shipped scenario, and leave one by a kill."""
    folder = tmp_path_factory.mktemp("logs")
    paths = []
    for name in shipped():
        path = folder / f"{name}.mcap"
        cosim.run(cosim.load(name).set({"scenario.stop": 2.0}), out=path)
        paths.append(path)
    job = Job(folder / "killed.mcap", 1, flushes=8, cut=(60, 0.5))
    reported, _ = killed_run(job)
    assert reported
    assert open_log(job.path).status == "unfinished"
    return [*paths, job.path]


def components(path):
    """Yield the components of a log with topic, times and rows, NaNs of one kind."""
    log = open_log(path)
    for name in log.channels:
        rows = log.rows(name).copy()
        rows[np.isnan(rows)] = np.nan
        yield f"/{name}", log.time_ns(name), rows


def needs(file):
    """Skip a test of a reader that is not installed."""
    if not file.exists():
        pytest.skip(f"{file} is not installed; set COSIM_READERS to the folder of the readers")


def test_stock_reader_decodes_the_same_values(logs):
    """That of Python, by protobuf's own decoder."""
    for path in logs:
        with path.open("rb") as stream:
            found = decoded(make_reader(stream, validate_crcs=True).iter_messages())
        for topic, time_ns, rows in components(path):
            times, values = found[topic]
            assert times == time_ns.tolist()
            assert same_bits(np.array(values), rows)


def decoded(messages):
    """Return times and rows of each topic."""
    found = defaultdict(lambda: ([], []))
    classes = {}
    for schema, channel, message in messages:
        if channel.topic.startswith("/cosim/"):
            continue
        if schema.name not in classes:
            classes[schema.name] = message_class(schema.name, schema.data)
        kind = classes[schema.name]
        values = kind.FromString(message.data)
        found[channel.topic][0].append(message.log_time)
        found[channel.topic][1].append([getattr(values, name) for name in names(kind)])
    return found


def names(kind):
    """Return the names of the fields of a message, in the order of their numbers."""
    fields = sorted(kind.DESCRIPTOR.fields, key=lambda field: field.number)
    return [field.name for field in fields]


def test_mcap_core_decodes_the_same_values(logs):
    """The reader of Foxglove and Lichtblick, by the indexes and from the front."""
    for path, found in zip(logs, read_by_mcap_core(logs), strict=True):
        expected = {}
        for topic, time_ns, rows in components(path):
            expected[topic] = hashlib.sha256(hash_input(time_ns, rows)).hexdigest()
        assert found["indexed"] == expected, path.name
        assert found["streamed"] == expected, path.name


def read_by_mcap_core(paths):
    """Return the hash of each topic of each log, by the indexes and from the front."""
    needs(MODULES)
    script = Path(__file__).with_name("read_by_mcap_core.cjs")
    environment = {**os.environ, "NODE_PATH": str(MODULES)}
    command = ["node", str(script), *map(str, paths)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("count", [10, pytest.param(200, marks=pytest.mark.campaign)])
def test_mcap_core_finds_what_was_flushed_before_a_kill(tmp_path, count):
    """Within any write: all that was reported, and of the rows being flushed all or none."""
    needs(MODULES)
    chance = random.Random(count)
    _, writes = whole_run(Job(tmp_path / "a.mcap", 1))
    jobs = []
    reported = []
    for number in range(count):
        cut = (chance.randrange(10, writes), chance.random())
        job = Job(tmp_path / f"{number}.mcap", 1, cut=cut)
        reported.append(killed_run(job)[0])
        jobs.append(job)
    plant = jobs[0].rows[:, :5]
    refused = 0
    for rows, found in zip(reported, read_by_mcap_core([job.path for job in jobs]), strict=True):
        allowed = set()
        for flushed in accumulate(jobs[0].sizes, initial=0):
            if flushed >= rows:
                times = np.arange(flushed) * STEP_NS
                allowed.add(hashlib.sha256(hash_input(times, plant[:flushed])).hexdigest())
        assert not rows or found["indexed"]["/plant"] in allowed
        if found["streamed"] is None:  # the file was just being lengthened
            refused += 1
        else:
            assert not rows or found["streamed"]["/plant"] in allowed
    assert refused <= count // 10


def test_the_go_reader_decodes_the_same_values(logs):
    """That of the program ``mcap``; and its doctor finds no error."""
    needs(GO)
    for path in logs:
        subprocess.run([GO, "doctor", path], capture_output=True, check=True)
        command = [GO, "cat", "--json", path]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        fields = json_names(path)
        found = defaultdict(list)
        for line in lines.splitlines():
            message = json.loads(line)
            data = message["data"]
            if message["topic"] in fields:
                # JSON of protobuf leaves out what is 0, and has no numbers for NaN and infinity.
                row = [float(data.get(name, 0.0)) for name in fields[message["topic"]]]
                found[message["topic"]].append(row)
        for topic, _, rows in components(path):
            assert np.array_equal(np.array(found[topic]), rows, equal_nan=True), (path, topic)


def json_names(path):
    """Return the names of the fields of every component's topic as JSON has them."""
    fields = {}
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        kind = message_class(schema.name, schema.data)
        if not channel.topic.startswith("/cosim/"):
            by_number = sorted(kind.DESCRIPTOR.fields, key=lambda field: field.number)
            fields[channel.topic] = [field.json_name for field in by_number]
    return fields


def test_the_rust_reader_decodes_the_same_values(logs, tmp_path):
    """That of Rerun: its crate ``mcap``, and protobuf decoded in Rust, too."""
    needs(RUST)
    script = Path(__file__).with_name("read_by_rerun.py")
    environment = {**os.environ, "PYTHONPATH": f"{RUST}{os.pathsep}{READERS}"}
    command = [sys.executable, script, READERS, tmp_path, *logs]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    for path, line in zip(logs, done.stdout.splitlines(), strict=True):
        expected = {}
        for topic, time_ns, rows in components(path):
            expected[topic] = hashlib.sha256(hash_input(time_ns, rows)).hexdigest()
        assert json.loads(line) == expected, path.name
