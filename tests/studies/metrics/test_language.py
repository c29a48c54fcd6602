"""What is no metric is refused, with the way out."""

import re
import tomllib
from pathlib import Path

import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.metrics.kinds import KINDS
from cosim.studies.metrics.metrics import parse_metrics
from tests.studies.metrics.rows import CHANNELS

REFUSED = {
    "rms(": "metric 'rms(': not a metric",
    "": "metric '': not a metric; expected something like 'rms(observer.delta - delta.y)'",
    "3 + pi": "found no reduction; needed one at least, such as last(plant.y)",
    "plant.y": "found 'plant.y' outside a reduction; needed one of it, such as last(plant.y)",
    "t": "found 't' outside a reduction; needed one of it, such as last(t)",
    "last(plant.y) + plant.v[0]": "found 'plant.v[0]' outside a reduction",
    "1 + 'plant.y'": "found \"'plant.y'\" outside a reduction",
    "plant.y < 1": "found the condition 'plant.y < 1' outside a reduction; needed a number, such "
    "as share(plant.y < 1)",
    "max(plant.y, plant.u)": "found 'max(plant.y, plant.u)' outside a reduction, where max is that "
    "of two reductions; needed max(max(plant.y, plant.u)) for that over all rows",
    "min(abs(plant.y), last(plant.u))": "outside a reduction, where min is that of two reductions",
    "rsm(plant.y)": "found unknown reduction or function 'rsm'; did you mean 'rms'?",
    "max()": "found 'max()'; needed max(EXPRESSION), or max(EXPRESSION, CONDITION)",
    "max(1, 2, 3)": "found 'max(1, 2, 3)'; needed max(EXPRESSION), or",
    "rms(plant.y, plant.u)": "found 'rms(plant.y, plant.u)'; needed rms(EXPRESSION), or",
    "rms(plant.y > 1)": "found 'rms(plant.y > 1)'; needed rms(EXPRESSION), or",
    "share(plant.y)": "needed share(CONDITION), or share(CONDITION, CONDITION)",
    "first(t)": "found 'first(t)'; needed first(EXPRESSION, CONDITION)",
    "first(t, 1)": "found 'first(t, 1)'; needed first(EXPRESSION, CONDITION)",
    "initial(plant.y, t > 1)": "needed initial(EXPRESSION), or first(EXPRESSION, CONDITION)",
    "settling(plant.y, 1, 2)": "needed settling(EXPRESSION), settling(EXPRESSION, BAND), or",
    "settling(plant.y, -1)": "found the band '-1'; needed 0 or a positive number",
    "settling(plant.y, plant.u)": "found 'plant.u' outside a reduction",
    "rms(last(plant.y))": "found 'last(plant.y)' inside rms(...); needed an expression over "
    "signals there: reductions are joined by arithmetic, and not nested",
    "max(max(plant.y))": "found 'max(plant.y)' inside max(...)",
    "first(t, plant.y > last(plant.y))": "found 'last(plant.y)' inside first(...); needed an",
    "last(plant.y) > 1": "found the condition 'last(plant.y) > 1' outside a reduction; needed a "
    "number",
    "rms(plnt)": "expression 'plnt': unknown name 'plnt'",
    "rms(plant.y; 3)": "not a metric at column",
    "rms(plant.y, x=3)": "got 'rms(plant.y, x=3)'; allowed: numbers, pi, e, reductions such as",
    "[last(plant.y)]": "got '[last(plant.y)]'; allowed: numbers",
    "last(plant.y)[0]": "got 'last(plant.y)[0]'",
    "last(plant.y) + True": "got True; expected a real number",
    "sqrt(last(plant.y), 2)": "found sqrt with 2 arguments; needed 1",
    "first(t, plant.y > 1 for 1 parsec)": "got '1 parsec' after 'for': unknown unit 'parsec'",
    "first(t, plant.y > 1 for )": "got '' after 'for'; expected a duration, such as 10 ms",
    "first(t for 1 s, plant.y > 1)": "found 'for' behind what is no condition; needed it at the "
    "end of one, such as first(t, plant.y < 1 for 1 s)",
    "last(plant.y) for 1 s": "found 'for' behind what is no condition",
    "first(t, (plant.y > 1 for 1 s) and plant.u > 1)": "found 'for' behind what is no condition",
    "first(t, plant.y > 1 for 1 s and plant.u > 1)": "got '1 s and plant.u > 1' after 'for'",
    "+".join(["last(plant.y)"] * 2000): "nested too deeply",
}


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:40])
def test_what_is_no_metric_is_refused(text):
    """With what was found and what is possible instead; the message begins with its name."""
    with pytest.raises(UsageError) as error:
        parse_metrics({"size": text})
    assert str(error.value).startswith("metrics.size: ")
    assert REFUSED[text] in str(error.value)


def test_all_problems_of_all_metrics_come_in_one_report():
    """A line each; those of other metrics are not hidden by the first."""
    with pytest.raises(UsageError) as error:
        parse_metrics({"a": "plant.y", "b": "last(plant.y)", "c": "rms(", "": "last(t)", "d": 3})
    lines = str(error.value).splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        *("metrics.a", "metrics.c", "metrics.", "metrics.d")
    ]
    assert lines[2] == "metrics.: found this name; needed a text that is not empty"
    assert lines[3] == "metrics.d: found 3; needed a text such as 'max(abs(plant.y))'"


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
    assert lines[0].startswith(
        "metrics.a: the run has no component 'plnt'; did you mean 'plant'? There is: plant, "
    )
    assert lines[1].startswith("metrics.a: the run has no 'plant.yy': 'plant' has no signal 'yy'; ")
    needed = "has 2 elements; needed one of them: plant.v[0], plant.v[1]"
    assert lines[2] == f"metrics.b: 'plant.v' {needed}"
    assert lines[3] == f"metrics.c: 'plant.v[0:2]' {needed}"
    assert lines[4].startswith("metrics.d: the run: 'plant.v[2]'")
    assert len(lines) == 5
    assert metrics.names == ("a", "b", "c", "d")
    assert metrics.signals == (
        *("plnt.y", "plant.yy", "plant.y", "plant.v", "plant.v[0:2]", "plant.v[2]"),
    )


DOCUMENT = Path(cosim.__file__).parents[1] / ".readme" / "studies.md"


def test_the_document_shows_every_reduction_as_it_is_written():
    """Its table, and its example, are metrics."""
    text = DOCUMENT.read_text(encoding="utf-8").partition("## Metrics")[2].partition("\n## ")[0]
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
