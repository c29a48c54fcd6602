"""Hostile archives are refused or contained.

Nothing is written outside the work folder, nothing is left, and memory is bounded.
"""

import os
import stat
import struct
import tempfile
import tracemalloc
import zipfile
import zlib
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import pytest

from cosim.errors import FmuError
from cosim.fmi.component import load
from cosim.fmi.reading import archive
from cosim.fmi.reading.model_description import read
from tests.fmi.archives import XML, Entry, deflate, local_header, write, zeros

# Bytes more than before: an archive is never in memory as a whole, and its XML is small here.
MEMORY = 50 * 2**20


@pytest.fixture
def place(tmp_path, temporary):
    """Yield a folder to write the archive into.

    Afterwards it holds the archive alone, and no temporary folder is left.
    """
    folder = tmp_path / "work" / "deep"
    folder.mkdir(parents=True)
    home = os.getcwd()
    yield folder
    files = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*"))
    assert files == ["temporary", "work", "work/deep", "work/deep/x.fmu"]
    assert os.getcwd() == home


def refused(path, text):
    """Check that reading and loading refuse an archive with the same message and little memory."""
    tracemalloc.start()
    try:
        for opening in (read, load):
            with pytest.raises(FmuError, match=text) as error:
                opening(path)
            assert str(path) in str(error.value)
            assert error.value.exit_code == 2
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()


CONTROL = "an entry with a control character in its name"
EMPTY = "an entry with an empty part in its path"
NAMES = {
    "/etc/evil": "an entry with an absolute path: '/etc/evil'",
    "//server/share/evil": "an entry with an absolute path",
    "\\\\server\\share\\evil": "an entry with an absolute path",
    "\\evil": "an entry with an absolute path",
    "C:/evil": "an entry with an absolute path: 'C:/evil'",
    "./C:/evil": "an entry with an absolute path",
    ".\\/evil": "an entry with an absolute path",
    "c:evil": "an entry with an absolute path",
    "C:\\evil": "an entry with an absolute path",
    "../evil": r"an entry that leads out of it: '\.\./evil'",
    "..": "an entry that leads out of it",
    "resources/../../evil": "an entry that leads out of it",
    "resources/..": "an entry that leads out of it",
    "..\\evil": "an entry that leads out of it",
    "resources\\..\\..\\evil": "an entry that leads out of it",
    "resources/..\\../evil": "an entry that leads out of it",
    "resources/evil\0.txt": CONTROL,
    "resources/e\nvil": CONTROL,
    "resources/e\x7fvil": CONTROL,
    "resources/e\u202evil": CONTROL,  # writes from right to left
    ".": EMPTY,
    "././.": EMPTY,
    "resources//evil": EMPTY,
    "resources\\/evil": EMPTY,
    "": EMPTY,
    "a/" * 40 + "evil": r"an entry whose path is too long \(at most 32 parts of 255 bytes\)",
    "é" * 128: "an entry whose path is too long",
}


def test_names_of_entries(place, subtests):
    """Only relative paths of plain names are files."""
    for name, text in NAMES.items():
        with subtests.test(name=name):
            refused(write(place / "x.fmu", [Entry(name, b"x")]), f"the archive has {text}")


CLASHES = {
    "duplicate": (["a.txt", "./a.txt"], "2 entries of one name that differ: 'a.txt'"),
    "second description": (
        ["modelDescription.xml"],
        "2 entries of one name that differ: 'modelDescription.xml'",
    ),
    "file as folder": (
        ["resources", "resources/a.txt"],
        "'resources' as a file, where 'resources/a.txt' needs a folder",
    ),
    "folder as file": (
        ["resources/a/b.txt", "resources/a"],
        "'resources/a' as a file, where 'resources/a/b.txt' needs a folder",
    ),
    "file and folder": (
        ["resources", "resources/"],
        "'resources' as a file, where 'resources/' needs a folder",
    ),
}


def test_names_that_clash(place, subtests):
    """Names that are one file on some system are one too many."""
    for case, (names, text) in CLASHES.items():
        with subtests.test(case=case):
            entries = [Entry(name, b"" if name.endswith("/") else name.encode()) for name in names]
            refused(write(place / "x.fmu", entries), f"the archive has {text}")


