"""What a viewer does with a layout: find its message paths in what a stock decoder reads."""

from __future__ import annotations

import re

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

# The grammar of Foxglove and Lichtblick, as far as paths of one field go.
PATH = re.compile(
    r'(?:(?P<plain>[A-Za-z0-9_/-]+)|"(?P<quoted>(?:[^"\\]|\\["\\])*)")\.(?P<field>[A-Za-z0-9_-]+)'
)


def parsed(path):
    """Return topic and field of a message path."""
    match = PATH.fullmatch(path)
    assert match, path
    quoted = match["quoted"]
    topic = match["plain"] if quoted is None else re.sub(r"\\(.)", r"\1", quoted)
    return topic, match["field"]


def decoded(path):
    """Return the values of all fields of a log by topic and field, as the stock decoder finds."""
    found = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            for field in message.DESCRIPTOR.fields:
                values = found.setdefault((channel.topic, field.name), [])
                values.append(getattr(message, field.name))
    return found


def curves(layout):
    """Return the paths of all curves of a layout, and the levels of its horizontal lines."""
    paths = []
    levels = []
    for config in layout["configById"].values():
        for curve in config["paths"]:
            try:
                levels.append(float(curve["value"]))
            except ValueError:
                paths.append(curve["value"])
    return paths, levels


def leaves(node):
    """Return the panels of the tree that divides the window."""
    if isinstance(node, str):
        return [node]
    assert node["direction"] in ("row", "column")
    assert 0.0 < node["splitPercentage"] < 100.0
    return [*leaves(node["first"]), *leaves(node["second"])]
