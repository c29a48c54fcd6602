"""What a log says of its run beside its rows follows from its scenario, or is found out."""

import json

import pytest

import cosim
from cosim.errors import CosimError, RunError
from cosim.log import open_log
from cosim.report.statements import Contradiction
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from tests.log.crafting import put_together, take_apart
from tests.report.forging import forged, with_own_hash

FAILS = """
[scenario]
name = "fails"
stop = 0.1
step = 0.01

[components]
w = { kind = "expression", y = "log(0.05 - t)" }
run = { kind = "lag", time_constant = 0.05 }

[connections]
"run.u" = "w.y"
"""

# What a replay takes as it stands: its input, and what is said of components that it copies.
TAKEN = {("cosim.run", "edits"), ("cosim.run", "format")}
TAKEN |= {
    ("cosim.component.plant", key)
    for key in ("metadata", "fingerprint", "cosim.held", "cosim.design")
}
OF_MACHINE = {"cosim.env", "cosim.written"}


def recorded(folder, *changes):
    """Record a run of the example whose text is changed; return its path."""
    text = cosim.load("academic").document.text
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    scenario = folder / "short.toml"
    scenario.write_text(text)
    return cosim.run(scenario, out=folder / "a.mcap").path


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a run of a scenario that nothing was set in; return its path."""
    return recorded(tmp_path_factory.mktemp("valid"), ("stop = 40.0", "stop = 0.05"))


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Record a run whose identifier has estimates; return its path."""
    own = "[components.identifier]\n"
    return recorded(
        tmp_path_factory.mktemp("judged"),
        ("stop = 40.0", "stop = 8.0"),
        ("step = 1e-3", "step = 1e-2"),
        (own, f"{own}irregular = 1e-5\n"),
        ("filter_rate = 1e3", "filter_rate = 100.0"),
    )


def verified(path):
    """Return the verification of a log by its replay."""
    return verify(open_log(path), cosim.replay(path))


def contradicted(path):
    """Return the statements of a log that its replay contradicts; its rows are right."""
    verification = verified(path)
    assert verification.difference.same_rows
    assert verification.passed is not bool(verification.contradictions)
    return [entry.statement for entry in verification.contradictions]


@pytest.mark.parametrize(
    ("old", "new", "statement"),
    [
        ("= [-0.1, -0.3]", "= [-0.1003, -0.2981]", "truth.truth"),
        ("stop = 0.05", "stop = 0.06", "times.stop"),
        ("stop = 0.05", "stop = 1e9", "times.stop"),
        ("stop = 0.05", "", "times.stop"),
        (
            'kind = "sine"\namplitude = 1.0\nrate = 1.0',
            'kind = "fmu"\npath = "x"',
            "component tables.u.table",
        ),
        ("[connections]", '[swap]\nu = "x.fmu"\n[connections]', "component tables.u.table"),
        ('name = "academic"', 'name = "other"', "times.scenario"),
        ('"observer.u" = "u.y"', '"observer.u" = "delta.y"', "connections.observer.u"),
    ],
)
def test_another_scenario_is_found(valid, tmp_path, old, new, statement):
    """A replay runs the text; reports show the metadata: the two must be of one scenario."""
    verification = verified(forged(valid, tmp_path / "b.mcap", text=(old, new)))
    assert not verification.passed
    assert statement in [entry.statement for entry in verification.contradictions]


def altered(text):
    """Return another text, of JSON another value that is much like it."""
    try:
        value = json.loads(text)
    except ValueError:
        return f"{text}x"
    match value:
        case dict():
            value = {**value, "added": 1.0}
        case [first, *others]:
            value = [not first, *others]
        case float() | int():
            value += 1
        case _:
            value = ["added"]
    return json.dumps(value)


@pytest.mark.slow
def test_no_metadata_can_be_changed_that_a_replay_computes(valid, tmp_path):
    """Whatever entry is altered, with its checksum computed anew: the log is refused, or fails."""
    records = {
        (name, key): text
        for name, items in take_apart(valid).metadata
        for key, text in items.items()
    }
    noticed = set()
    for (name, key), text in records.items():
        said = {name: {key: altered(text)}}
        try:
            is_noticed = not verified(forged(valid, tmp_path / "b.mcap", metadata=said)).passed
        except CosimError:
            is_noticed = True
        if is_noticed:
            noticed.add((name, key))
    unnoticed = {one for one in records.keys() - noticed if one[0] not in OF_MACHINE}
    assert unnoticed <= TAKEN
    assert len(noticed) > 30