ON_SOME_SYSTEMS = {
    "stream": ["resources/evil:stream"],
    "device": ["resources/NUL"],
    "device with a suffix": ["resources/com1.txt"],
    "dot at the end": ["resources/K220LS_06_063141_01_1."],
    "dot at the end of a folder": ["resources./a"],
    "blank at the end": ["resources/evil "],
    "case": ["resources/a.txt", "resources/A.txt"],
    "case of a description": ["MODELDESCRIPTION.XML"],
    "case of a folder": ["resources/a.txt", "Resources/b.txt"],
    "sharp s": ["straße", "STRASSE"],
    "composed letters": ["\u00e9.txt", "e\u0301.txt"],
}


def test_names_that_not_every_system_takes(tmp_path, monkeypatch, subtests):
    """Where this one takes them they are unpacked, with a warning; elsewhere refused."""
    for case, names in ON_SOME_SYSTEMS.items():
        with subtests.test(case=case):
            path = write(tmp_path / "x.fmu", [Entry(name, name.encode()) for name in names])
            folder = Path(tempfile.mkdtemp(dir=tmp_path))
            contents = archive.read_archive(path, (), folder)
            assert {name: (folder / name).read_bytes() for name in names} == {
                name: name.encode() for name in names
            }
            (warning,) = contents.warnings
            assert "keeps for devices or streams" in warning or "are one on some systems" in warning
            message = r"keeps for devices or streams|are one on some systems"
            with monkeypatch.context() as patch:
                patch.setattr(archive, "SYSTEM", "windows")
                with pytest.raises(FmuError, match=message):
                    archive.read_archive(path, ())


def test_backslashes(tmp_path):
    """Some tools for Windows write them; they separate folders, as there."""
    names = ["binaries\\linux64/", "binaries\\linux64\\a.so", "resources\\"]
    entries = [Entry(name, b"" if name[-1] in "/\\" else b"x") for name in names]
    path = write(tmp_path / "x.fmu", entries)
    target = tmp_path / "folder"
    target.mkdir()
    contents = archive.read_archive(path, (), target)
    assert contents.members == {"binaries/linux64/a.so", "modelDescription.xml"}
    assert (target / "binaries/linux64/a.so").read_bytes() == b"x"
    assert (target / "resources").is_dir()
    assert contents.warnings[0].startswith(
        "the archive has names with backslashes, where FMI needs"
    )


def test_paths_that_begin_where_they_are(tmp_path):
    """``zip -r x.fmu .`` and ``tar`` list the folder itself, as "./", and files behind that."""
    folder = {"unix_mode": stat.S_IFDIR | 0o755}
    names = ["./resources/a", "resources/./b", ".\\resources\\c"]
    entries = [Entry("./", **folder), Entry("./resources/", **folder)]
    entries += [Entry(name, name.encode()) for name in names]
    entries.append(Entry("./modelDescription.xml", XML.encode()))
    path = write(tmp_path / "x.fmu", entries, xml=None)
    target = tmp_path / "folder"
    target.mkdir()
    contents = archive.read_archive(path, ("modelDescription.xml",), target)
    assert contents.wanted == {"modelDescription.xml": XML.encode()}
    assert contents.members == {"modelDescription.xml", *(f"resources/{name}" for name in "abc")}
    assert [(target / "resources" / name).read_bytes() for name in "abc"] == [
        name.encode() for name in names
    ]


