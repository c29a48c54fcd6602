"""What is no metric is refused, with the way out."""

import re
import tomllib
from pathlib import Path

import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.metrics import KINDS, parse_metrics
from tests.studies.metrics.rows import CHANNELS

REFUSED = {
    "rms(": r"'rms\(': not a metric",
    "": r"'': not a metric.*rms\(observer\.delta - delta\.y\)",
    "3 + pi": r"at least one reduction.*last\(plant\.y\)",
    "plant.y": r"last\(plant\.y\), got 'plant\.y'",
    "t": r"last\(t\), got 't'",
    "last(plant.y) + plant.v[0]": r"got 'plant\.v\[0\]'",
    "1 + 'plant.y'": "'plant.y'",
    "plant.y < 1": r"share\(plant\.y < 1\), got the condition 'plant\.y < 1'",
    "max(plant.y, plant.u)": r"'max\(plant\.y, plant\.u\)'.*max\(max\(plant\.y, plant\.u\)\)",
    "min(abs(plant.y), last(plant.u))": r"two reductions.* min",
    "rsm(plant.y)": r"'rsm'; did you mean 'rms'\?",
    "max()": r"max\(EXPRESSION\), or max\(EXPRESSION, CONDITION\), got 'max\(\)'",
    "max(1, 2, 3)": r"max\(EXPRESSION\), or.*got 'max\(1, 2, 3\)'",
    "rms(plant.y, plant.u)": r"rms\(EXPRESSION\), or.*got 'rms\(plant\.y, plant\.u\)'",
    "rms(plant.y > 1)": r"rms\(EXPRESSION\), or.*got 'rms\(plant\.y > 1\)'",
    "share(plant.y)": r"share\(CONDITION\), or share\(CONDITION, CONDITION\)",
    "first(t)": r"first\(EXPRESSION, CONDITION\), got 'first\(t\)'",
    "first(t, 1)": r"first\(EXPRESSION, CONDITION\), got 'first\(t, 1\)'",
    "initial(plant.y, t > 1)": r"initial\(EXPRESSION\), or first\(EXPRESSION, CONDITION\)",
    "settling(plant.y, 1, 2)": r"settling\(EXPRESSION\), settling\(EXPRESSION, BAND\), or",
    "settling(plant.y, -1)": r"band >= 0, got '-1'",
    "settling(plant.y, plant.u)": r"got 'plant\.u'",
    "rms(last(plant.y))": r"inside rms\(\.\.\.\), got 'last\(plant\.y\)'",
    "max(max(plant.y))": r"inside max\(\.\.\.\), got 'max\(plant\.y\)'",
    "first(t, plant.y > last(plant.y))": r"inside first\(\.\.\.\), got 'last\(plant\.y\)'",
    "last(plant.y) > 1": r"a number, got the condition 'last\(plant\.y\) > 1'",
    "rms(plnt)": "'plnt': .*'plnt'",
    "rms(plant.y; 3)": "not a metric at column",
    "rms(plant.y, x=3)": r"'rms\(plant\.y, x=3\)'.*: numbers, pi, e, reductions such as",
    "[last(plant.y)]": r"'\[last\(plant\.y\)\]'.*allowed: numbers",
    "last(plant.y)[0]": r"'last\(plant\.y\)\[0\]'",
    "last(plant.y) + True": "True",
    "sqrt(last(plant.y), 2)": "sqrt.*2 arguments",
    "first(t, plant.y > 1 for 1 parsec)": "'1 parsec'.*'for'.*'parsec'",
    "first(t, plant.y > 1 for )": "''.*'for'",
    "first(t for 1 s, plant.y > 1)": r"'for' after a condition.*first\(t, plant\.y < 1 for 1 s\)",
    "last(plant.y) for 1 s": "'for' after a condition",
    "first(t, (plant.y > 1 for 1 s) and plant.u > 1)": "'for' after a condition",
    "first(t, plant.y > 1 for 1 s and plant.u > 1)": r"'1 s and plant\.u > 1'.*'for'",
    "+".join(["last(plant.y)"] * 2000): "nested too deeply",
}


def test_a_text_that_is_no_metric_is_refused():
    """With what was found and what is possible instead; the message begins with its name."""
    wrong = []
    for text, pattern in REFUSED.items():
        with pytest.raises(UsageError) as error:
            parse_metrics({"size": text})
        if not re.match(rf"metrics\.size: .*{pattern}", str(error.value)):
            wrong.append((text[:40], str(error.value)))
    assert wrong == []


def test_all_problems_of_all_metrics_come_in_one_report():
    """A line each; those of other metrics are not hidden by the first."""
    with pytest.raises(UsageError) as error:
        parse_metrics({"a": "plant.y", "b": "last(plant.y)", "c": "rms(", "": "last(t)", "d": 3})
    lines = str(error.value).splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        *("metrics.a", "metrics.c", "metrics.", "metrics.d")
    ]
    assert lines[2].startswith("metrics.: ")
    assert re.match(r"metrics\.d: .*got 3$", lines[3])


def test_all_signals_that_are_not_there_are_named():
    """With the nearest, and of a signal with several elements these."""
    metrics = parse_metrics(
        {
            "a": "rms(plnt.y - plant.yy) + last(plant.y)",
            "b": "max(plant.v)",
            "c": "first(t, plant.v[0:2] > 0)",
            "d": "last(plant.v[2])",
        }
    )
    with pytest.raises(UsageError) as error:
        metrics.check(CHANNELS)
    lines = str(error.value).splitlines()
    assert re.match(r"metrics\.a: .*component 'plnt'; did you mean 'plant'\?", lines[0])
    assert lines[1].startswith("metrics.a: the run has no 'plant.yy': 'plant' has no signal 'yy'; ")
    listed = "has 2 elements; expected one of: plant.v[0], plant.v[1]"
    assert lines[2] == f"metrics.b: 'plant.v' {listed}"
    assert lines[3] == f"metrics.c: 'plant.v[0:2]' {listed}"
    assert lines[4].startswith("metrics.d: the run: 'plant.v[2]'")
    assert len(lines) == 5
    assert metrics.names == ("a", "b", "c", "d")
    assert metrics.signals == (
        *("plnt.y", "plant.yy", "plant.y", "plant.v", "plant.v[0:2]", "plant.v[2]"),
    )


DOCUMENT = Path(cosim.__file__).parents[1] / ".readme" / "metrics.md"


def test_the_document_shows_every_reduction_as_it_is_written():
    """Its table, and its example, are metrics."""
    text = DOCUMENT.read_text(encoding="utf-8")
    shown = []
    for line in text.splitlines():
        if line.startswith("| `"):
            shown += re.findall("`([^`]+)`", line.split("|")[1])
    metrics = parse_metrics({metric: metric for metric in shown})
    assert {name.partition("(")[0] for name in metrics.names} == set(KINDS)
    words = re.sub("```.*?```", "", text, flags=re.DOTALL)
    others = [part for part in re.findall("`([^`]+)`", words) if re.match(r"[a-z]+\(.*[.)]", part)]
    assert len(others) > len(shown)
    functions = ("sqrt(", "min(a, b)", "max(a, b)")
    parse_metrics({t: t.replace("C", "t > 1") for t in others if not t.startswith(functions)})
    example = tomllib.loads(text.partition("```toml")[2].partition("```")[0])
    assert len(parse_metrics(example["metrics"]).names) == 4