@pytest.mark.fast("content_hash", "last")
@pytest.mark.parametrize("key", ["status", "reason", "end_ns", "content_hash", "last"])
def test_no_result_can_be_changed(valid, tmp_path, key):
    """The attachment with the results says what the log and the last row say."""

    def change(results):
        entry = results[key]
        is_row = isinstance(entry, dict)
        results[key] = {**entry, "identifier.theta[0]": -0.1} if is_row else f"{entry}x"

    for changes in ({"results": change}, {"data": b"{}"}, {"data": b""}):
        statement, *_ = contradicted(forged(valid, tmp_path / "b.mcap", **changes))
        assert statement.startswith(("result.json.", "last row."))


ERROR = {"error": "a constant on y", "size": 1.0, "half_widths": {"theta[0]": 3.0}, "text": ""}


def scale(found, key, factor):
    found[key] *= factor


@pytest.mark.parametrize(
    ("change", "statements"),
    [
        (lambda own: scale(own["parameters"][0], "value", 1.0 + 1e-3), ["parameters.0.value"]),
        (lambda own: scale(own["amplitudes"][0][1], "value", 1.0 + 1e-3), ["amplitudes.0.1.value"]),
        (
            lambda own: scale(own["irregular"]["effects"][1], "lower", 1.0 + 1e-3),
            ["irregular.effects.1.lower"],
        ),
        (lambda own: own.update(undetected=[ERROR]), ["undetected"]),
        # what other processors make of them
        (lambda own: scale(own["parameters"][0], "value", 1.0 + 1e-9), []),
        (lambda own: scale(own["amplitudes"][0][1], "value", 1.0 + 1e-9), []),
        (lambda own: scale(own["irregular"]["effects"][1], "lower", 1.0 + 1e-9), []),
        # older logs have none of them
        (lambda own: own.pop("amplitudes"), []),
        (lambda own: own.pop("undetected"), []),
        (lambda own: own.pop("irregular"), []),
    ],
)
def test_no_estimate_can_be_changed(judged, tmp_path, change, statements):
    """Neither parameter, amplitude nor interval, and no error is undetected that is not."""

    def change_results(results):
        change(results["identification"]["identifier"])

    found = contradicted(forged(judged, tmp_path / "b.mcap", results=change_results))
    assert found == [f"verdicts.identifier.{statement}" for statement in statements]


def test_of_many_contradictions_the_first_are_shown(valid, tmp_path):
    """Every value of the last row may be wrong; all of them stand in the JSON."""

    def change(results):
        results["last"] = dict.fromkeys(results["last"], 0.25)

    verification = verified(forged(valid, tmp_path / "b.mcap", results=change))
    count = len(verification.contradictions)
    assert count > 9
    assert len(verification.problems) == 9
    assert f"{count - 8} more" in verification.problems[-1]
    assert len(verification.to_dict()["contradictions"]) == count


def test_an_end_before_the_stop_needs_a_reason(valid, tmp_path):
    """A complete run without a stop reason ends where its scenario does."""
    text = ("stop = 0.05", "stop = 0.06")
    said = {"cosim.run": {"stop": "0.06"}}
    (found,) = verified(forged(valid, tmp_path / "b.mcap", text=text, metadata=said)).contradictions
    assert found == Contradiction("end of the run [ns]", 50_000_000, 60_000_000)


def test_declared_signals_are_compared(valid, tmp_path):
    """Another unit is no difference of a row, and the content hash can be computed anew."""
    content = take_apart(valid)
    for topic, _, items in content.channels.values():
        if topic == "/observer":
            items["cosim.signals"] = items["cosim.signals"].replace(
                '"name":"delta","size":1,"unit":null', '"name":"delta","size":1,"unit":"mm"'
            )
        if topic == "/regressor":
            items["cosim.kind"] = "identifier"
    path = with_own_hash(put_together(content, tmp_path / "b.mcap"))
    assert set(contradicted(path)) == {
        "component tables.observer.signals.3.unit",
        "component tables.regressor.kind",
    }


@pytest.mark.slow
def test_warnings_of_computed_components_are_compared(tmp_path):
    """A warning cannot be taken out, of the metadata, the messages, or the results."""
    valid = tmp_path / "a.mcap"
    held = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.05}
    cosim.run("academic", out=valid, set=held)
    assert contradicted(valid) == []
    said = {"cosim.run": {"warnings": "[]"}}
    assert contradicted(forged(valid, tmp_path / "b.mcap", metadata=said)) == ["warnings.0.0"]
    content = take_apart(valid)
    content.messages = [row for row in content.messages if b"do not trust delta" not in row[3]]
    assert "warnings.1" in contradicted(put_together(content, tmp_path / "c.mcap"))
    path = forged(valid, tmp_path / "d.mcap", results=lambda results: results.update(warnings=[]))
    assert contradicted(path) == ["result.json.warnings"]