def test_a_file_that_is_listed_twice(place):
    """With the same bytes it has one meaning; those are compared, not what the entries declare."""
    once = Entry("resources/a", b"x" * 100)
    for again in (once, Entry("resources/a", b"x" * 100, method=0)):
        contents = archive.read_archive(write(place / "x.fmu", [once, again]), ())
        assert contents.warnings == (
            "the archive lists files twice, with equal bytes: resources/a",
        )
        assert contents.members == {"modelDescription.xml", "resources/a"}
    both_in_one_place = [replace(once, offset=0), replace(once, offset=0)]
    same = write(place / "x.fmu", [once, *both_in_one_place], xml=None)
    assert archive.read_archive(same, ("resources/a",)).wanted == {"resources/a": b"x" * 100}
    other = Entry("resources/a", b"y" * 100, crc=zlib.crc32(b"x" * 100))
    refused(write(place / "x.fmu", [once, other]), "the archive cannot be unpacked: BadZipFile")
    refused(
        write(place / "x.fmu", [once, Entry("resources/a", b"y" * 100)]),
        "the archive has 2 entries of one name that differ: 'resources/a'",
    )


def test_a_folder_that_is_listed_twice(tmp_path):
    """The archives of Reference-FMUs do so; nothing has two meanings."""
    folder = Entry("resources/", unix_mode=stat.S_IFDIR | 0o755)
    path = write(tmp_path / "x.fmu", [folder, Entry("resources/a", b"x"), folder])
    target = tmp_path / "folder"
    target.mkdir()
    contents = archive.read_archive(path, (), target)
    assert contents.warnings == ("the archive lists folders twice: resources/",)
    assert (target / "resources/a").read_bytes() == b"x"


LINK = "a link, where it may have files and folders only"
TYPES = {
    "link": (Entry("a", b"/etc/passwd", unix_mode=stat.S_IFLNK | 0o777), f"{LINK}: 'a'"),
    "link to a folder": (Entry("a/", b"", unix_mode=stat.S_IFLNK | 0o777), f"{LINK}: 'a/'"),
    "device": (Entry("a", b"", unix_mode=stat.S_IFBLK | 0o600), "a special file"),
    "pipe": (Entry("a", b"", unix_mode=stat.S_IFIFO | 0o600), "a special file"),
    "socket": (Entry("a", b"", unix_mode=stat.S_IFSOCK | 0o600), "a special file"),
    "folder without a slash": (Entry("a", b"", unix_mode=stat.S_IFDIR | 0o700), "a special file"),
    "folder with content": (
        Entry("a/", b"x", unix_mode=stat.S_IFDIR | 0o700),
        "a folder with content of its own: 'a/'",
    ),
    "encrypted": (Entry("a", b"x", flags=1), "an encrypted entry: 'a'"),
    "strongly encrypted": (Entry("a", b"x", flags=0x41), "an encrypted entry: 'a'"),
    "deflate64": (
        Entry("a", b"x", method=9),
        r"an entry with compression method 9 \(expected 0, stored, or 8, deflated\): 'a'",
    ),
    "bzip2": (Entry("a", b"x", method=12), "an entry with compression method 12"),
    "lzma": (Entry("a", b"x", method=14), "an entry with compression method 14"),
    "unknown compression": (Entry("a", b"x", method=4711), "an entry with compression method 4711"),
}


def test_types_of_entries(place, subtests):
    """Plain files and folders, stored or deflated, are all that an FMU needs."""
    for case, (entry, text) in TYPES.items():
        with subtests.test(case=case):
            refused(write(place / "x.fmu", [entry]), f"the archive has {text}")


def test_a_name_that_is_no_text(place):
    """Marked as UTF-8, and is not."""
    path = write(place / "x.fmu", [Entry(b"\xff\xfe", b"x", flags=0x800)])
    refused(path, "not an FMU, as it is no zip archive")


def test_a_hard_link_is_a_file(place):
    """Extra fields that name another file are ignored: what comes out is a file of its own."""
    extra = struct.pack("<HH", 0x000D, 12 + len(b"/etc/passwd")) + bytes(12) + b"/etc/passwd"
    path = write(place / "x.fmu", [Entry("resources/a", b"mine", extra=extra)])
    assert "resources/a" in read(path).members


# --- bombs ---


def declared_small(size):
    """Return an entry that declares to be small."""
    return Entry("resources/bomb", packed=zeros(size), size=10, crc=zlib.crc32(bytes(10)))


def test_a_size_that_is_declared_too_small(place):
    """Only the declared bytes come out."""
    path = write(place / "x.fmu", [declared_small(2**27)])
    with pytest.raises(FmuError, match="neither model exchange nor co-simulation"):
        load(path)


