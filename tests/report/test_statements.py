"""What a log says of its run beside its rows follows from its scenario, or is found out."""

import json

import pytest

import cosim
from cosim.errors import CosimError, RunError
from cosim.log import open_log
from cosim.report.statements import Contradiction
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from tests.log.crafting import put_together, take_apart

FAILS = """
[scenario]
name = "fails"
stop = 0.1
step = 0.01

[components.w]
kind = "expression"
y = "log(0.05 - t)"

[components.run]
kind = "lag"
time_constant = 0.05

[connections]
"run.u" = "w.y"
"""

# What a replay takes as it stands: its input, and what is said of components that it copies.
TAKEN = {("cosim.run", "edits"), ("cosim.run", "format")}
TAKEN_OF_COPIED = {"metadata", "fingerprint", "cosim.held", "cosim.design"}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a run of a scenario that nothing was set in; return its path."""
    folder = tmp_path_factory.mktemp("valid")
    text = cosim.load("academic").document.text
    scenario = folder / "short.toml"
    scenario.write_text(text.replace("stop = 40.0", "stop = 0.05"))
    path = folder / "a.mcap"
    cosim.run(scenario, out=path)
    return path


def forged(valid, path, *, text=None, metadata=None, attachments=None):
    """Write a log with another scenario, other metadata or attachments, all checksums right."""
    content = take_apart(valid)
    for name, items in content.metadata:
        items.update((metadata or {}).get(name, {}))
    changed = []
    for name, data in content.attachments:
        replaced = (attachments or {}).get(name, data)
        if name == "scenario.toml" and text is not None:
            old, new = text
            assert old in data.decode()
            replaced = data.decode().replace(old, new).encode()
        if replaced is not None:
            changed.append((name, replaced))
    content.attachments = changed
    return put_together(content, path)


def altered(text):
    """Return another text, of JSON another value that is much like it."""
    try:
        value = json.loads(text)
    except ValueError:
        return f"{text}x"
    if isinstance(value, dict):
        return json.dumps({**value, "added": 1.0})
    if isinstance(value, list):
        return json.dumps([not value[0], *value[1:]] if value else ["added"])
    if isinstance(value, float | int):
        return json.dumps(value + 1)
    return json.dumps("added")


def verified(path):
    """Return the verification of a log by its replay."""
    return verify(open_log(path), cosim.replay(path))


def is_found_out(path):
    """Return whether a log is refused, or fails its verification."""
    try:
        return not verified(path).passed
    except CosimError:
        return True


@pytest.mark.parametrize(
    ("old", "new", "statement"),
    [
        ("= [-0.1, -0.3]", "= [-0.1003, -0.2981]", "truth: "),
        ("stop = 0.05", "stop = 0.06", "stop: '0.05' in the log, '0.06' in the replay"),
        ("stop = 0.05", "stop = 1e9", "stop: "),
        ("stop = 0.05", "", "stop: "),
        ('kind = "sine"\namplitude = 1.0\nrate = 1.0', 'kind = "fmu"\npath = "x.fmu"', "'u'"),
        ("[connections]", '[swap]\nu = "x.fmu"\n[connections]', "table of 'u': "),
        ('name = "academic"', 'name = "other"', "scenario: 'academic'"),
        ('"observer.u" = "u.y"', '"observer.u" = "delta.y"', "connection to 'observer.u': "),
    ],
)
def test_another_scenario_is_found(valid, tmp_path, old, new, statement):
    """A replay runs the text; reports show the metadata: the two must be of one scenario."""
    verification = verified(forged(valid, tmp_path / "b.mcap", text=(old, new)))
    assert not verification.passed
    assert any(statement in problem for problem in verification.problems), verification.problems


def records(path):
    """Yield the name and key of every metadata entry that a replay computes anew."""
    for name, items in take_apart(path).metadata:
        component = name.removeprefix("cosim.component.")
        for key in items:
            taken = TAKEN_OF_COPIED if component == "plant" else set()
            if (
                name in ("cosim.env", "cosim.written")
                or (name, key) in TAKEN
                or (component != name and key in taken)
            ):
                continue
            yield name, key


@pytest.mark.slow
def test_no_metadata_can_be_changed_that_a_replay_computes(valid, tmp_path):
    """Whatever entry is altered, with its checksum computed anew: the log fails."""
    unnoticed = []
    for name, key in records(valid):
        items = dict(take_apart(valid).metadata)[name]
        changed = {name: {key: altered(items[key])}}
        if not is_found_out(forged(valid, tmp_path / "b.mcap", metadata=changed)):
            unnoticed.append((name, key))
    assert not unnoticed
    assert len(list(records(valid))) > 30


@pytest.mark.fast("content_hash", "last")
@pytest.mark.parametrize("key", ["status", "reason", "end_ns", "content_hash", "last"])
def test_no_result_can_be_changed(valid, tmp_path, key):
    """The attachment with the results says what the log and the last row say."""
    results = dict(open_log(valid).results)
    entry = results[key]
    changed = {**results, key: f"{entry}x"}
    if isinstance(entry, dict):
        changed[key] = {**entry, "identifier.theta[0]": -0.1}
    for data in (json.dumps(changed).encode(), b"{}", None):
        path = forged(valid, tmp_path / "b.mcap", attachments={"result.json": data})
        verification = verified(path)
        assert not verification.passed
        assert "result.json" in verification.problems[0]


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Record a run whose identifier has estimates; return its path."""
    folder = tmp_path_factory.mktemp("judged")
    text = cosim.load("academic").document.text
    own = "[components.identifier]\n"
    changes = (
        ("stop = 40.0", "stop = 8.0"),
        ("step = 1e-3", "step = 1e-2"),
        (own, f"{own}irregular = 1e-5\n"),
    )
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    scenario = folder / "short.toml"
    scenario.write_text(text.replace("filter_rate = 1e3", "filter_rate = 100.0"))
    path = folder / "a.mcap"
    cosim.run(scenario, out=path)
    return path


