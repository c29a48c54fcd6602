"""Logs from elsewhere: whatever stands in them, a reader returns its content or a CosimError."""

import copy
import json
import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cosim
from cosim.errors import CosimError
from cosim.log import open_log
from cosim.report.inspection import describe_log
from cosim.report.summary import summarize
from cosim.report.tables.console import print_json
from cosim.report.verification import verify
from tests.log.crafting import put_together, take_apart

SHORT = {"scenario.stop": 0.02}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a short run; return its path."""
    path = tmp_path_factory.mktemp("valid") / "a.mcap"
    cosim.run("academic", out=path, set=SHORT)
    return path


def read_everything(path, valid):
    """Call every reader of logs: it returns, or raises a CosimError."""
    readers = [
        lambda: print_json(describe_log(str(path))),
        lambda: open_log(path).load(),
        lambda: open_log(path).messages(),
        lambda: open_log(path).content_hash(),
        lambda: (open_log(path).results, open_log(path).designs, open_log(path).held),
        lambda: summarize(open_log(path)),
        lambda: cosim.diff(open_log(valid), open_log(path), rtol=1e-9),
        lambda: cosim.diff(open_log(path), open_log(valid)),
        lambda: verify(open_log(path), cosim.replay(path)),
        lambda: cosim.run("academic", swap={"plant": path}, set=SHORT),
        lambda: cosim.replay(path, set={"observer.filter_rate": 10.0, "models.academic.n_a": 2}),
    ]
    for reader in readers:
        with suppress(CosimError):
            reader()


def paths_in(value, path=()):
    """Yield the paths of everything in a JSON value."""
    yield path
    if isinstance(value, dict):
        for key, item in value.items():
            yield from paths_in(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from paths_in(item, (*path, index))


def replaced(value, path, new):
    """Return a JSON value with another one at a path; ``...`` leaves it out."""
    if not path:
        return None if new is ... else new
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    if new is ...:
        del inner[path[-1]]
    else:
        inner[path[-1]] = new
    return value


VALUES = st.sampled_from(
    [
        *(..., None, True, 0, 1, -1, 10**30, 1e308, math.nan, -math.inf),
        *("", "x", "plant.y", "\ud800", "9" * 5000, "é" * 300),
        *([], [[]], [1.0], [None], {}, {"a": 1}, {"shape": [-1]}),
    ]
)
TEXTS = st.sampled_from(
    ["", "1", "null", "[", "{}", "[]", '"x"', "NaN", "-1", "9" * 30, "9" * 5000, "٣", "[" * 10**5]
)
TOML = st.sampled_from(
    ["1", "-1", "1e308", "1e-300", "nan", "[]", "{}", '"x"', "true", "[[1, 2], [3]]", "1979-05-27"]
)


@st.composite
def mutations(draw, content):
    """Change one place of a log."""
    content = copy.deepcopy(content)
    places = [mutate_metadata, mutate_channel, mutate_message, mutate_attachment, mutate_scenario]
    draw(st.sampled_from(places))(draw, content)
    return content


def mutate_metadata(draw, content):
    """Change a metadata record, its name or its number."""
    index = draw(st.integers(0, len(content.metadata) - 1))
    name, items = content.metadata[index]
    match draw(st.sampled_from(["item", "item", "item", "name", "leave out", "twice"])):
        case "item":
            mutate_item(draw, items)
        case "name":
            content.metadata[index] = (draw(st.sampled_from(["", "cosim.result", "x"])), items)
        case "leave out":
            del content.metadata[index]
        case _:
            content.metadata.append((name, {}))


def mutate_channel(draw, content):
    """Change what a channel says of itself."""
    number = draw(st.sampled_from(sorted(content.channels)))
    topic, schema, items = content.channels[number]
    action = draw(st.sampled_from(["item", "item", "item", "none", "twice"]))
    if action == "item" and items:
        mutate_item(draw, items)
    elif action == "twice":
        content.channels[99] = (f"{topic}.2", schema, items)
    else:
        content.channels[number] = (topic, schema, {})


def mutate_message(draw, content):
    """Change a message, or how often it is there."""
    index = draw(st.integers(0, len(content.messages) - 1))
    number, time_ns, sequence, data = content.messages[index]
    action = draw(st.sampled_from(["value", "time", "size", "channel", "twice", "leave out"]))
    match action:
        case "value":
            value = draw(st.sampled_from([math.nan, math.inf, 1e308, -0.0]))
            data = data[:1] + np.float64(value).tobytes() + data[9:]
        case "time":
            time_ns = draw(st.sampled_from([0, 1, 2**63 - 1, 2**63, 2**64 - 1]))
        case "size":
            data = draw(st.sampled_from([b"", data[:-1], data + b"\0", data[:-9]]))
        case "channel":
            number = draw(st.sampled_from(sorted(content.channels)))
    content.messages[index] = (number, time_ns, sequence, data)
    if action == "twice":
        content.messages.append(content.messages[index])
    elif action == "leave out":
        del content.messages[index]


def mutate_attachment(draw, content):
    """Replace an attachment."""
    index = draw(st.integers(0, len(content.attachments) - 1))
    name, data = content.attachments[index]
    new = draw(st.sampled_from([b"", b"\xff\xfe", b"1", b"[" * 10**5, data[: len(data) // 2]]))
    content.attachments[index] = (name, new)


def mutate_item(draw, items):
    """Change a text of a map, where it is JSON inside of it."""
    key = draw(st.sampled_from(sorted(items)))
    try:
        value = json.loads(items[key])
    except ValueError:
        value = None
    if value is None or draw(st.integers(0, 3)) == 0:
        items[key] = draw(TEXTS)
        return
    path = draw(st.sampled_from(list(paths_in(value))))
    items[key] = json.dumps(replaced(value, path, draw(VALUES)))


def mutate_scenario(draw, content):
    """Change a value of the scenario's text."""
    index = [name for name, _ in content.attachments].index("scenario.toml")
    name, data = content.attachments[index]
    lines = data.decode().splitlines()
    with_values = [i for i, line in enumerate(lines) if " = " in line]
    number = draw(st.sampled_from(with_values))
    key = lines[number].split(" = ")[0]
    lines[number] = f"{key} = {draw(TOML)}"
    content.attachments[index] = (name, "\n".join(lines).encode())


@settings(max_examples=2, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_changed_log_is_read_or_refused(valid, tmp_path_factory, data):
    """One change of its content, checksums right: no reader fails in another way."""
    read_mutated(valid, tmp_path_factory, data)


@pytest.mark.campaign
@settings(max_examples=3000, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_changed_log_is_read_or_refused(valid, tmp_path_factory, data):
    """The same, many times."""
    read_mutated(valid, tmp_path_factory, data)


def read_mutated(valid, tmp_path_factory, data):
    content = data.draw(mutations(take_apart(valid)), label="content")
    path = tmp_path_factory.mktemp("mutated") / "a.mcap"
    put_together(content, path, use_chunking=data.draw(st.booleans()))
    read_everything(path, valid)