def test_a_size_that_is_declared_too_large(place):
    """What does not come out was not there."""
    path = write(place / "x.fmu", [Entry("resources/a", b"x" * 100, size=200)])
    message = "'resources/a' has 100 bytes unpacked; the archive declares 200"
    with pytest.raises(FmuError, match=message):
        load(path)


def test_the_sum_of_declared_sizes(place):
    """The first reason to refuse, before anything is unpacked."""
    entries = [Entry(f"resources/{i}", b"x", size=2**28) for i in range(5)]
    message = r"unpacked, the archive would have 1342\d{6} bytes; expected at most 1073741824"
    refused(write(place / "x.fmu", entries), message)


def test_a_ratio(place):
    """Zeros pack a thousand times: 64 MiB in 65 kB; a small file of zeros is none."""
    crc = zlib.crc32(bytes(2**26))
    bomb = Entry("resources/bomb", packed=zeros(2**26), size=2**26, crc=crc)
    path = write(place / "x.fmu", [bomb])
    ratio = r"is packed more than 200 times: 65\d{3} bytes unpack to 13\d{6} or more"
    with pytest.raises(FmuError, match=f"'resources/bomb' {ratio}"):
        load(path)
    path = write(place / "x.fmu", [Entry("resources/table", bytes(2**20))])
    with pytest.raises(FmuError, match="neither model exchange"):
        load(path)


def test_a_ratio_that_is_declared_small(place):
    """A packed size larger than the entry reaches into the next one."""
    bomb = Entry("resources/bomb", packed=zeros(2**26), size=2**26, packed_size=2**20)
    path = write(place / "x.fmu", [bomb, Entry("resources/a", b"x")])
    refused(path, "the archive has overlapping entries: 'resources/a' begins inside another")


def test_a_bomb_in_a_bomb(place):
    """An archive in an archive stays a file."""
    inner = place / "inner.zip"
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr("zeros", bytes(2**24))
    content = inner.read_bytes()
    inner.unlink()
    path = write(place / "x.fmu", [Entry("resources/inner.zip", content, method=0)])
    with pytest.raises(FmuError, match="neither model exchange"):
        load(path)


def test_many_entries(place, monkeypatch):
    """More than 10 000; tested with fewer, which is quicker."""
    assert archive.MOST == 10_000
    monkeypatch.setattr(archive, "MOST", 100)
    entries = [Entry(f"resources/{i}") for i in range(100)]
    refused(write(place / "x.fmu", entries), "the archive has 101 entries; expected at most 100")


def test_a_list_of_entries_that_is_long(place):
    """The list is not read before its length is known: here 20 MB of extra fields."""
    extra = struct.pack("<HH", 0xCAFE, 60_000) + bytes(60_000)
    entries = [Entry(f"resources/{i}", extra=extra, offset=0) for i in range(340)]
    message = r"the archive's list of entries takes 204\d{5} bytes; expected at most 16777216"
    refused(write(place / "x.fmu", entries), message)


def test_entries_that_overlap(place):
    """Many entries with the bytes of one."""
    entries = [Entry(f"resources/{i}", b"x" * 1000, offset=0) for i in range(10)]
    message = "the archive has overlapping entries: 'resources/0' begins inside another"
    refused(write(place / "x.fmu", entries), message)


def test_entries_that_quote_each_other(place):
    """The packed content of the first holds the second whole."""
    second = Entry("b", b"x", method=0, offset=31)
    first = Entry("a", local_header(second), method=0)
    path = write(place / "x.fmu", [first, second], xml=None)
    refused(path, "the archive has overlapping entries: 'b' begins inside another")


# --- damage ---


def test_an_archive_that_is_cut(place):
    path = write(place / "x.fmu", [Entry("resources/a", bytes(range(256)) * 100)])
    path.write_bytes(path.read_bytes()[:-60])
    refused(path, "not an FMU, as it is no zip archive")


