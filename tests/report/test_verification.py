"""What a replay proves of its log, and what it does not: all checksums of a forged log fit."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, LogError, RunError, UsageError
from cosim.log import open_log
from cosim.log.difference import ElementDifference
from cosim.log.spans import cut
from cosim.report.statements import Statements
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from tests.log.crafting import change_rows, put_together, take_apart
from tests.report.forging import forged, with_entries, with_own_hash

IDENTIFICATION = "identification"
COPIED = ("plant.y", "plant.x_a", "plant.x_b")


def recorded(folder, *changes):
    """Record a run of the example, whose text is changed; return its path."""
    text = cosim.load("academic").document.text
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    (folder / "short.toml").write_text(text)
    return cosim.run(folder / "short.toml", out=folder / "a.mcap").path


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a short run of a scenario that nothing was set in; return its path."""
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


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """Record a run whose verdicts have tests of the residual; return its path."""
    changes = {"scenario.stop": 8.0, "scenario.step": 0.01}
    path = tmp_path_factory.mktemp("noisy") / "a.mcap"
    return cosim.run("academic-noisy", out=path, set=changes).path


def verified(path, **options):
    """Return the verification of a log by its replay."""
    return verify(open_log(path), cosim.replay(path, **options))


def contradicted(path):
    """Return the statements of a log that its replay contradicts; nothing else fails it."""
    verification = verified(path)
    assert verification.difference.same_rows
    assert verification.passed is not bool(verification.contradictions)
    return [entry.statement for entry in verification.contradictions]


# --- rows ---


def scaled(valid, path, columns, factor, *, is_forged=False):
    """Multiply some columns of the recorded plant; return the path.

    ``is_forged``: the recorded content hash and the last row are those of the changed rows, too.
    """
    content = take_apart(valid)

    def scale(_, values):
        values[columns] *= factor

    change_rows(content, "plant", scale)
    put_together(content, path)
    if is_forged:
        last = cosim.replay(path).results["last"]
        forged(with_own_hash(path), path, results=lambda results: results.update(last=last))
    return path


@pytest.mark.parametrize(("columns", "factor"), [(slice(3, 5), 2.0), (slice(5, 6), -7.0)])
def test_changed_rows_that_nothing_follows_from_are_found(valid, tmp_path, columns, factor):
    """The replay copies x_a and x_b, so it equals the log; the content hash does not."""
    path = scaled(valid, tmp_path / "b.mcap", columns, factor)
    changed = cosim.diff(open_log(valid), open_log(path))
    found = {row.signal for row in changed.rows if row.status != "equal"}
    assert found
    assert found <= {"plant.x_a", "plant.x_b"}
    verification = verified(path)
    assert verification.difference.equal
    assert not verification.passed
    assert verification.found_hash != verification.recorded_hash
    assert "were changed after recording" in verification.problems[0]


@pytest.mark.slow
def test_a_forged_hash_is_not_found_where_nothing_is_computed(valid, tmp_path):
    """What cannot be proven is listed as copied, and not claimed."""
    verification = verified(scaled(valid, tmp_path / "b.mcap", slice(5, 6), -7.0, is_forged=True))
    assert verification.passed
    assert verification.copied == COPIED
    assert not set(COPIED) & set(verification.computed)
    assert ", ".join(COPIED) in verification.lines[-2]
    assert "logs are not signed" in verification.lines[-1]
    # y drives the observer: its rows do not follow from a changed y any more
    verification = verified(scaled(valid, tmp_path / "c.mcap", slice(2, 3), 2.0, is_forged=True))
    assert not verification.passed
    assert "first: observer.y" in verification.problems[0]


