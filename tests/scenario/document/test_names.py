"""Names are words of any language, everywhere that they go; their order is free."""

import random
import re
import tomllib
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.cli import main
from cosim.errors import ScenarioError
from cosim.log.messages import identifiers
from cosim.scenario.document.document import find
from cosim.scenario.document.schema import RESERVED
from cosim.scenario.exporting import model_identifier
from tests.scenario.document.written import toml_of
from tests.scenario.refusals import check_refused

SCENARIO = """
scenario = { name = "größe", stop = 0.2, step = 0.1 }
[components."温度"]
kind = "sine"
rate = 1.0

[components."größe-1"]
kind = "lag"
time_constant = 1.0

[connections]
"größe-1.u" = "温度.y"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder with the scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "größe.toml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path


def shell(*arguments):
    """Call the command line and return its exit code."""
    with pytest.raises(SystemExit) as left:
        main(list(arguments))
    return left.value.code or 0


def test_names_of_any_language_pass_through_files_logs_and_edits(folder):
    """Scenario, log, its default name, replay, comparison and edits."""
    assert shell("run", "größe.toml", "--quiet") == 0
    assert shell("run", "größe.toml", "--quiet", "--set", "温度.rate=2.0") == 0
    logs = folder / "logs"
    names = {unicodedata.normalize("NFC", path.name) for path in logs.iterdir()}
    assert names == {"größe.mcap", "größe-2.mcap"}
    assert shell("replay", "logs/größe.mcap", "--verify", "--quiet") == 0
    assert shell("diff", "logs/größe.mcap", "logs/größe-2.mcap", "größe-1.y") == 1
    log = cosim.open_log("logs/größe.mcap")
    memory = cosim.run("größe.toml")
    assert list(log.channels) == ["温度", "größe-1"]
    assert (log["größe-1.y"] == memory["größe-1.y"]).all()


def test_names_that_look_the_same_are_not_two():
    """A name is composed (NFC); in another form it is refused, wherever it is used."""
    cases = []
    table = {"kind": "constant", "value": 1.0}
    for name in ("gro\u0308ße", "e\u0301", "u\u0308"):
        composed = unicodedata.normalize("NFC", name)
        pattern = f"expected '{composed}', composed as Unicode NFC"
        cases.append(({f"components.{name}": table}, pattern))
        used = {f"components.{composed}": table, "connections.plant.u": f"{name}.y"}
        cases.append((used, pattern))
    check_refused(cases, lambda edits: cosim.run("academic", set=edits), ScenarioError)


def test_a_name_is_a_word_of_letters_digits_and_hyphens():
    """Of any language, with 100 bytes at most; a component may have that of a table of the file."""
    names = ["", "_a", "1a", "a b", "a/b", "a\n", "a" * 101, "温" * 34, "-a", "."]
    cases = [(name, r"scenario\.name'\]: expected a name") for name in names]
    check_refused(cases, lambda name: cosim.load("academic").set({"scenario.name": name}))
    tables = {f"components.{name}": {"kind": "constant", "value": 1.0} for name in RESERVED}
    named = cosim.load("academic").set(tables)
    assert named.set({"components.record.value": 2.0}).specs["record"].value == 2.0
    assert named.set({"record.every": 2}).file.record.every == 2


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.text(st.sampled_from("_x2d5fa-ß温"), max_size=12) | st.text(max_size=12))
def test_model_identifiers_are_those_of_c_and_never_the_same_for_two_names(name):
    """The name can be read out of the identifier again."""
    identifier = model_identifier(f"a{name}")
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", identifier)
    read = re.sub(r"_x([0-9a-f]+)_", lambda match: chr(int(match[1], 16)), identifier)
    assert read == f"a{name}"


@settings(max_examples=100, derandomize=True, deadline=None)
@given(
    st.lists(st.text(st.sampled_from("_xß温a1[]."), max_size=5) | st.text(max_size=5), unique=True)
)
def test_fields_of_a_log_are_identifiers_and_distinct(names):
    """Whatever the signals are called."""
    fields = identifiers(names)
    assert len({field.replace("_", "").lower() for field in fields}) == len(names)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", field) for field in fields)


def shuffled(text, seed):
    """Return the text of a scenario with the keys of its tables in another order."""
    chance = random.Random(seed)
    lines = []
    for table, entries in tomllib.loads(text).items():
        items = list(entries.items())
        chance.shuffle(items)
        lines += [f'{table}."{key}" = {toml_of(value)}' for key, value in items]
    return "\n".join(lines)


@pytest.mark.fast("academic-as-printed")
@pytest.mark.parametrize("name", ["academic", "academic-as-printed", "closed-loop"])
def test_the_content_hash_does_not_depend_on_the_order_of_a_file(name, tmp_path):
    """Components, connections and parameters in other orders give the same bits."""
    hashes = set()
    text = find(name).text
    for seed in (None, 1, 2):
        path = tmp_path / f"{seed}.toml"
        path.write_text(text if seed is None else shuffled(text, seed))
        log = tmp_path / f"{seed}.mcap"
        cosim.run(path, out=log, set={"scenario.stop": 0.5})
        hashes.add(cosim.open_log(log).content_hash())
    assert len(hashes) == 1
