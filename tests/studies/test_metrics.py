"""Metrics against numpy over the same rows and closed forms; what is none is refused."""

import math
import re
import tomllib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.core.contracts import Block
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Interface, Signal
from cosim.core.structure.ports import layout_of
from cosim.errors import UsageError
from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import KINDS, parse_metrics

STEP_NS = 10**6
SIGNALS = {
    "plant": (Signal("y"), Signal("u"), Signal("gap", optional=True), Signal("v", 2)),
    "my-part": (Signal("der(x)"),),
    "slow": (Signal("y"),),
}
PARTS = {name: SimpleNamespace(interface=Interface((), of)) for name, of in SIGNALS.items()}
PLAN = Plan(layout_of(PARTS, {"slow": 4}), STEP_NS, {}, {}, ())
COLUMNS = ("y", "u", "gap", "v0", "v1", "part", "slow")


def columns(**values):
    """Return rows with these values; all else is 0."""
    rows = np.zeros((len(next(iter(values.values()))), len(COLUMNS)))
    for name, column in values.items():
        rows[:, COLUMNS.index(name)] = column
    return rows


def write(recorder, rows, sizes=()):
    """Write rows of a run in blocks of some steps, and the rest in one."""
    recorder.begin(PLAN)
    ends = np.minimum(np.cumsum([0, *sizes, len(rows)]), len(rows) - 1).tolist()
    for index, end in pairwise(dict.fromkeys(ends) if len(rows) > 1 else (0, 0)):
        time_ns = np.arange(index, end + 1) * STEP_NS
        block = Block(index, time_ns, time_ns / 1e9, STEP_NS / 1e9)
        recorder.write(block, rows[index : end + 1].copy())
    return recorder


def value(text, rows):
    """Return the value of one metric."""
    return write(MetricRecorder(parse_metrics({"m": text})), rows).values()["m"]


numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
rows_of = st.lists(
    st.tuples(st.one_of(numbers, st.just(math.nan)), numbers), min_size=1, max_size=300
)
ALL = (
    *("last(plant.gap)", "initial(plant.gap)", "max(plant.gap)", "min(plant.gap, plant.u > 0)"),
    *("mean(plant.gap)", "rms(plant.gap - plant.u, plant.u >= 0)", "std(plant.gap)"),
    *("integral(plant.gap)", "count(plant.gap, plant.u > 0)", "share(plant.gap > 0 for 1 ms)"),
    *("first(t, plant.gap > 0 for 2 ms)", "settling(plant.gap)", "overshoot(plant.gap)"),
    "settling(plant.gap, 0.1*max(abs(plant.gap)), plant.u > 0)",
    *("mean(slow.y)", "integral(slow.y - plant.u)"),
    "max(last(t), 2.0) - sqrt(abs(mean(plant.u)))**2/3",
)


def bits(values):
    return [None if v is None else v.hex() for v in values.values()]


@given(rows_of, st.lists(st.integers(1, 150), max_size=10))
@settings(max_examples=40)
def test_values_have_the_same_bits_however_the_run_is_cut(pairs, sizes):
    """And are those of the recorded run; a recorder takes one run after the other."""
    gap, u = np.array(pairs).T
    rows = columns(gap=gap, u=u, slow=u + 1.0)
    metrics = parse_metrics({text: text for text in ALL})
    recorder = MetricRecorder(metrics)
    whole = bits(write(recorder, rows).values())
    assert bits(write(recorder, rows, sizes).values()) == whole
    assert bits(write(recorder, rows, [1] * len(rows)).values()) == whole
    assert bits(metrics.of(write(Memory(), rows))) == whole


REFERENCES = {"last": lambda x: x[-1], "max": np.max, "min": np.min, "mean": np.mean, "count": len}
REFERENCES |= {"rms": lambda x: np.sqrt(np.mean(x * x)), "std": np.std}


