"""Samples of fields in files of every form that other tools write."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import FieldProblem, nanoseconds_in
from cosim.log.foreign.samples import survey
from tests.log.foreign_files import COMPRESSIONS, COUNT, EPOCH, raw_file, read, write_json

FORMS = [
    *({"compression": compression} for compression in COMPRESSIONS.values()),
    {"use_chunking": False},
    {"use_chunking": False, "enable_data_crcs": True},
    {"enable_crcs": False},
    {"use_summary_offsets": False, "use_statistics": False, "index_types": IndexType.NONE},
    {"repeat_channels": False, "repeat_schemas": False},
    {
        "use_chunking": False,
        "use_summary_offsets": False,
        "use_statistics": False,
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
]


def test_files_of_every_form_have_the_same_samples(tmp_path, subtests):
    """Compressed or not, in chunks or not, with a summary, a part of one or none."""
    topics = {
        "/a": [(EPOCH + 2 * i, {"x": i / 3}) for i in range(COUNT)],
        "/b": [(EPOCH + 2 * i + 1, {"x": -i}) for i in range(COUNT)],
    }
    for options in FORMS:
        path = write_json(tmp_path / "log.mcap", topics, schema={}, chunk_size=2048, **options)
        for name, samples in zip(topics, read(path, "/a.x", "/b.x"), strict=True):
            with subtests.test(case=(name, options)):
                assert samples.values.tolist() == [[row["x"]] for _, row in topics[name]]
                assert samples.time_ns.tolist() == [time_ns for time_ns, _ in topics[name]]
                assert (samples.spacing.late, samples.spacing.repeated) == (0, 0)


def test_messages_out_of_order_are_sorted_and_counted(tmp_path):
    """Of several of one instant the last one in the file counts."""
    times = [5, 1, 9, 9, 3, 9, 12]
    rows = [(EPOCH + time, {"x": place}) for place, time in enumerate(times)]
    path = write_json(tmp_path / "log.mcap", {"/t": rows})
    (samples,) = read(path, "/t.x")
    assert (samples.time_ns - EPOCH).tolist() == [1, 3, 5, 9, 12]
    assert samples.values[:, 0].tolist() == [1, 4, 0, 5, 6]
    spacing = samples.spacing
    assert (spacing.count, spacing.late, spacing.repeated) == (7, 2, 2)
    assert (spacing.first_ns - EPOCH, spacing.last_ns - EPOCH) == (1, 12)
    assert (spacing.median_ns, spacing.largest_ns, spacing.largest_at_ns - EPOCH) == (2, 4, 5)


def test_a_topic_of_two_schemas_is_read_where_both_have_the_field(tmp_path):
    """Each message by its own; one that has no such field is refused."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        layouts = {"One": "float64 x\nfloat64 a", "Two": "float32 b\nfloat64 x"}
        for index, (name, text) in enumerate(layouts.items()):
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channel = writer.register_channel("/t", "cdr", schema)
            first = struct.pack("<d", 1.5) if name == "One" else struct.pack("<f4x", 7.0)
            second = struct.pack("<d", 2.5)
            data = b"\0\1\0\0" + first + second
            writer.add_message(channel, EPOCH + index, data, EPOCH)
        writer.finish()
    assert read(path, "/t.x")[0].values[:, 0].tolist() == [1.5, 2.5]
    with pytest.raises(LogError, match=r"'/t.a', message 2: unknown field 'a'; available: b, x"):
        read(path, "/t.a")


def test_a_recording_ends_with_its_last_message_of_any_topic(tmp_path):
    """So does what was published once; by times within the messages, with those that are read."""
    topics = {
        "/map": [(EPOCH, {"size": 3, "s": 1})],
        "/pose": [(EPOCH + i, {"x": i, "s": i}) for i in range(9)],
    }
    path = write_json(tmp_path / "log.mcap", topics)
    ends = [read(path, "/map.size", time=time)[0].end_ns for time in ("log_time", "publish_time")]
    assert ends == [EPOCH + 8, EPOCH + 15]  # published 7 ns later than logged
    assert read(path, "/map.size", time="s")[0].end_ns == 10**9


