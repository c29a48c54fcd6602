"""Whatever comes in at the border of the scenarios, a CosimError comes out, and soon."""

import math
import os
import re
import tomllib
from contextlib import suppress
from pathlib import Path
from time import perf_counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cosim
from cosim.cli import main
from cosim.errors import CosimError, ScenarioError, UsageError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import (
    Document,
    find,
    parse_value,
    plain,
    shipped,
)
from cosim.scenario.document.places import key_lines, report
from tests.scenario.document.written import toml_of
from tests.scenario.refusals import check_refused

TEXT = find("academic").text
SHORT = {"scenario.stop": 0.01}
bounded = settings(
    max_examples=1000 if os.environ.get("HYPOTHESIS_PROFILE") == "search" else 10,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def refusal(**arguments):
    """Return the message that a run is refused with, which is short enough to be read."""
    with pytest.raises(UsageError) as caught:
        cosim.run("academic", **arguments)
    assert max(map(len, str(caught.value).splitlines())) < 1100
    return str(caught.value)


# --- text ---


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000 + "]" * 100_000, "x.toml: .* at most 50 levels deep"),
        ("\na = " + "{a=" * 100_000 + "1" + "}" * 100_000, "x.toml: .* at most 50 levels"),
        (".".join("a" * 20_000) + " = 1", "x.toml: .* at most 50 levels deep"),
        ("[" + ".".join("a" * 20_000) + "]", "x.toml: .* at most 50 levels deep"),
        (f"a = {'9' * 5000}", "x.toml: .*digits.*64 bits"),
        ("größe = 1", "x.toml:1: not TOML: .*; keys with non-ASCII letters must be quoted"),
        ("[" * 100_000, "x.toml:1: not TOML"),
        ('a = "' + "\\\\" * 100_000, "x.toml: not TOML: Unterminated string"),
    ],
    ids=["lists", "tables", "keys", "headers", "digits", "letters", "headers open", "escapes"],
)
def test_a_text_that_cannot_be_read_is_refused_at_once(text, message):
    """Deep nesting and long numbers cost neither a traceback nor much time."""
    began = perf_counter()
    with pytest.raises(ScenarioError, match=message):
        Document(text, "x.toml", Path.cwd()).tables()
    assert perf_counter() - began < 20.0 * _time_to_parse(len(text))


def _time_to_parse(characters):
    """Return the time that tomllib takes for harmless text of that length, at least a moment."""
    text = "a = [" + "1.0,\n" * (characters // 5) + "]"
    began = perf_counter()
    tomllib.loads(text)
    return max(perf_counter() - began, 0.05)


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path):
    """Some editors write one."""
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    assert cosim.load(path).name == "academic"


VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([10**400, 2**63, -(2**63), 10**18]),
    st.floats(),
    st.sampled_from([1e300, -1e300, 1e-300, 5e-324, -0.0, math.nan, math.inf, 1e-9, 3e9]),
    st.text(max_size=12),
    st.sampled_from(
        ["", "u.y", "größe", "gro\u0308ße", "a" * 5000, "\0", "x.fmu", "sine", "(" * 99]
    ),
    st.binary(max_size=3),
)
NESTED = st.recursive(
    VALUES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.tuples(inner, inner),
        st.dictionaries(st.text(max_size=4), inner, max_size=3),
    ),
    max_leaves=6,
)
TREES = {name: tomllib.loads(find(name).text) for name in shipped()}


