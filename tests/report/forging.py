"""Logs with something else in them, all checksums right."""

import json

from cosim.log import open_log
from tests.log.crafting import put_together, take_apart


def forged(log, path, *, text=None, metadata=None, results=None):
    """Write a log with something else in it; return its path.

    Parameters
    ----------
    log, path : Path
        Of the honest one, and of the forged one.
    text : (str, str), optional
        What the scenario has, and what it has instead.
    metadata : mapping of name to mapping, optional
        Entries of metadata records: texts, or what makes them of the honest ones.
    results : bytes, or callable, optional
        In place of result.json, empty: without it; or what changes its content in place.
    """
    content = take_apart(log)
    for name, items in content.metadata:
        for key, said in (metadata or {}).get(name, {}).items():
            items[key] = said(items[key]) if callable(said) else said
    attachments = dict(content.attachments)
    if text is not None:
        old, new = map(str.encode, text)
        assert old in attachments["scenario.toml"]
        attachments["scenario.toml"] = attachments["scenario.toml"].replace(old, new)
    if callable(results):
        found = json.loads(attachments["result.json"])
        results(found)
        attachments["result.json"] = json.dumps(found).encode()
    elif results is not None:
        attachments["result.json"] = results
    content.attachments = [(name, item) for name, item in attachments.items() if item]
    return put_together(content, path)


def with_own_hash(path):
    """Have a log say that it was recorded with the rows that it has; return its path."""
    found = open_log(path).content_hash()
    said = {"cosim.result": {"content_hash": found}}
    return forged(path, path, metadata=said, results=lambda r: r.update(content_hash=found))


def with_entries(**entries):
    """Return what gives a text of JSON other entries."""
    return lambda text: json.dumps({**json.loads(text), **entries})