@pytest.mark.fast("parameters-place0-verdicts on", "amplitudes-place1-amplitudes of")
@pytest.mark.parametrize(
    ("key", "place", "named"),
    [
        ("parameters", (0, "value"), "verdicts on"),
        ("amplitudes", (0, 1, "value"), "amplitudes of"),
        ("irregular", ("effects", 1, "lower"), "guaranteed intervals of"),
    ],
)
def test_no_estimate_can_be_changed(judged, tmp_path, key, place, named):
    """Neither parameter, amplitude nor interval, by more than other processors make of it."""
    results = dict(open_log(judged).results)
    for factor, passes in ((1.0, True), (1.0 + 1e-9, True), (1.0 + 1e-3, False)):
        changed = json.loads(json.dumps(results))
        found = changed["identification"]["identifier"][key]
        *way, last = place
        for step in way:
            found = found[step]
        found[last] *= factor
        data = json.dumps(changed).encode()
        path = forged(judged, tmp_path / "b.mcap", attachments={"result.json": data})
        verification = verified(path)
        assert verification.passed is passes
        if not passes:
            (problem,) = verification.problems
            assert f"{named} 'identifier': " in problem


def test_the_summary_shows_half_the_width_of_an_interval(judged):
    log = open_log(judged)
    (identification,) = summarize(log).identifications
    recorded = log.results["identification"]["identifier"]["parameters"]
    for shown, of_log in zip(identification.parameters, recorded, strict=True):
        assert shown.half_width == pytest.approx((of_log["upper"] - of_log["lower"]) / 2.0)


def test_an_undetected_error_that_no_replay_finds_is_false(judged, tmp_path):
    results = json.loads(json.dumps(dict(open_log(judged).results)))
    error = {"error": "a constant on y", "size": 1.0, "half_widths": {"theta[0]": 3.0}, "text": ""}
    results["identification"]["identifier"]["undetected"] = [error]
    data = json.dumps(results).encode()
    verification = verified(forged(judged, tmp_path / "b.mcap", attachments={"result.json": data}))
    (problem,) = verification.problems
    assert "undetected errors of 'identifier': " in problem


@pytest.mark.parametrize("key", ["amplitudes", "undetected", "irregular"])
def test_a_log_that_says_nothing_of_them_is_true(judged, tmp_path, key):
    """Older ones have no amplitudes, no undetected errors, nor guaranteed intervals."""
    results = json.loads(json.dumps(dict(open_log(judged).results)))
    del results["identification"]["identifier"][key]
    data = json.dumps(results).encode()
    assert verified(forged(judged, tmp_path / "b.mcap", attachments={"result.json": data})).passed


def test_of_many_contradictions_the_first_are_shown(valid, tmp_path):
    """Every value of the last row may be wrong; all of them stand in the JSON."""
    results = dict(open_log(valid).results)
    results["last"] = dict.fromkeys(results["last"], 0.25)
    attachments = {"result.json": json.dumps(results).encode()}
    verification = verified(forged(valid, tmp_path / "b.mcap", attachments=attachments))
    count = len(verification.contradictions)
    assert count > 9
    assert len(verification.problems) == 9
    assert verification.problems[-1].endswith(f"{count - 8} more")
    assert len(verification.to_dict()["contradictions"]) == count


