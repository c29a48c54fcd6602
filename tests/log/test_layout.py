"""Names, schemas, records and metadata of a component's channels."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, json_format
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import GraphError
from cosim.log import Log
from cosim.log.layout import (
    blank_records,
    copy_columns,
    fill_values,
    read_part,
    record_dtype,
    signals_json,
    split_channel,
)
from cosim.log.messages import component_schema, identifiers, message_paths
from cosim.log.metadata import add_checksum
from cosim.log.preamble import parts_of
from cosim.units import BASE, BaseUnit
from tests.log.crafting import without_checksum
from tests.log.decoding import message_class
from tests.log.recordings import layout, record, same_bits
from tests.log.viewing import decoded, parsed

MESSAGE_HEADER = 31  # bytes before the protobuf message


def test_records_are_protobuf_at_every_width_of_tags(subtests):
    """Stock protobuf finds the values, and they come back from the records bit for bit."""
    for size in (0, 1, 15, 16, 2047, 2048, 4096):
        values = np.random.default_rng(1).normal(size=(3, size))
        records = blank_records(7, size, 3)
        fill_values(records, values)
        fields = [f"v{i}" for i in range(size)]
        kind = message_class("cosim.m", component_schema("m", fields))
        data = records[1].tobytes()
        message = kind.FromString(data[MESSAGE_HEADER:])
        copied = np.empty_like(values)
        copy_columns(records, copied, size=size, columns=slice(0, size))
        with subtests.test(case=size):
            assert struct.unpack_from("<BQH", data) == (5, len(data) - 9, 7)
            assert [getattr(message, field) for field in fields] == list(values[1])
            assert same_bits(copied, values)


def test_records_with_other_fields_are_refused():
    """Messages of the right size are checked for their tags too."""
    records = blank_records(1, 3, 2)
    records["short"]["tag"][1, 0, 0] = 0x11
    with pytest.raises(ValueError, match="fields of the messages differ"):
        copy_columns(records, np.empty((2, 3)), size=3, columns=slice(0, 3))


bases = st.builds(
    BaseUnit,
    st.tuples(*[st.integers(-3, 3)] * len(BASE)),
    st.floats(1e-9, 1e9),
    st.floats(-1e3, 1e3),
)


plain = st.builds(
    Signal,
    name=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8),
    size=st.integers(1, 5000),
    unit=st.none() | st.text(max_size=3),
    variability=st.sampled_from(["continuous", "discrete"]),
    optional=st.booleans(),
    type=st.sampled_from(["real", "integer", "boolean"]),
    role=st.sampled_from(["input", "output", "state", "estimate"]),
    base=st.none() | bases,
    connection=st.sampled_from(["required", "optional", "forbidden"]),
    first=st.integers(0, 9),
)


numbers = st.floats(allow_nan=False)


signals = plain | st.builds(
    lambda signal, x: replace(signal, start=(x,) * signal.size), plain, numbers
)


@st.composite
def channels(draw):
    """Draw any component with at least one signal."""
    lists = st.lists(signals, min_size=1, max_size=5, unique_by=lambda signal: signal.name)
    drawn = tuple(draw(lists))
    cut = draw(st.integers(0, len(drawn)))
    inputs = drawn[:cut]
    outputs = drawn[cut:]
    input_names = st.just(())
    if inputs:
        input_names = st.lists(st.sampled_from([s.name for s in inputs]), unique=True).map(tuple)
    dependencies = st.fixed_dictionaries(
        {}, optional={signal.name: st.none() | input_names for signal in outputs}
    )
    interface = Interface(inputs, outputs, draw(dependencies), draw(dependencies))
    name = draw(st.text(st.characters(exclude_characters="."), min_size=1, max_size=5))
    start = draw(st.integers(0, 9))
    period = draw(st.integers(1, 1000))
    return Channel(name, interface, start, period)


@settings(max_examples=30)
@given(channels(), st.integers(1, 10**12))
def test_metadata_describe_the_whole_component(channel, step_ns):
    """Every part of a component knows the whole component, and the parts tile its row."""
    elements = []
    for part in split_channel(channel, kind="some", step_ns=step_ns):
        back = read_part(part.metadata)
        assert (back.channel, back.kind, back.step_ns) == (channel, "some", step_ns)
        assert record_dtype(back.size).itemsize <= MESSAGE_HEADER + 11 * 4096
        elements += back.elements
    declared = []
    for signal in channel.signals:
        declared += signal.elements
    assert elements == declared


def test_a_declaration_has_defaults_only_of_the_first_fields():
    """The text that the hash covers stays what the first logs have, until a new field is used."""
    plain = '"name":"u","size":1,"unit":null,"variability":"continuous","optional":false,'
    plain += '"type":"real","role":"output"'
    for signal in (Signal("u"), Signal("u", description="force")):
        assert signals_json(Interface((signal,))) == f'[{{"causality":"input",{plain}}}]'
    driven = Signal("u", start=(1.0,), connection="optional", first=1)
    added = '"start":[1.0],"connection":"optional","first":1'
    assert signals_json(Interface((driven,))) == f'[{{"causality":"input",{plain},{added}}}]'


def test_elements_of_one_unit_are_declared_as_before():
    """One text; others have a list, and its definitions another, and are read back."""
    one = Signal("u", 2, unit=("m", "m"), base=(None, None))
    assert signals_json(Interface((one,))) == signals_json(Interface((Signal("u", 2, unit="m"),)))
    foot = BaseUnit((0, 1, 0, 0, 0, 0, 0, 0), 0.3048)
    two = Channel("c", Interface((), (Signal("y", 2, ("ft", "s"), base=(foot, None)),)), 0)
    (part,) = split_channel(two, kind="", step_ns=1)
    assert json.loads(part.metadata["cosim.signals"])[0]["unit"] == ["ft", "s"]
    assert read_part(part.metadata).channel == two


def test_a_declaration_of_anything_else_is_refused(subtests):
    """Every field that is read has the type and one of the values that a signal may have."""
    (part,) = split_channel(layout()["plant"], kind="", step_ns=1)
    for name, value in [
        ("name", ""),
        ("size", 0),
        ("size", 2**63),
        ("unit", 5),
        ("unit", ["m", "s", "m", "s"]),
        ("base", [{"exponents": [0] * len(BASE)}, None, None, None]),
        ("variability", 5),
        ("optional", 1),
        ("type", "text"),
        ("role", None),
        ("base", {"exponents": [1], "factor": 1.0, "offset": 0.0}),
        ("base", {"exponents": [0.5] * len(BASE), "factor": 1.0, "offset": 0.0}),
        ("start", {}),
        ("start", ["1"]),
        ("start", [True]),
        ("connection", 5),
        ("first", "x"),
        ("first", -1),
    ]:
        items = without_checksum(part.metadata)
        signals = json.loads(items["cosim.signals"])
        signals[-1][name] = value
        items["cosim.signals"] = json.dumps(signals)
        match = "exponent" if name == "base" else name
        with (
            subtests.test(case=(name, value)),
            pytest.raises((GraphError, ValueError), match=match),
        ):
            read_part(add_checksum("cosim.channel", items))


def test_a_changed_channel_is_noticed():
    """Metadata of a channel carries a checksum."""
    (part,) = split_channel(layout()["plant"], kind="", step_ns=1)
    with pytest.raises(ValueError, match="damaged"):
        read_part({**part.metadata, "cosim.start": "1"})


NASTY = [*"der(x) der_x x[1] x_1 x1 a_b aB AB 1x _ π θ̂ class None message x.y".split(), "", "x y"]  # noqa: SIM905


names = st.lists(st.one_of(st.sampled_from(NASTY), st.text(max_size=6)), unique=True, max_size=12)


def test_legal_names_are_kept_and_the_others_stay_readable():
    """What reads well keeps its name."""
    assert identifiers(["x[0]", "x_a", "delta", "der(x)", "x_0"]) == [
        "x_0_2",
        "x_a",
        "delta",
        "der_x",
        "x_0",
    ]


@given(names)
def test_any_names_make_a_schema_that_protobuf_takes(signal_names):
    """Each has an identifier of its own, also in JSON; stock protobuf decodes the records."""
    made = identifiers(signal_names)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in made)
    assert len({name.replace("_", "").lower() for name in made}) == len(signal_names)
    size = len(signal_names)
    values = np.arange(1.0, size + 1)
    kind = message_class("cosim.m", component_schema("m", signal_names))
    records = blank_records(1, size, 1)
    fill_values(records, values[np.newaxis])
    message = kind.FromString(records.tobytes()[MESSAGE_HEADER:])
    decoded = [getattr(message, field.name) for field in kind.DESCRIPTOR.fields]
    assert decoded == list(values)
    assert len(json_format.MessageToDict(message)) == size


INTERFACE = Interface(
    (Signal("u", unit="N", role="input", description="force on the mass"),),
    (
        Signal("x", 3, unit="m", role="state", description="positions"),
        Signal("der(x)", unit="m/s"),
        Signal("on", type="boolean", variability="discrete"),
    ),
)


def schemas_of(channel, kind=""):
    """Return the FileDescriptorSet of every part of a channel."""
    return [data for _, (_, data) in parts_of([channel], {channel.name: kind}, 1)]


def comments(data):
    """Return the comments of a FileDescriptorSet by path, and its one message."""
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(data).file
    found = {}
    for location in file.source_code_info.location:
        assert len(location.span) in (3, 4)  # as descriptor.proto demands
        found[tuple(location.path)] = location.leading_comments
    return found, file.message_type[0]


def test_every_field_has_a_comment_with_name_unit_role_and_description():
    """The paths are those of descriptor.proto: 4 a message of the file, 2 a field of it."""
    (schema,) = schemas_of(Channel("plant", INTERFACE, 0), "descriptor")
    found, message = comments(schema)
    assert found == {
        (4, 0): " plant, descriptor\n",
        (4, 0, 2, 0): " u [N], input: force on the mass\n",
        (4, 0, 2, 1): " x[0] [m], state: positions\n",
        (4, 0, 2, 2): " x[1] [m], state\n",
        (4, 0, 2, 3): " x[2] [m], state\n",
        (4, 0, 2, 4): " der(x) [m/s], output\n",
        (4, 0, 2, 5): " on, output, boolean\n",
    }
    assert [field.name for field in message.field] == ["u", "x_0", "x_1", "x_2", "der_x", "on"]


def test_parts_of_a_wide_component_have_the_comments_of_their_own_elements():
    """The second part begins inside a signal."""
    odd = Signal("u", description="a\ud800b")  # a text of protobuf cannot have it
    wide = Interface((odd,), (Signal("y", 5000, unit="K", description="temperatures"),))
    (first, _), (second, _) = map(comments, schemas_of(Channel("wide", wide, 0)))
    assert first[4, 0, 2, 0] == " u, input: a?b\n"
    assert first[4, 0, 2, 1] == " y[0] [K], output: temperatures\n"
    assert second[4, 0, 2, 0] == " y[4095] [K], output\n"
    assert len(first) + len(second) == 2 + 5001


def test_the_stock_decoder_reads_a_log_with_comments(tmp_path):
    """That of mcap-protobuf-support, bit for bit; the log gives the descriptions back."""
    rows = record(tmp_path / "a.mcap", steps=20, lay=Layout((Channel("plant", INTERFACE, 0),)))
    decoded = []
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, _, _, message in reader.iter_decoded_messages("/plant"):
            assert schema.name == "cosim.plant"
            names = [field.name for field in message.DESCRIPTOR.fields]
            decoded.append([getattr(message, name) for name in names])
    assert same_bits(np.array(decoded), rows)
    signals = Log(tmp_path / "a.mcap").channels["plant"].signals
    texts = [signal.description for signal in signals]
    assert texts == ["force on the mass", "positions", "", ""]


def test_descriptions_that_are_no_texts_are_refused(subtests):
    """As any other damage of the metadata."""
    (part,) = split_channel(Channel("plant", INTERFACE, 0), kind="", step_ns=1)
    for text in ('{"u": 5}', '["u"]', '{"u": null}'):
        items = {**without_checksum(part.metadata), "cosim.descriptions": text}
        with (
            subtests.test(case=text),
            pytest.raises(Exception, match=r"description|expected a table"),
        ):
            read_part(add_checksum("cosim.channel", items))


def test_a_message_path_leads_to_the_column_of_its_element(tmp_path):
    """Whatever the names of components and signals, and where a component is split."""
    outputs = (Signal("x[1]"), Signal("x_1"), Signal("x", 2), Signal("der(x)"))
    wide = Interface((Signal("π"),), (Signal("y", 4100),))
    first = Channel('odd "name" \\', Interface((), outputs), 0)
    second = Channel("wide-2", wide, first.columns.stop)
    rows = record(tmp_path / "a.mcap", steps=40, size=7, lay=Layout((first, second)))
    values = decoded(tmp_path / "a.mcap")
    paths = message_paths(first) + message_paths(second)
    assert len(set(paths)) == rows.shape[1]
    for column in (*range(8), 4000, 4097, 4103, 4104):
        found = np.array(values[parsed(paths[column])])
        assert found.tobytes() == rows[:, column].tobytes()
