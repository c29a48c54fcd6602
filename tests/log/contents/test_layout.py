"""Names, schemas, records and metadata of a component's channels."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import GraphError
from cosim.log.layout import (
    blank_records,
    copy_columns,
    group_columns,
    read_part,
    record_dtype,
    signals_json,
    split_channel,
)
from cosim.log.messages import component_schema
from cosim.log.metadata import add_checksum
from cosim.units import BASE, BaseUnit
from tests.log.crafting import without_checksum
from tests.log.decoding import message_class
from tests.log.recordings import layout, same_bits

MESSAGE_HEADER = 31  # bytes before the protobuf message


def test_records_are_protobuf_at_every_width_of_tags(subtests):
    """Stock protobuf finds the values, and they come back from the records bit for bit."""
    for size in (0, 1, 15, 16, 2047, 2048, 4096):
        values = np.random.default_rng(1).normal(size=(3, size))
        records = blank_records(7, size, 3)
        for group, columns in group_columns(size).items():
            records[group]["value"] = values[:, columns]
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
    assert signals_json(Interface((Signal("u"),))) == f'[{{"causality":"input",{plain}}}]'
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