@pytest.mark.parametrize(("version", "passes"), [("0.0.1", True), (cosim.__version__, False)])
def test_the_sentences_of_another_version_are_not_compared(valid, tmp_path, version, passes):
    """It may say the same in other words; the verification does not claim that it looked."""
    said = json.dumps([["observer", "a sentence of old"]])
    changed = {"cosim.run": {"warnings": said}, "cosim.env": {"cosim": version}}
    verification = verified(forged(valid, tmp_path / "b.mcap", metadata=changed))
    assert verification.passed is passes
    assert ("warnings" in verification.statements.split(", ")) is not passes
    assert ("warnings of another version of cosim" in verification.lines[-1]) is passes


@pytest.mark.parametrize(
    ("eigenvalues", "passes"),
    [
        ([-2.0000001, -4.0], True),
        ([-2.2, -4.0], False),
        ([-4.0], False),
        (["x", -2.0], False),
        ([10**400], False),  # no float holds it
    ],
)
def test_eigenvalues_are_compared_but_for_what_depends_on_the_processor(
    valid, tmp_path, eigenvalues, passes
):
    """Their order and last digits are those of the machine that computed them."""
    component = "cosim.component.observer"
    metadata = json.loads(dict(take_apart(valid).metadata)[component]["metadata"])
    assert metadata["eigenvalues"] == [-4.0, -2.0]
    changed = json.dumps({**metadata, "eigenvalues": eigenvalues})
    path = forged(valid, tmp_path / "b.mcap", metadata={component: {"metadata": changed}})
    assert contradicted(path) == (
        [] if passes else ["component tables.observer.metadata.eigenvalues"]
    )


def test_no_metadata_hides_a_table(valid, tmp_path):
    """A component may call its metadata as it likes, also as statements are called."""
    component = "cosim.component.observer"
    items = dict(take_apart(valid).metadata)[component]
    metadata = json.dumps({**json.loads(items["metadata"]), "table": items["table"]})
    changed = {component: {"metadata": metadata, "table": altered(items["table"])}}
    found = contradicted(forged(valid, tmp_path / "b.mcap", metadata=changed))
    assert "component tables.observer.table" in found


@pytest.mark.fast("pair", "academic", "academic-noisy")
@pytest.mark.parametrize("name", shipped())
def test_a_log_and_the_log_of_its_replay_pass(name, tmp_path):
    """Of every shipped scenario: a replay says nothing else of a run than the run did."""
    path = tmp_path / "a.mcap"
    cosim.run(name, out=path, set={"scenario.stop": 0.05})
    again = cosim.replay(path, out=tmp_path / "b.mcap")
    assert verify(open_log(path), again).problems == []
    assert verified(again.path).problems == []


def test_the_log_of_a_run_that_failed_or_was_stopped_passes(tmp_path):
    """What it says of its end is about a run that did not reach its stop."""
    scenario = tmp_path / "fails.toml"
    scenario.write_text(FAILS)
    with pytest.raises(RunError):
        cosim.run(scenario, out=tmp_path / "a.mcap")

    def interrupt(time, end):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cosim.run("academic", out=tmp_path / "b.mcap", block=20, progress=interrupt)
    for name, status in (("a.mcap", "failed"), ("b.mcap", "interrupted")):
        assert open_log(tmp_path / name).status == status
        assert verified(tmp_path / name).problems == []


def test_the_log_of_a_swapped_run_passes_without_what_was_swapped_in(valid, tmp_path):
    """The swap report and its warnings are of the run; a replay compares nothing with them."""
    plant = tmp_path / "plant.mcap"
    plant.write_bytes(valid.read_bytes())
    path = tmp_path / "a.mcap"
    cosim.run("academic", out=path, swap={"plant": plant}, set={"scenario.stop": 0.05})
    plant.unlink()
    assert verified(path).problems == []


def test_a_log_without_an_estimate_is_not_contradicted_by_a_replay_without_verdicts(tmp_path):
    """There is nothing in it that the replay should have found."""
    short = {"scenario.stop": 0.1, "scenario.step": 0.02}
    log = cosim.run("academic", out=tmp_path / "a.mcap", set=short)
    assert log.results["identification"]["identifier"].keys() == {"problem"}
    again = cosim.replay(log, set={"scenario.verdicts": False})
    assert verify(open_log(log.path), again).contradictions == ()