@given(rows_of)
@settings(max_examples=40)
def test_a_reduction_is_that_of_the_rows_that_have_a_value(pairs):
    """Where the condition is true; numpy's pairwise sums differ by n roundings of 1e3 at most.

    A mean of squares, which does not cancel, by n 2^-52 of itself; that of differences to the first
    value is up to n + 1 times the variance, which loses as much more.
    """
    gap, u = np.array(pairs).T
    rows = columns(gap=gap, u=u)
    chosen = gap[~np.isnan(gap) & (u > 0)]
    n = len(chosen)
    for name, reference in REFERENCES.items():
        needed = 0.0 if name == "count" else None
        if n:
            relative = {"rms": n, "std": n * (n + 1)}.get(name, 0) * 2.0**-52
            absolute = 1e3 * n * 2.0**-52 if name in ("mean", "std") else 0.0
            needed = pytest.approx(reference(chosen), abs=absolute, rel=relative)
        assert value(f"{name}(plant.gap, plant.u > 0)", rows) == needed, name


def test_settling_is_where_a_lag_comes_within_its_band():
    """y = 1 - exp(-t/T): |y - y_end| <= b at t = -T ln(b + exp(-t_end/T)), rounded up to a row."""
    t = np.arange(10_001) * STEP_NS / 1e9
    rows = columns(y=5.0 + 3.0 * (1.0 - np.exp(-t / 0.7)))
    end = math.exp(-10.0 / 0.7)
    bands = {"": 0.02 * (1.0 - end), ", 0.3": 0.1, ", 0.1*(last(plant.y) - 5)": 0.1 * (1.0 - end)}
    for written, band in bands.items():
        instant = math.ceil(-0.7 * math.log(band + end) * 1e3) / 1e3
        assert value(f"settling(plant.y{written})", rows) == instant
    assert value("settling(plant.y, 0.3, t >= 6) - first(t, t >= 6)", rows) == 0.0
    assert value("settling(plant.y, 0 - max(plant.y))", rows) is None


# of texts over rows that are given by their columns
Y = np.array([0, 1, 1, 0, 1, 1, 1, 1, 0], float)
GAP = [1.0, 3.0, math.nan, 5.0, 7.0, 100.0]
RAMP = {"y": np.arange(9.0), "slow": 10.0 * np.arange(9.0)}
NONE = {"y": [0.0, 2.0], "gap": [math.nan] * 2}
NAMED = {"v0": [1.0, 4.0], "v1": [2.0, 3.0], "part": [5.0, -9.0]}
INFINITE = "(1e308 * 10) * (t - 0.0015)"  # of either sign, of which there is no sum
VALUES = [
    # integrals are between rows that follow each other
    ({"gap": GAP}, "integral(plant.gap)", pytest.approx(61.5e-3, rel=1e-15)),
    ({"gap": GAP}, "integral(plant.gap, plant.gap < 50)", pytest.approx(8e-3, rel=1e-15)),
    ({"gap": GAP}, f"integral({INFINITE}, t >= 0.001 and t < 0.0025)", None),
    # a duration is that of its condition
    ({"y": Y}, "first(t, plant.y > 0 for 1 ms)", 0.002),
    ({"y": Y}, "first(t, (plant.y > 0) for 0.002)", 0.006),
    ({"y": Y}, "first(t, not plant.y <= 0 for 1500 us)", 0.006),
    ({"y": Y}, "share(plant.y > 0 for 1 ms, t > 0.004 for 2 ms)", 1 / 2),
    # components of several rates have the rows that all have
    (RAMP, "count(slow.y)", 3.0),
    (RAMP, "max(plant.y, slow.y < 50)", 4.0),
    # what is made of no values, or infinite, is none
    (NONE, "1 + max(last(plant.gap), 2)", None),
    (NONE, "count(plant.gap)", 0.0),
    (NONE, "share(plant.gap > 0, plant.y > 5)", None),
    (NONE, "settling(plant.y, last(plant.gap))", None),
    # an overshoot is a share of the change, up and down
    ({"y": [1.0, 4.0, 3.0]}, "overshoot(plant.y)", 0.5),
    ({"y": [1.0, 4.0, 3.0]}, "overshoot(7 - 3*plant.y)", 0.5),
    ({"y": [1.0, 4.0, 3.0]}, "overshoot(plant.u)", None),
    # names in quotes, elements and arithmetic
    (NAMED, "last(plant.v[0]) - last('plant.v[1]')", 1.0),
    (NAMED, "max(abs('my-part.der(x)'))", 9.0),
    (NAMED, "max(max(plant.v[1]), min(plant.v[0]))", 3.0),
    (NAMED, "-sqrt(last(plant.v[0]))**3/2 + pi", math.pi - 4.0),
    (NAMED, "max(\n  plant.v[0],\n  t > 0 for 1 ms\n)", None),
]