def test_a_name_that_begins_with_two_topics_is_refused_with_the_way_to_say_which(tmp_path):
    """A topic in quotes."""
    topics = {"/a": [(EPOCH, {"b": {"c": 1}})], "/a.b": [(EPOCH, {"c": 2})]}
    path = write_json(tmp_path / "log.mcap", topics)
    with pytest.raises(LogError, match=r"'/a.b.c': .*several topics.* \"/a\" or \"/a.b\""):
        read(path, "/a.b.c")
    first, second = read(path, '"/a".b.c', '"/a.b".c')
    assert (first.values.item(), second.values.item()) == (1.0, 2.0)
    listed = [list(topic.fields) for topic in survey(path)]
    assert listed == [['"/a".b.c'], ['"/a.b".c']]


def test_unknown_encodings_are_refused(tmp_path, subtests):
    """With what can be read."""
    for encoding, schema, text in [
        ("cbor", None, "expected messages in protobuf, json, or cdr .*, got 'cbor' with no schema"),
        ("cdr", ("x", "omgidl", b""), "got 'cdr' with a schema in 'omgidl'"),
        ("protobuf", None, "got 'protobuf' with no schema"),
        ("cdr", ("x", "ros2msg", b"\xff"), "its schema 'x' is not UTF-8 text"),
    ]:
        path = raw_file(tmp_path, encoding, schema, [b""])
        with subtests.test(case=(encoding, schema)), pytest.raises(LogError, match=text):
            read(path, "/topic.x")


def test_times_beyond_63_bits_are_refused(tmp_path):
    """In the record, which has 64 bits, and in a message."""
    path = write_json(tmp_path / "log.mcap", {"/t": [(2**63, {"x": 1, "s": 1e30})]})
    with pytest.raises(LogError, match=r"message 1: .*got 9223372036854775808 ns"):
        read(path, "/t.x")
    with pytest.raises(LogError, match=r"'/t.s', message 1: .*a time, got"):
        read(path, "/t.x", time="s")
    with pytest.raises(LogError, match=r"'/t.z', message 1: .*a time, got missing"):
        read(path, "/t.x", time="z")


def test_a_topic_without_messages_is_refused(tmp_path):
    """There is nothing to take."""
    path = raw_file(tmp_path, "json", None, [])
    with pytest.raises(LogError, match="topic '/topic' has no messages"):
        read(path, "/topic.x")


def test_no_more_numbers_are_kept_than_memory_has(tmp_path, monkeypatch):
    """A limit on what is kept, whatever the size of the file."""
    monkeypatch.setattr("cosim.log.foreign.samples.MOST_NUMBERS", 20)
    path = write_json(tmp_path / "log.mcap", {"/t": [(i, {"x": [1] * 5}) for i in range(9)]})
    with pytest.raises(LogError, match="more than 20 numbers in 1 topics"):
        read(path, "/t.x")


def test_a_summary_that_contradicts_the_data_is_refused(tmp_path):
    """Where it lists another schema."""
    path = raw_file(tmp_path, "json", ("one", "jsonschema", b"{}"), [b'{"x": 1}'])
    data = path.read_bytes()
    place = data.rindex(b"one")
    changed = data[:place] + b"two" + data[place + 3 :]
    footer = len(changed) - 8 - 4
    path.write_bytes(changed[:footer] + bytes(4) + changed[footer + 4 :])  # without a CRC
    with pytest.raises(LogError, match="is damaged: schema 1 is defined twice"):
        read(path, "/topic.x")


# --- damaged, or made to do harm ---


def chunk_start(data):
    """Return where the content of the first chunk begins."""
    position = 8
    while data[position] != 6:
        position += 9 + int.from_bytes(data[position + 1 : position + 9], "little")
    return position + 9


def put(shift, content):
    """Return what writes something into the first chunk."""

    def change(data):
        begin = chunk_start(data) + shift
        data[begin : begin + len(content)] = content

    return change


def flip(place):
    """Return what flips a bit behind the start of the first chunk, or before the end."""

    def change(data):
        data[place if place < 0 else chunk_start(data) + place] ^= 1

    return change