def test_an_entry_that_reaches_beyond_the_end(place):
    entry = Entry("resources/a", b"x", method=0, packed_size=2000, size=2000)
    path = write(place / "x.fmu", [entry])
    reach = "an entry that reaches beyond the others: the file is truncated or altered"
    refused(path, f"the archive has {reach}")


@pytest.mark.parametrize("method", [0, 8])
def test_a_wrong_sum(place, method):
    path = write(place / "x.fmu", [Entry("resources/a", b"x" * 10, method=method, crc=1)])
    reason = "BadZipFile: Bad CRC-32 for file 'resources/a'"
    with pytest.raises(FmuError, match=f"the archive cannot be unpacked: {reason}"):
        load(path)


def test_a_stream_that_is_no_stream(place):
    path = write(place / "x.fmu", [Entry("resources/a", b"x" * 10, packed=b"\xff" * 10)])
    with pytest.raises(FmuError, match="the archive cannot be unpacked: error: Error -3"):
        load(path)


def test_a_stream_that_is_cut(place):
    content = os.urandom(1000)
    entry = Entry("resources/a", content, packed=deflate(content)[:500])
    path = write(place / "x.fmu", [entry])
    message = r"'resources/a' has .* bytes unpacked; the archive declares 1000|EOFError|Bad CRC"
    with pytest.raises(FmuError, match=message):
        load(path)


def test_another_name_in_the_local_header(place):
    path = write(place / "x.fmu", [Entry("resources/a", b"x", method=0)])
    data = path.read_bytes()
    where = data.index(b"resources/a")
    path.write_bytes(data[:where] + b"../../evil!" + data[where + 11 :])
    message = "the archive cannot be unpacked: BadZipFile: File name in directory"
    with pytest.raises(FmuError, match=message):
        load(path)


def test_no_archive_at_all(place):
    (place / "x.fmu").write_bytes(b"MZ" + bytes(1000))
    refused(place / "x.fmu", "not an FMU, as it is no zip archive")


def test_an_empty_file(place):
    (place / "x.fmu").write_bytes(b"")
    refused(place / "x.fmu", "not an FMU, as it is no zip archive")


# --- the description ---


def test_no_description(place):
    path = write(place / "x.fmu", [], xml=None)
    refused(path, "not an FMU, as the archive has no modelDescription.xml")


def test_a_description_that_is_a_folder(place):
    entries = [Entry("modelDescription.xml/"), Entry("modelDescription.xml/a", b"x")]
    path = write(place / "x.fmu", entries, xml=None)
    refused(path, "not an FMU, as the archive has no modelDescription.xml")


LAUGHS = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
DOCUMENT_TYPES = {
    "empty": "<!DOCTYPE fmiModelDescription>",
    "system": '<!DOCTYPE x SYSTEM "http://127.0.0.1/x.dtd">',
    "billion laughs": f'<!DOCTYPE x [<!ENTITY l0 "ha">{LAUGHS}]>',
    "external entity": '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>',
    "parameter entity": '<!DOCTYPE x [<!ENTITY % e SYSTEM "file:///etc/passwd"> %e;]>',
    "quadratic": f'<!DOCTYPE x [<!ENTITY e "{"a" * 40_000}">]>',
}


@pytest.mark.slow
def test_document_types(place, subtests):
    """Whatever its encoding, a document with a type is refused before its entities are used."""
    first, *others = DOCUMENT_TYPES.values()
    encodings = ["utf-8", "utf-16", "utf-16-be", "utf-16-le", "iso-8859-1"]
    cases = [*product(encodings, [first]), *product(["utf-8", "utf-16-le"], others)]
    for encoding, text in cases:
        with subtests.test(encoding=encoding, text=text):
            named = "utf-16" if encoding.startswith("utf-16") else encoding
            body = XML.partition("?>")[2]
            if "ENTITY" in text:
                body = body.replace("<ModelVariables/>", "&l9;&e;")
            xml = f'<?xml version="1.0" encoding="{named}"?>{text}{body}'.encode(encoding)
            if encoding.startswith("utf-16-"):
                xml = (b"\xfe\xff" if encoding.endswith("be") else b"\xff\xfe") + xml
            path = write(place / "x.fmu", [], xml=xml)
            refused(path, "modelDescription.xml is not well-formed: it has a document type")


