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


def texts_of(content):
    """Return (map, key) of every text of the metadata and of the channels."""
    maps = [items for _, items in content.metadata]
    maps += [items for _, _, items in content.channels.values()]
    return [(items, key) for items in maps for key in sorted(items)]


@st.composite
def mutations(draw, content):
    """Change one place of a log: a text or what is inside of it, a message, an attachment."""
    content = copy.deepcopy(content)
    match draw(st.sampled_from(["text", "text", "text", "message", "attachment", "scenario"])):
        case "text":
            items, key = draw(st.sampled_from(texts_of(content)))
            items[key] = mutated_text(draw, items[key])
        case "message":
            mutate_message(draw, content)
        case "attachment":
            index = draw(st.integers(0, len(content.attachments) - 1))
            name, data = content.attachments[index]
            others = [b"", b"\xff\xfe", b"1", b"[" * 10**5, data[: len(data) // 2]]
            content.attachments[index] = (name, draw(st.sampled_from(others)))
        case _:
            mutate_scenario(draw, content)
    return content


def mutated_text(draw, text):
    """Return another text, or JSON with another value in one place."""
    try:
        value = json.loads(text)
    except ValueError:
        value = None
    if value is None or draw(st.integers(0, 3)) == 0:
        return draw(TEXTS)
    return json.dumps(replaced(value, draw(st.sampled_from(list(paths_in(value)))), draw(VALUES)))


def mutate_message(draw, content):
    """Change a message, leave it out, or write it twice."""
    index = draw(st.integers(0, len(content.messages) - 1))
    number, time_ns, sequence, data = content.messages[index]
    value = draw(st.sampled_from([math.nan, math.inf, 1e308, -0.0]))
    others = [
        *((number, time_ns, sequence, d) for d in (b"", data[:-1], data + b"\0", data[:-9])),
        *((number, other, sequence, data) for other in (0, 1, 2**63 - 1, 2**63, 2**64 - 1)),
        *((other, time_ns, sequence, data) for other in sorted(content.channels)),
        (number, time_ns, sequence, data[:1] + np.float64(value).tobytes() + data[9:]),
    ]
    changed = [[other] for other in others] + [[], 2 * [content.messages[index]]]
    content.messages[index : index + 1] = draw(st.sampled_from(changed))


def mutate_scenario(draw, content):
    """Change a value of the scenario's text."""
    index = [name for name, _ in content.attachments].index("scenario.toml")
    name, data = content.attachments[index]
    lines = data.decode().splitlines()
    number = draw(st.sampled_from([i for i, line in enumerate(lines) if " = " in line]))
    lines[number] = f"{lines[number].split(' = ')[0]} = {draw(TOML)}"
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
