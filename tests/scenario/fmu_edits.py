"""FMUs made of others by an edit of their descriptions."""

import zipfile

from tests.fmi.compiled import write_archive

DESCRIPTION = "modelDescription.xml"


def rewritten(path, target, *edits, members=lambda name: True):
    """Copy an FMU with its modelDescription.xml edited and some members left out."""
    kept: dict[str, bytes] = {}
    with zipfile.ZipFile(path) as source:
        for name in filter(members, source.namelist()):
            kept[name] = source.read(name)
    for before, after in edits:
        assert before.encode() in kept[DESCRIPTION]
        kept[DESCRIPTION] = kept[DESCRIPTION].replace(before.encode(), after.encode())
    return write_archive(target, kept)