def test_one_flipped_bit_is_shown_with_all_that_belongs_to_it(valid, tmp_path, call):
    """One bit of one value: its signal, its time, both values to the last digit, and one bit."""
    content = take_apart(valid)
    observer = open_log(valid).channels["observer"]
    column = observer.signal_columns["x_a"].start - observer.start + 1

    def flip(number, values):
        if number == 20:
            values.view(np.uint64)[column] ^= np.uint64(1 << 17)

    change_rows(content, "observer", flip)
    dict(content.metadata)["cosim.env"]["numpy"] = "0.1.2"
    path = put_together(content, tmp_path / "b.mcap")
    right, wrong = (open_log(one)["observer.x_a"][20, 1].item() for one in (valid, path))
    code, _, shown = call("replay", path, "--verify")
    assert code == 1
    values = f"log {wrong!r}, replay {right!r}; 1 of the 64 bits"
    assert f"first: observer.x_a[1] at t = 0.02 s: {values}" in shown
    assert f"numpy was 0.1.2, is {np.__version__}\n" in shown
    statuses = {entry.component: entry.status for entry in verified(path).components}
    assert (statuses.pop("observer"), statuses.pop("plant")) == ("differs", "copied")
    assert set(statuses.values()) == {"equal"}


def test_every_component_that_differs_is_shown_with_its_first_difference(valid):
    """The earliest comes first; a what-if replay does not contradict the log's own scenario."""
    verification = verified(valid, set={"observer.filter_rate": 500.0})
    first, then, table, *others = verification.problems
    assert "first: observer." in first
    assert "then: regressor." in then
    assert "changed scenario: component tables.observer.table" in table
    assert not any("contradicts its scenario" in problem for problem in others)
    differing = {entry.component for entry in verification.components if entry.first is not None}
    assert differing == {"observer", "regressor"}


@pytest.mark.parametrize(
    ("a", "b", "bits", "texts"),
    [
        (0.0, -0.0, 1, ("0.0", "-0.0")),
        (1.0, 1.0, 0, ("1.0", "1.0")),
        (0.1, 0.2, 3, ("0.1", "0.2")),  # the same significand, exponents 0x3fb and 0x3fc
        (1.0, -2.0, 12, ("1.0", "-2.0")),  # 0x3ff and 0xc00
        (float("nan"), -float("nan"), 1, ("nan (0x7ff8000000000000)", "nan (0xfff8000000000000)")),
    ],
)
def test_differing_bits_are_counted(a, b, bits, texts):
    """All of the 64 bits of IEEE 754 count, sign and payload of NaN too."""
    element = ElementDifference("plant.y", 0, a, b)
    assert (element.differing_bits, element.texts) == (bits, texts)


# --- what a log says beside its rows ---


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


# What a replay takes as it stands: its input, and what is said of components that it copies.
TAKEN = {("cosim.run", "edits"), ("cosim.run", "format")}
for key in ("metadata", "fingerprint", "cosim.held", "cosim.design"):
    TAKEN.add(("cosim.component.plant", key))
OF_MACHINE = {"cosim.env", "cosim.written"}


@pytest.mark.slow
def test_no_metadata_can_be_changed_that_a_replay_computes(valid, tmp_path):
    """Whatever entry is altered: the log is refused, or its verification fails."""
    entries = {(name, key) for name, items in take_apart(valid).metadata for key in items}
    noticed = set()
    for name, key in entries:
        try:
            path = forged(valid, tmp_path / "b.mcap", metadata={name: {key: altered}})
            is_noticed = not verified(path).passed
        except CosimError:
            is_noticed = True
        if is_noticed:
            noticed.add((name, key))
    assert {entry for entry in entries - noticed if entry[0] not in OF_MACHINE} <= TAKEN
    assert len(noticed) > 30


def change_result(key):
    """Return what changes an entry of the results."""

    def change(results):
        entry = results[key]
        is_row = isinstance(entry, dict)
        results[key] = {**entry, "identifier.theta[0]": -0.1} if is_row else f"{entry}x"

    return {"results": change}


def metadata(name="cosim.component.observer", **entries):
    """Return other metadata of a log."""
    return {"metadata": {name: entries}}


def eigenvalues(*values):
    """Return other eigenvalues of the observer; [-4, -2] in the log."""
    return metadata(metadata=with_entries(eigenvalues=list(values)))