def paths_of(tree, prefix=()):
    """Return the paths of all values in nested tables and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    paths = []
    for key, value in items:
        paths.append((*prefix, key))
        if isinstance(value, dict | list):
            paths += paths_of(value, (*prefix, key))
    return paths


def dotted(path):
    """Return the outermost table, entry and key of a path as a key of an edit."""
    return ".".join(map(str, path[:3]))


PLACES = [(name, path) for name, tree in TREES.items() for path in paths_of(tree)]


@bounded
@given(st.sampled_from(PLACES), NESTED)
def test_a_shipped_scenario_with_any_value_anywhere_is_run_or_refused(place, value):
    """A value, a table or an element of a list becomes anything that TOML has."""
    name, path = place
    tree = tomllib.loads(find(name).text)
    inner = tree
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    tables = [f"{toml_of(str(key))} = {toml_of(item)}" for key, item in tree.items()]
    with suppress(CosimError):
        scenario = parse(Document("\n".join(tables), "x.toml", Path.cwd()))
        cosim.run(scenario, set={"scenario.stop": scenario.file.scenario.step}, block=1)


@bounded
@given(st.text(max_size=200) | st.binary(max_size=200))
def test_any_text_is_read_or_refused(tmp_path, content):
    """Text and bytes, whatever is in them."""
    path = tmp_path / "x.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode(errors="replace"))
    with pytest.raises(CosimError):
        cosim.load(path)


@bounded
@given(st.text(alphabet="[]{}=,.#\"'\\\n ab1", max_size=80))
def test_lines_of_keys_are_found_in_any_text(text):
    """The lines are those of the text, also where it is no TOML."""
    lines = key_lines(text)
    assert all(1 <= line <= text.count("\n") + 1 for line in lines.values())


@bounded
@given(st.sampled_from([place for place in PLACES if len(place[1]) > 1]))
def test_every_key_of_a_shipped_scenario_has_its_line(place):
    """The line that a problem names has the key, or begins the value that the key is in."""
    name, path = place
    text = find(name).text
    said = report([(path, "x")], "x.toml", text)
    line = int(re.match(r"x\.toml:(\d+): ", said)[1])
    written = text.split("\n")[line - 1]
    assert any(str(part) in written for part in path)


def test_lines_of_a_text_with_every_form_of_key():
    """Multi-line lists and strings, arrays of tables, quoted and dotted keys."""
    text = '''a = [
  { b = 3 }, # [c]
]
"x.y"."z" = """
[no]
no = 1"""
[[t]]
u = 1
[[t]]
'''
    assert key_lines(text) == {"a": 1, "x.y.z": 4, "t": 7, "t[0]": 7, "t[0].u": 8, "t[1]": 9}


# --- edits ---


@pytest.mark.parametrize("levels", [1, 2])
def test_values_are_nested_at_most_50_levels_deep(levels):
    """A table is one level, as a list is."""
    value = 1.5
    for _ in range(50 // levels):
        value = [value] if levels == 1 else [{"a": value}]
    assert plain(value) == value
    assert parse_value(toml_of(value)) == value  # from the shell
    assert Document(f"key = {toml_of(value)}", "x.toml", Path.cwd()).tables().tree == {"key": value}
    for refuse in (lambda: parse_value(toml_of([value])), lambda: plain({"a": value})):
        with pytest.raises(UsageError, match="at most 50 levels deep"):
            refuse()
    texts = ["9" * 5000, "[" * 100_000 + "]" * 100_000]
    check_refused([(text, r"levels deep|digits") for text in texts], parse_value)


def test_a_second_line_in_the_shell_is_part_of_a_text():
    """A second line is no second key that gets lost."""
    assert parse_value("1\nb = 2") == "1\nb = 2"


@bounded
@given(st.one_of(st.sampled_from(PLACES).map(lambda place: dotted(place[1])), st.text()), NESTED)
def test_any_edit_is_applied_or_refused(key, value):
    """Of any key to any value."""
    with suppress(CosimError):
        cosim.run("academic", set={key: value, "scenario.step": 0.01, "scenario.stop": 0.01})


@bounded
@given(
    st.sampled_from(["swap", "map", "out", "force", "block", "recorder", "progress", "profile"]),
    NESTED,
)
def test_arguments_of_any_type_are_accepted_or_refused(tmp_path, name, value):
    """Of run; a path that the system takes is a path."""
    if name == "out" and isinstance(value, str):
        value = str(tmp_path / value)
    with suppress(CosimError):
        cosim.run("academic", set=SHORT, **{name: value})


@bounded
@given(NESTED)
def test_other_objects_than_scenarios_and_recordings_are_refused(value):
    """By every public function."""
    load = cosim.load("academic")
    for call in (cosim.load, cosim.run, cosim.replay, cosim.open_log, cosim.linearize):
        with pytest.raises(CosimError):
            call(value)
    for call in (
        lambda: cosim.diff(value, value),
        lambda: cosim.compare(value, swap={"plant": ["a.fmu", "b.fmu"]}),
        lambda: load.swap(plant=value),
        lambda: load.set({"u.kind": value}),
        lambda: cosim.compare("academic", swap=value),
        lambda: cosim.compare("academic", swap={"plant": value}),
    ):
        with pytest.raises(CosimError):
            call()


def test_a_text_is_no_mapping():
    """What is easily written by mistake is named."""
    with pytest.raises(UsageError, match=r"^set: .*mapping.*|^set: .*'a.value=3'"):
        cosim.load("academic").set("a.value=3")
    assert re.search(r"^force: .*'no'", refusal(force="no"))
    message = refusal(map={"plant.y": 2}, swap={"plant": "x.fmu"})
    assert re.search(r"^map\['plant\.y'\]: expected a name or a list of names, got 2", message)


def test_values_that_contain_themselves_are_refused():
    """They would be nested without end."""
    values = []
    values.append(values)
    assert "levels deep" in refusal(set={"u.amplitude": values})


TAKERS_OF_PATHS = (
    lambda path: cosim.load(f"{path}.toml"),
    lambda path: cosim.load(path),
    lambda path: cosim.open_log(path),
    lambda path: cosim.replay(path),
    lambda path: cosim.linearize(path),
    lambda path: cosim.run("academic", out=f"{path}.mcap", set=SHORT),
    lambda path: cosim.run("academic", swap={"plant": f"{path}.fmu"}),
    lambda path: cosim.run("academic", swap={"plant": f"{path}.mcap"}),
    lambda path: cosim.run("academic", set={"components.u": {"kind": "table", "file": path}}),
    lambda path: cosim.compare("academic", swap={"plant": ["a.fmu"]}, out=path, set=SHORT),
)


def test_paths_that_no_file_can_have_are_refused():
    """Too long, with NUL, with an unpaired surrogate: by everything that takes a path."""
    for taker in TAKERS_OF_PATHS:
        check_refused([(path, "") for path in ("a" * 300, "a" * 5000, "a\0b", "\ud800")], taker)


# --- sizes ---


TOO_LARGE = [
    ({"regressor.delays": [1, 2, 3e300]}, r"delays\[2\]|3e\+300 s"),
    ({"regressor.delays": [1, 2, 2e6]}, r"delays: .*2e\+06 s.*2000000000"),
    ({"scenario.step": 1e-9}, r"delays: .*1 s.*1000000000"),
    ({"observer.filter_rate": 1e-300}, r"start: .*T_id.* 6.90776e\+300 s"),
    ({"identifier.start": 1e300}, r"start: .*T_id.* 1e\+300 s"),
    ({"components.q": {"kind": "lag", "time_constant": 1.0, "size": 100_000}}, r"q.* size"),
    ({"components.q": {"kind": "noise", "deviation": 1.0, "seed": 2**64}}, r"at most 64 bits"),
    ({"u.amplitude": False}, r"expected a number, got False$"),
    ({"u.amplitude": 10**400}, r"expected a number <= 1.79769e\+308"),
    ({"components.q": {"kind": "expression", "y": "0x" + "f" * 5000}}, r"set\['q'\]: .*finite"),
    ({"components.q": {"kind": "expression", "y": "a" * 5000}}, r"'aaa"),
    ({"scenario.name": "a" * 5000}, r"expected a name of at most 100 bytes"),
    ({"observer.model": "a" * 5000}, r"unknown model"),
]


def test_numbers_and_names_that_are_too_large_are_refused():
    """Before memory is asked for, and in a message that can be read."""
    short = {"scenario.stop": 0.01}
    said = {pattern: refusal(set=short | changes) for changes, pattern in TOO_LARGE}
    assert [pattern for pattern, message in said.items() if not re.search(pattern, message)] == []


# --- the command line ---

WORDS = st.sampled_from(
    ["run", "replay", "diff", "compare", "info", "check", "plot", "list", "show", "export",
     "linearize", "identify", "academic", "x.toml", "x.mcap", "x.fmu", ".", "", "--set",
     "u.amplitude=nan",
     "--swap", "plant=x.fmu", "--map", "plant.y=[", "--stop", "0.01", "nan", "1e400", "--out",
     "out.mcap", "--json", "--quiet", "--dry-run", "--component", "plant", "--fmi", "3", "sine",
     "--toml", "-o", "größe", "=", "a=b", "--step", "-1", "--force", "--plot", "x.png", "--base"]
)  # fmt: skip


@pytest.mark.slow
@bounded
@given(st.lists(WORDS | st.text(st.characters(exclude_characters="\0"), max_size=8), max_size=6))
def test_any_command_line_ends_with_an_exit_code(tmp_path, monkeypatch, arguments):
    """0, 1 or 2, and no traceback."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code in (None, 0, 1, 2)
