"""What a replay proves of its log, and what it does not."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.comparison.difference import ElementDifference
from cosim.log.editing.cutting import cut
from cosim.report.verification import verify
from tests.log.crafting import change_rows, put_together, take_apart
from tests.report.forging import forged, with_own_hash

COPIED = ("plant.y", "plant.x_a", "plant.x_b")


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a short run; return its path."""
    path = tmp_path_factory.mktemp("valid") / "a.mcap"
    cosim.run("academic", out=path, set={"scenario.stop": 0.05})
    return path


@pytest.fixture
def verify_command(call):
    """Verify a log on the command line, and return exit code, stdout and stderr."""
    return lambda path, *options: call("replay", path, "--verify", *options)


def verified(path, **options):
    """Return the verification of a log by its replay."""
    return verify(open_log(path), cosim.replay(path, **options))


def scaled(valid, path, columns, factor, *, is_forged=False):
    """Multiply some columns of the recorded plant, all checksums right; return the path.

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


def test_the_command_line_says_what_was_proven(valid, tmp_path, verify_command):
    """Exit 0 with the signals computed and copied; exit 1 with both hashes."""
    code, out, _ = verify_command(valid, "--json")
    assert code == 0
    shown = json.loads(out)
    log = open_log(valid)
    own = log.recorded_hash
    assert shown["content_hash"] == {"recorded": own, "found": own, "equal": True}
    assert shown["copied"] == list(COPIED)
    assert sorted(shown["computed"] + shown["copied"]) == sorted(log.signals)
    path = scaled(valid, tmp_path / "b.mcap", slice(3, 5), 2.0)
    code, _, err = verify_command(path)
    assert code == 1
    assert f"content hash {open_log(path).content_hash()}, recorded {own}" in err


def test_one_flipped_bit_is_shown_with_all_that_belongs_to_it(valid, tmp_path, verify_command):
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
    right = cosim.open_log(valid)["observer.x_a"][20, 1].item()
    wrong = cosim.open_log(path)["observer.x_a"][20, 1].item()
    assert wrong != right
    code, _, shown = verify_command(path)
    assert code == 1
    values = f"log {wrong!r}, replay {right!r}; 1 of the 64 bits"
    assert f"first: observer.x_a[1] at t = 0.02 s: {values}" in shown
    assert f"numpy was 0.1.2, is {np.__version__}\n" in shown
    assert "then" not in shown
    _, out, _ = verify_command(path, "--json")
    found = json.loads(out)
    first = found["first"]
    assert (first["signal"], first["time_ns"]) == ("observer.x_a[1]", 20_000_000)
    assert (first["a"], first["b"], first["differing_bits"]) == (wrong, right, 1)
    patterns = [int(text, 16) for text in first["bits"]]
    assert patterns == np.array([wrong, right]).view(np.uint64).tolist()
    assert found["environment"] == {"numpy": {"recorded": "0.1.2", "present": np.__version__}}
    statuses = {entry["component"]: entry["status"] for entry in found["components"]}
    assert statuses.pop("observer") == "differs"
    assert statuses.pop("plant") == "copied"
    assert set(statuses.values()) == {"equal"}
    assert list(found["components"][0]) == ["component", "status", "first", "reason"]


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
    assert element.differing_bits == bits
    assert element.texts == texts


def test_only_a_replay_is_verified(valid):
    """A run says nothing of what was copied."""
    with pytest.raises(LogError, match="this is not a replay"):
        verify(open_log(valid), open_log(valid))


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """Record a run that is long enough for a verdict; return its path."""
    path = tmp_path_factory.mktemp("identified") / "a.mcap"
    cosim.run("academic", out=path, set={"scenario.stop": 8.0, "scenario.step": 0.01})
    return path


def forge(results):
    """Give other verdicts, and another last row."""
    for parameter in results["identification"]["identifier"]["parameters"]:
        parameter["verdict"] = "NOT_IDENTIFIABLE"
    for label in results["last"]:
        if label.startswith("observer."):
            results["last"][label] = 7.0


def test_a_partial_replay_vouches_only_for_what_it_computes(tmp_path):
    """Between rows that were left out no observer is computed: its forged values are unseen."""
    settings = {"scenario.stop": 8.0, "scenario.step": 0.01, "record.every": 7}
    cosim.run("academic", out=tmp_path / "a.mcap", set=settings)
    path = forged(tmp_path / "a.mcap", tmp_path / "b.mcap", results=forge)
    verification = verified(path)
    assert verification.passed
    assert not {"verdicts", "truth"} & set(verification.statements.split(", "))
    assert verification.statements.endswith("u, delta")


@pytest.mark.slow
def test_forged_verdicts_are_found_where_they_are_said_to_agree(identified, tmp_path):
    """All components of a whole log are computed or copied."""
    known = "truth connections schedule times component-tables overrides substeps warnings"
    compared = verified(identified).statements.replace(" ", "-").split(",-")
    assert compared == [*known.split(), "last-row", "verdicts"]
    path = forged(identified, tmp_path / "b.mcap", results=forge)
    found = {entry.statement for entry in verified(path).contradictions}
    verdict = "verdicts.identifier.parameters.0.verdict"
    assert {verdict, "last row.observer.u"} <= found


def test_a_part_is_not_said_to_have_the_last_row_of_the_replay(identified, tmp_path):
    """What its result says of a last row is that of the whole run, and not compared."""
    part = cut(identified, None, 4.0, tmp_path / "part.mcap")
    assert "last row" not in verify(part, cosim.replay(part)).statements


@pytest.mark.parametrize(
    "changes", [{"record.every": 10}, {"record.signals": ["u.y"]}], ids=["every", "signals"]
)
def test_a_replay_that_records_less_than_its_log_verifies_nothing(valid, changes):
    """What it left out would pass unseen."""
    with pytest.raises(UsageError, match="records only"):
        verified(valid, set=changes)


def test_the_end_of_a_verified_replay_is_that_of_the_log(valid, verify_command):
    """As for ``--stop``: what is behind would not be compared."""
    code, _, err = verify_command(valid, "--set", "scenario.stop=0.02")
    assert code == 2
    assert "omit --set scenario.stop" in err