def test_an_entity_that_is_not_known(place):
    xml = XML.replace('"m"', '"&e;"').encode()
    refused(write(place / "x.fmu", [], xml=xml), "not well-formed: undefined entity")


def test_a_deep_description(place):
    xml = XML.replace("<ModelVariables/>", "<a>" * 10_000 + "</a>" * 10_000).encode()
    path = write(place / "x.fmu", [], xml=xml)
    refused(path, "not well-formed: elements stand more than 64 deep in each other")


def test_a_huge_description(place, monkeypatch):
    """More than 64 MB; tested with less, which is quicker."""
    assert archive.XML_LARGEST == 64 * 2**20
    monkeypatch.setattr(archive, "XML_LARGEST", 10_000)
    comment = f"<!--{os.urandom(6000).hex()}-->"
    path = write(place / "x.fmu", [], xml=XML.replace("<ModelVariables/>", comment).encode())
    refused(path, "'modelDescription.xml' has more than 10000 bytes unpacked")


def test_a_description_that_is_a_bomb(place):
    """64 MiB of blanks in 65 kB."""
    xml = XML.encode() + b" " * 2**21
    path = write(place / "x.fmu", [], xml=xml)
    refused(path, "'modelDescription.xml' is packed more than 200 times")


def test_an_identifier_that_is_a_path(place, subtests):
    """It becomes the name of the library that is loaded."""
    for identifier in [
        "../../x",
        "/tmp/x",
        "a/b",
        "..",
        "",
        " ",
        "a\\b",
        "c:a",
        "a\u202eb",
        "a" * 5000,
        "ü" * 101,
    ]:
        with subtests.test(identifier=identifier[:20]):
            element = f'<CoSimulation modelIdentifier="{identifier}"/>'
            xml = XML.replace("<ModelVariables/>", f"{element}<ModelVariables/>").encode()
            path = write(place / "x.fmu", [], xml=xml)
            refused(path, "CoSimulation: modelIdentifier .* is no name of a file")


def test_a_good_archive_comes_out_whole(tmp_path):
    """Folders, empty ones too; files in folders that are not listed, stored and deflated."""
    files = {"resources/a.txt": b"a" * 1000, "documentation/ü/b.txt": b"b", "empty": b""}
    entries = []
    for name, content in files.items():
        entries.append(Entry(name, content, method=len(content) % 2 * 8))
    entries.append(Entry("extra/", unix_mode=stat.S_IFDIR | 0o755))
    path = write(tmp_path / "x.fmu", entries)
    folder = tmp_path / "folder"
    folder.mkdir()
    contents = archive.read_archive(path, ("modelDescription.xml",), folder)
    assert contents.wanted == {"modelDescription.xml": XML.encode()}
    assert contents.members == {*files, "modelDescription.xml"}
    assert {name: (folder / name).read_bytes() for name in files} == files
    assert (folder / "extra").is_dir()


@pytest.mark.parametrize("count", [300, pytest.param(30_000, marks=pytest.mark.campaign)])
def test_altered_archives(tmp_path, temporary, count):
    """Bytes changed anywhere: it comes out whole, or is refused; nothing is written beside it."""
    good = [
        Entry("resources/a.txt", b"a" * 300),
        Entry("binaries/linux64/m.so", os.urandom(200), method=0),
        Entry("extra/"),
    ]
    path = write(tmp_path / "x.fmu", good)
    data = path.read_bytes()
    random = Random(count)
    refused = 0
    for _ in range(count):
        altered = bytearray(data)
        for _ in range(random.randint(1, 3)):
            value = random.choice((0, 1, 0x2F, 0x5C, 0xFF, random.randrange(256)))
            altered[random.randrange(len(data))] = value
        path.write_bytes(altered)
        with pytest.raises(FmuError) as error:
            load(path)
        refused += "neither model exchange" not in str(error.value)
    assert 0.5 * count < refused < count
    assert sorted(file.name for file in tmp_path.iterdir()) == ["temporary", "x.fmu"]
    assert not list(temporary.iterdir())