SINE = 'kind = "sine"\namplitude = 1.0\nrate = 1.0'
STOP = ("stop = 0.05", "stop = 0.06")
MOVED = "component tables.observer.metadata.eigenvalues"
# What a log says instead, and the first statement that is then contradicted; "": none is. A replay
# runs the text; reports show the metadata: the two must be of one scenario.
FORGED = [
    ({"text": ("= [-0.1, -0.3]", "= [-0.1003, -0.2981]")}, "truth.truth"),
    ({"text": STOP}, "times.stop"),
    ({"text": ("stop = 0.05", "stop = 1e9")}, "times.stop"),
    ({"text": ("stop = 0.05", "")}, "times.stop"),
    ({"text": (SINE, 'kind = "fmu"\npath = "x"')}, "component tables.u.table"),
    (
        {"text": ("[connections]", '[swap]\nu = "x.fmu"\n[connections]')},
        "component tables.u.table",
    ),
    ({"text": ('name = "academic"', 'name = "other"')}, "times.scenario"),
    ({"text": ('"observer.u" = "u.y"', '"observer.u" = "delta.y"')}, "connections.observer.u"),
    # a complete run without a stop reason ends where its scenario does
    ({"text": STOP, **metadata("cosim.run", stop="0.06")}, "end of the run [ns]"),
    # the attachment with the results says what the log and the last row say
    *((change_result(key), f"result.json.{key}") for key in ("status", "reason", "end_ns")),
    (change_result("content_hash"), "result.json.content_hash"),
    (change_result("last"), "last row.identifier.theta[0]"),
    ({"results": b"{}"}, "result.json.status"),
    ({"results": b""}, "result.json.status"),
    # order and last digits of eigenvalues are those of the machine that computed them
    (eigenvalues(-2.0000001, -4.0), ""),
    (eigenvalues(-2.2, -4.0), MOVED),
    (eigenvalues(-4.0), MOVED),
    (eigenvalues("x", -2.0), MOVED),
    (eigenvalues(10**400), MOVED),  # no float holds it
    # a component may call its metadata as it likes, also as statements are called
    (metadata(metadata=with_entries(table="{}"), table=altered), "component tables.observer.table"),
]


@pytest.mark.parametrize(("changes", "statement"), FORGED)
def test_what_does_not_follow_from_the_scenario_is_found(valid, tmp_path, changes, statement):
    """Though all checksums are right, and the rows are those of the replay."""
    verification = verified(forged(valid, tmp_path / "b.mcap", **changes))
    assert verification.passed is not bool(statement)
    first = [entry.statement for entry in verification.contradictions[:1]]
    assert first == ([statement] if statement else [])


def scale(*place, factor):
    """Return what multiplies a number of what is said of an identifier."""

    def change(own):
        for key in place[:-1]:
            own = own[key]
        own[place[-1]] *= factor

    return change


NUMBERS = [
    ("parameters", 0, "value"),
    ("amplitudes", 0, 1, "value"),
    ("irregular", "effects", 1, "lower"),
]
ERROR = {"error": "a constant on y", "size": 1.0, "half_widths": {"theta[0]": 3.0}, "text": ""}
VERDICT = "NOT_IDENTIFIABLE"


@pytest.mark.parametrize(
    ("change", "statements"),
    [
        *((scale(*at, factor=1.0 + 1e-3), [".".join(map(str, at))]) for at in NUMBERS),
        # what other processors make of them
        *((scale(*at, factor=1.0 + 1e-9), []) for at in NUMBERS),
        (lambda own: own.update(undetected=[ERROR]), ["undetected"]),
        (lambda own: own["parameters"][0].update(verdict=VERDICT), ["parameters.0.verdict"]),
        # older logs have none of them
        (lambda own: [own.pop(key) for key in ("amplitudes", "undetected", "irregular")], []),
    ],
)
def test_no_estimate_can_be_changed(judged, tmp_path, change, statements):
    """Neither parameter, amplitude, interval nor verdict; no error is undetected that is not."""

    def change_results(results):
        change(results["identification"]["identifier"])

    found = contradicted(forged(judged, tmp_path / "b.mcap", results=change_results))
    assert found == [f"verdicts.identifier.{statement}" for statement in statements]