def test_metrics_have_the_values_of_their_definition():
    for rows, text, needed in VALUES:
        assert value(text, columns(**rows)) == needed, text


REFUSED = {
    "": r"'': not a metric.*rms\(observer\.delta - delta\.y\)",
    "3 + pi": r"at least one reduction.*last\(plant\.y\)",
    "plant.y": r"last\(plant\.y\), got 'plant\.y'",
    "plant.y < 1": r"share\(plant\.y < 1\), got the condition 'plant\.y < 1'",
    "max(plant.y, plant.u)": r"'max\(plant\.y, plant\.u\)'.*max\(max\(plant\.y, plant\.u\)\)",
    "rsm(plant.y)": r"'rsm'; did you mean 'rms'\?",
    "rms(plant.y > 1)": r"rms\(EXPRESSION\) or.*got 'rms\(plant\.y > 1\)'",
    "initial(plant.y, t > 1)": r"initial\(EXPRESSION\) or first\(EXPRESSION, CONDITION\)",
    "settling(plant.y, -1)": r"band >= 0, got '-1'",
    "first(t, plant.y > last(plant.y))": r"inside first\(\.\.\.\), got 'last\(plant\.y\)'",
    "rms(plant.y, x=3)": r"'rms\(plant\.y, x=3\)'.*: numbers, pi, e, reductions such as",
    "first(t, plant.y > 1 for 1 parsec)": "'1 parsec'.*'for'.*'parsec'",
    "first(t for 1 s, plant.y > 1)": r"'for' after a condition.*first\(t, plant\.y < 1 for 1 s\)",
    "first(t, plant.y > 1 for 1 s and plant.u > 1)": r"'1 s and plant\.u > 1'.*'for'",
    "+".join(["last(plant.y)"] * 2000): "nested too deeply",
}


def test_a_text_that_is_no_metric_is_refused():
    """With what was found and what is possible instead; all problems in one report."""
    with pytest.raises(UsageError) as error:
        parse_metrics({**{text or "empty": text for text in REFUSED}, "good": "last(t)", "d": 3})
    *lines, last = str(error.value).splitlines()
    assert re.fullmatch(r"metrics\.d: .*got 3", last)
    for line, (text, pattern) in zip(lines, REFUSED.items(), strict=True):
        assert line.startswith(f"metrics.{text or 'empty'}: ")
        assert re.search(pattern, line.removeprefix(f"metrics.{text}: ")), (line[:150], pattern)


def test_all_signals_that_are_not_there_are_named():
    """With the nearest, and of a signal with several elements these."""
    texts = {"a": "rms(plnt.y - plant.yy) + last(plant.y)", "b": "max(plant.v)"}
    with pytest.raises(UsageError) as error:
        parse_metrics(texts).check(PLAN.channels)
    needed = (
        r"metrics\.a: .*component 'plnt'; did you mean 'plant'\?.*",
        r"metrics\.a: the run has no 'plant\.yy': 'plant' has no signal 'yy'; .*",
        r"metrics\.b: 'plant\.v' has 2 elements; expected one of: plant\.v\[0\], plant\.v\[1\]",
    )
    assert re.fullmatch("\n".join(needed), str(error.value))


def test_the_document_shows_every_reduction_as_it_is_written():
    """Its table, and its example, are metrics."""
    document = Path(cosim.__file__).parents[1] / ".readme" / "metrics.md"
    text = document.read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    shown = re.findall("`([^`]+)`", "".join(rows))
    metrics = parse_metrics({metric: metric for metric in shown})
    assert {name.partition("(")[0] for name in metrics.names} == set(KINDS)
    example = tomllib.loads(text.partition("```toml")[2].partition("```")[0])
    assert len(parse_metrics(example["metrics"]).names) == 4