def cut(data):
    del data[chunk_start(data) + 300 :]


def alter_value(data):
    data[data.index(b'"x": 1') + 5] = ord("2")


@pytest.mark.parametrize(
    ("change", "options", "text"),
    [
        (put(16, (2**40).to_bytes(8, "little")), {}, r"1099511627776 bytes .*67108864"),  # a bomb
        (put(16, (100).to_bytes(8, "little")), {}, r"byte \d+: a chunk declares 100 bytes"),
        (put(32, b"brot"), {}, "compression: expected zstd, lz4 or none, got 'brot'"),
        *((flip(300), {"compression": c}, r"damaged at byte \d+") for c in COMPRESSIONS.values()),
        (flip(-60), {}, r"is damaged at byte \d+"),  # the summary
        (cut, {}, r"is truncated.*'mcap recover'"),
        (
            alter_value,
            {"use_chunking": False, "enable_data_crcs": True},
            "the CRC of the data does not match",
        ),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, options, text):
    """Before a byte more than declared is decompressed."""
    rows = [(EPOCH + index, {"x": 1000 + index}) for index in range(COUNT)]
    # without an index of chunks, with which they are compared first
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, index_types=IndexType.NONE, **options)
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)
    with pytest.raises(LogError, match=text):
        read(path, "/t.x")


def test_files_that_are_no_mcap_are_refused(tmp_path):
    """With what they are."""
    path = tmp_path / "x.mcap"
    for content, text in [
        (b"", "is empty; expected an MCAP file"),
        (b"t,y\n0,1\n", "is not an MCAP file: expected (?!.*t,y)"),
        (b"\x89MCAP0\r\n", "is truncated at byte 8: .*no complete row"),
    ]:
        path.write_bytes(content)
        with pytest.raises(LogError, match=rf"x\.mcap {text}"):
            read(path, "/t.x")


def test_a_large_message_is_refused(tmp_path, monkeypatch):
    """Outside of chunks, where a length may say anything."""
    monkeypatch.setattr("cosim.log.container.MOST_BYTES", 1000)
    rows = [(EPOCH, {"x": 1, "text": "x" * 2000})]
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, use_chunking=False)
    with pytest.raises(LogError, match=r"a record of \d+ bytes .*1000"):
        read(path, "/t.x")


def test_only_the_asked_topics_are_decoded(tmp_path):
    """What stands in the others does not matter."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        for topic, encoding, data in (("/a", "json", b'{"x": 1}'), ("/a.b", "cbor", b"\xff")):
            channel = writer.register_channel(topic, encoding, 0)
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    assert read(path, "/a.x")[0].values.tolist() == [[1.0]]


# --- times within messages ---


def test_a_time_is_the_nearest_ns_of_its_number():
    """Though no float64 has as many digits as a time of today in ns."""
    for unit_ns in (1, 1000, 10**6, NANOSECONDS):
        random = np.random.default_rng(unit_ns)
        # one rounding of a product below the unit, and one to whole ns
        bound = Fraction(1, 2) + Fraction(unit_ns, 2**53)
        for value in random.uniform(0.0, 4e18 / unit_ns, 500).tolist():
            distance = abs(nanoseconds_in(value, unit_ns) - Fraction(value) * unit_ns)
            assert distance <= bound, (value, unit_ns)
    assert nanoseconds_in(1_700_000_000.0625, NANOSECONDS) == 1_700_000_000_062_500_000
    assert nanoseconds_in(-1.5, NANOSECONDS) == -1_500_000_000
    later = math.nextafter(2.2e9, math.inf)
    between = nanoseconds_in(later, NANOSECONDS) - nanoseconds_in(2.2e9, NANOSECONDS)
    assert between == round(Fraction(math.ulp(2.2e9)) * NANOSECONDS)


def test_values_that_are_no_time_are_refused():
    """Or are beyond the year 2262."""
    for value in (math.nan, math.inf, 1e10, True, "1.5", None):
        with pytest.raises(FieldProblem, match="expected a time, got"):
            nanoseconds_in(value, NANOSECONDS)