def paths_of(value, *place):
    """Yield the places of all values in a tree, and of its empty branches."""
    match value:
        case dict() if value:
            items = value.items()
        case [_, *_]:
            items = enumerate(value)
        case _:
            yield place
            return
    for key, own in items:
        yield from paths_of(own, *place, key)


def change_value(own, place):
    """Change a value of a tree such that no rounding explains it, and keep its type."""
    *parents, last = place
    for key in parents:
        own = own[key]
    match own[last]:
        case bool(value):
            own[last] = not value
        case int(value) | float(value):
            own[last] = value * 3 + 1
        case str(value):
            own[last] = f"{value} or not"
        case None:
            own[last] = 1.0
        case []:
            own[last] = [0.5]


@pytest.mark.slow
@pytest.mark.parametrize("log", ["judged", "noisy"])
def test_each_value_of_the_verdicts_counts(log, request, tmp_path):
    """Whatever value is changed: the log is refused, or its verification fails at that place."""
    honest = request.getfixturevalue(log)
    again = cosim.replay(honest)
    content = take_apart(honest)
    attachments = dict(content.attachments)
    places = list(paths_of(json.loads(attachments["result.json"])[IDENTIFICATION]))
    assert len(places) > 30
    missed = []
    for place in places:
        results = json.loads(attachments["result.json"])
        change_value(results[IDENTIFICATION], place)
        changed = {**attachments, "result.json": json.dumps(results).encode()}
        content.attachments = list(changed.items())
        path = put_together(content, tmp_path / "b.mcap")
        try:
            found = list(Statements(open_log(path), again, None).contradictions())
        except LogError:
            continue
        statement = ".".join(map(str, ("verdicts", *place)))
        if [entry.statement for entry in found] not in ([statement], [f"{statement}.0"]):
            missed.append((place, found))
    assert missed == []


@pytest.mark.parametrize(
    ("sentence", "passes"),
    [
        ("theta[0] moves by 3.6 half widths, at 6", True),
        ("theta[0] moves by 3.7 half widths, at 6.1", True),  # as another processor may round
        ("theta[0] moves by 3.8 half widths, at 6", False),
        ("theta[0] moves by -3.6 half widths, at 6", False),
        ("theta[1] moves by 3.6 half widths, at 6", False),
        ("theta[0] moves by 3.6 half widths, at 7", False),
        ("theta[0] moves by 3.6 half widths", False),
        ("theta[0] moves by 3.6e+999999999999 half widths, at 6", False),
    ],
)
def test_numbers_in_sentences_may_differ_in_their_last_digit(judged, tmp_path, sentence, passes):
    """The other words count, and so do whole numbers, which count or name something."""
    again = cosim.replay(judged)
    said = "theta[0] moves by 3.6 half widths, at 6"
    again.results[IDENTIFICATION]["identifier"]["parameters"][0]["reason"] = said

    def change(results):
        results[IDENTIFICATION]["identifier"]["parameters"][0]["reason"] = sentence

    found = verify(open_log(forged(judged, tmp_path / "b.mcap", results=change)), again)
    assert found.passed is passes


def test_what_was_compared_is_said(judged, tmp_path):
    """All components of a whole log are computed or copied; a part has no last row of its run."""
    known = "truth connections schedule times component-tables overrides substeps warnings"
    compared = verified(judged).statements.replace(" ", "-").split(",-")
    assert compared == [*known.split(), "layout-for-viewers", "last-row", "verdicts"]
    part = cut(judged, None, 4.0, tmp_path / "part.mcap")
    assert "last row" not in verify(part, cosim.replay(part)).statements