def test_an_end_before_the_stop_needs_a_reason(valid, tmp_path):
    """A complete run without a stop reason ends where its scenario does."""
    changed = {"cosim.run": {"stop": "0.06"}}
    path = forged(valid, tmp_path / "b.mcap", text=("stop = 0.05", "stop = 0.06"), metadata=changed)
    (problem,) = verified(path).problems
    assert "end of the run [ns]: 50000000 in the log, 60000000 in the replay" in problem


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
    path = put_together(content, tmp_path / "b.mcap")
    found = open_log(path).content_hash()
    dict(content.metadata)["cosim.result"]["content_hash"] = found
    results = {**open_log(valid).results, "content_hash": found}
    attachments = {"result.json": json.dumps(results).encode()}
    path = forged(put_together(content, path), tmp_path / "c.mcap", attachments=attachments)
    problems = verified(path).problems
    assert len(problems) == 2
    assert "signals of 'observer': " in problems[0]
    assert "kind of 'regressor': 'identifier' in the log, 'regressor' in the replay" in problems[1]


@pytest.mark.slow
def test_warnings_of_computed_components_are_compared(tmp_path):
    """A warning cannot be taken out, of the metadata, the messages, or the results."""
    valid = tmp_path / "a.mcap"
    held = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.05}
    cosim.run("academic", out=valid, set=held)
    assert verified(valid).problems == []
    changed = {"cosim.run": {"warnings": "[]"}}
    (problem,) = verified(forged(valid, tmp_path / "b.mcap", metadata=changed)).problems
    assert "warnings: [] in the log, [('observer', " in problem
    content = take_apart(valid)
    content.messages = [row for row in content.messages if b"do not trust delta" not in row[3]]
    problems = verified(put_together(content, tmp_path / "c.mcap")).problems
    assert "messages: [] in the log, [('observer', " in problems[0]
    results = {**open_log(valid).results, "warnings": []}
    attachments = {"result.json": json.dumps(results).encode()}
    (problem,) = verified(forged(valid, tmp_path / "d.mcap", attachments=attachments)).problems
    assert "warnings in result.json: [] in the log, [('warning', 'observer', " in problem


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
    [([-2.0000001, -4.0], True), ([-2.2, -4.0], False), ([-4.0], False), (["x", -2.0], False)],
)
def test_eigenvalues_are_compared_but_for_what_depends_on_the_processor(
    valid, tmp_path, eigenvalues, passes
):
    """Their order and last digits are those of the machine that computed them."""
    items = dict(take_apart(valid).metadata)["cosim.component.observer"]
    metadata = json.loads(items["metadata"])
    assert metadata["eigenvalues"] == [-4.0, -2.0]
    changed = json.dumps({**metadata, "eigenvalues": eigenvalues})
    path = forged(
        valid, tmp_path / "b.mcap", metadata={"cosim.component.observer": {"metadata": changed}}
    )
    assert verified(path).passed is passes


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
    assert open_log(tmp_path / "a.mcap").status == "failed"
    assert verified(tmp_path / "a.mcap").problems == []

    def interrupt(time, end):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cosim.run("academic", out=tmp_path / "b.mcap", block=20, progress=interrupt)
    assert open_log(tmp_path / "b.mcap").status == "interrupted"
    assert verified(tmp_path / "b.mcap").problems == []


def test_the_log_of_a_swapped_run_passes_without_what_was_swapped_in(valid, tmp_path):
    """The swap report and its warnings are of the run; a replay compares nothing with them."""
    plant = tmp_path / "plant.mcap"
    plant.write_bytes(valid.read_bytes())
    path = tmp_path / "a.mcap"
    cosim.run("academic", out=path, swap={"plant": plant}, set={"scenario.stop": 0.05})
    plant.unlink()
    assert verified(path).problems == []


@pytest.mark.parametrize(
    ("found", "expected", "text"),
    [
        ([1, 2, 3], [1, 7, 3], "what, entry 1: 2 in the log, 7 in the replay"),
        ([1, 2, 3], [1], "what, from entry 1 on: [2, 3] in the log, [] in the replay"),
        ([], [1], "what: [] in the log, [1] in the replay"),
        ("a", "b", "what: 'a' in the log, 'b' in the replay"),
    ],
)
def test_of_lists_the_first_difference_is_shown(found, expected, text):
    """Long ones are shortened where they begin to differ otherwise."""
    assert str(Contradiction("what", found, expected)) == text