def test_a_partial_replay_vouches_only_for_what_it_computes(tmp_path):
    """Between rows that were left out no observer is computed: its forged values are unseen."""
    settings = {"scenario.stop": 8.0, "scenario.step": 0.01, "record.every": 7}
    cosim.run("academic", out=tmp_path / "a.mcap", set=settings)

    def forge(results):
        results["identification"]["identifier"]["parameters"][0]["verdict"] = VERDICT
        results["last"]["observer.delta"] = 7.0

    verification = verified(forged(tmp_path / "a.mcap", tmp_path / "b.mcap", results=forge))
    assert verification.passed
    assert not {"verdicts", "truth"} & set(verification.statements.split(", "))
    assert verification.statements.endswith("u, delta")


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
    valid, path = tmp_path / "a.mcap", tmp_path / "b.mcap"
    held = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.05}
    cosim.run("academic", out=valid, set=held)
    assert contradicted(valid) == []
    said = {"cosim.run": {"warnings": "[]"}}
    assert contradicted(forged(valid, path, metadata=said)) == ["warnings.0.0"]
    content = take_apart(valid)
    content.messages = [row for row in content.messages if b"do not trust delta" not in row[3]]
    assert "warnings.1" in contradicted(put_together(content, path))
    forged(valid, path, results=lambda results: results.update(warnings=[]))
    assert contradicted(path) == ["result.json.warnings"]


@pytest.mark.parametrize(("version", "passes"), [("0.0.1", True), (cosim.__version__, False)])
def test_sentences_and_layout_of_another_version_are_not_compared(
    judged, tmp_path, version, passes
):
    """It may say the same in other words; the verification does not claim that it looked."""
    warned = json.dumps([["observer", "a sentence of old"]])
    said = {"cosim.run": {"warnings": warned}, "cosim.env": {"cosim": version}}
    path = forged(judged, tmp_path / "b.mcap", metadata=said)
    content = take_apart(path)
    attachments = dict(content.attachments)
    layout = attachments["viewer-layout.json"]
    attachments["viewer-layout.json"] = layout.replace(b"plant.y", b"plant.z", 1)
    content.attachments = list(attachments.items())
    verification = verified(put_together(content, path))
    places = {one.statement.partition(".")[0] for one in verification.contradictions}
    assert verification.passed is passes
    assert ({"warnings", "layout for viewers"} <= places) is not passes
    compared = verification.statements.split(", ")
    for what, text in (
        ("warnings", "warnings of another version of cosim"),
        ("layout for viewers", "layout for viewers"),
    ):
        assert (what in compared) is not passes
        assert (text in verification.lines[-1]) is passes


# --- what passes, and what is no verification ---


@pytest.mark.fast("pair", "academic")
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
    bad = {"components.bad": {"kind": "expression", "y": "log(0.05 - t)"}}
    with pytest.raises(RunError):
        cosim.run("academic", out=tmp_path / "a.mcap", set=bad)

    def interrupt(time, end):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cosim.run("academic", out=tmp_path / "b.mcap", block=20, progress=interrupt)
    for name, status in (("a.mcap", "failed"), ("b.mcap", "interrupted")):
        assert open_log(tmp_path / name).status == status
        assert verified(tmp_path / name).problems == []


def test_a_log_without_an_estimate_is_not_contradicted_by_a_replay_without_verdicts(tmp_path):
    """There is nothing in it that the replay should have found."""
    short = {"scenario.stop": 0.1, "scenario.step": 0.02}
    log = cosim.run("academic", out=tmp_path / "a.mcap", set=short)
    assert log.results["identification"]["identifier"].keys() == {"problem"}
    again = cosim.replay(log, set={"scenario.verdicts": False})
    assert verify(log, again).contradictions == ()


@pytest.mark.parametrize("changes", [{"record.every": 10}, {"record.signals": ["u.y"]}])
def test_a_replay_that_records_less_than_its_log_verifies_nothing(valid, changes):
    """What it left out would pass unseen; so would all of a run that is no replay."""
    with pytest.raises(UsageError, match="records only"):
        verified(valid, set=changes)
    with pytest.raises(LogError, match="this is not a replay"):
        verify(open_log(valid), open_log(valid))
