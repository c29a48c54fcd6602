"""The dataset of a study: what is added is there, once, bit for bit, whenever its writer ends."""

import json
import math
import os
import random
import shutil
import sys
from contextlib import suppress
from itertools import islice

import pandas
import pyarrow.dataset
import pytest

import cosim
from cosim.errors import DatasetError, DatasetWriteError, UsageError
from cosim.studies import dataset as dataset_module
from cosim.studies import storage
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset import StudyDataset
from cosim.studies.identity import (
    StudyColumn,
    StudyIdentity,
    differences,
    metric_column,
    parameter_column,
    result_columns,
    scenario_digests,
)

SCENARIO = {
    "scenario": {"stop": 1.0, "step": 0.1},
    "components": {"a": {"kind": "lag"}, "b": {"kind": "sine"}},
    "record": {},
}
DIGESTS = scenario_digests(SCENARIO) | {"FMU plant.fmu": "cd", "the metrics": "ef"}
RATE, SEED = "observer.filter_rate", "noise.seed"
COLUMNS = (
    StudyColumn(RATE, "parameter", "double", "rad/s"),
    StudyColumn(SEED, "parameter", "int64"),
    metric_column("error", "rms(observer.delta - delta.y)"),
    StudyColumn("late", "metric", "double", "s", "first(t, plant.y > 1)"),
)
COUNT = 60
FAILED = [3, 10, 17, 24]


def identity(members, *, of=COLUMNS, **others):
    """Return what the study is about."""
    values = {"text": '[study]\nscenario = "academic"\n', "digests": DIGESTS, "version": "1.0"}
    return StudyIdentity("tolerances", columns=of, members=members, **(values | others))


def opened(folder, count, values=None, **given):
    """Open the dataset of a study, or make it; ``values`` are planned otherwise, by column."""
    columns = {SEED: [n % 5 for n in range(count)], RATE: list(map(rate, range(count)))}
    columns |= values or {}
    given = {"identity": identity(count), "planned": lambda key, i, j: columns[key][i:j], **given}
    return StudyDataset.open_or_create(folder, **given)


def rate(number):
    return 10.0 * 1.1 ** (number % 97)


def add(dataset, numbers, seed=0):
    """Add the outcomes of members: every seventh failed, some have no ``late``."""
    for number in numbers:
        outcome = MemberOutcome(number, "failed", f"NaN at {number} s", number, {}, seed, "")
        if number % 7 != 3:
            late = number / 3 if number % 4 else None
            metrics = {"error": 1.0 / (number + 1), "late": late}
            outcome = MemberOutcome(number, "complete", "", 1000, metrics, seed, "here")
        dataset.add(StudyMember(number, {RATE: rate(number), SEED: number % 5}), outcome)


def complete(dataset, seed, report=lambda number: None):
    """Run what is missing; members end in the order in which workers may end them."""
    chance = random.Random(seed)
    numbers = [number for absent in dataset.missing() for number in absent]
    while numbers:
        number = numbers.pop(chance.randrange(min(30, len(numbers))))
        add(dataset, [number], seed)
        report(number)


def content(folder):
    """Return what must not depend on how a study was run."""
    return StudyDataset.open(folder).read().drop_columns(["wall_time", "worker", "log"])


def numbers_in(folder):
    """Return the members that are there, in the order in which they are read."""
    return StudyDataset.open(folder).read(["member"])["member"].to_pylist()


def parts(folder):
    """Return the first and last members of parts."""
    names = sorted(path.name for path in (folder / "parts").glob("*.parquet"))
    return [(int(name[5:15]), int(name[16:26])) for name in names]


@pytest.fixture
def folder(tmp_path, parts_of_ten):
    """Return a study of 30 with two parts and a journal."""
    with opened(tmp_path / "x", 30) as dataset:
        add(dataset, range(25))
    return tmp_path / "x"


@pytest.fixture
def undisturbed(tmp_path, parts_of_ten):
    """Return the content of a study that was never disturbed."""
    with opened(tmp_path / "whole", COUNT) as dataset:
        complete(dataset, 0)
    return content(tmp_path / "whole")


# --- rows ---


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("double", [0.1, -0.0, 5e-324, math.inf, None]),
        ("double", [1, 0.5, 2**53, None, -0.0]),
        ("int64", [2**62 + 1, -(2**63), 2**63 - 1, None, 0]),
        ("json", [2**63, 1, -(10**30), None, 2**80]),
        ("json", ["auto", 3, {"kind": "sine", "rate": 1.5}, [1, "a"], None]),
        ("json", [1.5, True, None, 2**53 + 1, "1"]),
        ("bool", [True, False, None, True, True]),
        ("string", ["a.fmu", "b ä.fmu", "", "\n", '"']),
        ("list<double>", [[1.0, 2.0], [], [1 / 3], None, [-0.0, math.inf]]),
    ],
)
def test_values_of_every_type_come_back(tmp_path, parts_of_ten, kind, values):
    """Bit for bit, of parts and of the journal; what has no type of its own is JSON."""
    values = values * 3
    column = parameter_column("x", values)
    assert column.type == kind
    given = {"identity": identity(16, of=(column,)), "values": {"x": values}}
    with opened(tmp_path, 16, **given) as dataset:
        for number, value in enumerate(values):
            member = StudyMember(number, {} if value is None else {"x": value})
            dataset.add(member, MemberOutcome(number, "complete"))
    assert parts(tmp_path) == [(0, 9)]
    found = [column.value(stored) for stored in cosim.open_study(tmp_path).table()["x"].to_pylist()]
    if kind == "double":
        values = [None if value is None else float(value) for value in values]
    assert repr(found) == repr(values)
    opened(tmp_path, 16, **given).close()


def test_members_and_outcomes_come_back_from_their_rows(tmp_path):
    """Keys, swaps and logs; NaN is none; what has no column of its own or another type is JSON."""
    values = {"mixed": {"kind": "sine"}, "swap.plant": "b ä.fmu", "recording": "one.mcap"}
    columns = [parameter_column(name, [value]) for name, value in values.items()]
    columns += [metric_column("y", ""), *result_columns({"plant.y": 1.5, "verdict": "good"}, ["y"])]
    member = StudyMember(0, {"mixed": {"kind": "sine"}}, {"plant": "b ä.fmu"}, "one.mcap")
    said = {"y": math.nan, "plant.y": "none", "verdict": "identifiable", "other.z": 2.0}
    outcome = MemberOutcome(0, "complete", "\udcff", 1, said, 0.0, "", ("a", "b"))
    with StudyDataset.open_or_create(tmp_path, identity(2, of=tuple(columns))) as dataset:
        row = dataset.row_of(member, outcome)
        dataset.add(member, outcome)
        dataset.add(StudyMember(1), MemberOutcome(1, "complete", metrics={"y": -0.0}))
    study = cosim.open_study(tmp_path)
    assert study.members([0, 1]) == [member, StudyMember(1)]
    first, second = study.table().drop_columns("log").to_pylist()
    assert first == row
    assert (first["y"], first["plant.y"], first["verdict"]) == (None, None, "identifiable")
    assert json.loads(first["other_results"]) == {"plant.y": "none", "other.z": 2.0}
    assert (first["reason"], first["warnings"]) == ("\\udcff", "a\nb")
    assert repr(second["y"]) == "-0.0"


def test_rows_are_read_in_the_order_of_members(tmp_path, parts_of_ten):
    """By chosen columns and members too, whatever the order in which they ended."""
    with opened(tmp_path, 25) as dataset:
        assert dataset.missing() == [range(25)]
        add(dataset, [*range(19, 9, -1), 23, 2, 20])
        assert dataset.missing() == [range(2), range(3, 10), range(21, 23), range(24, 25)]
        assert len(dataset) == 13
        with pytest.raises(AssertionError):
            add(dataset, [12])
    (tmp_path / "logs").mkdir()
    kept = [tmp_path / "logs" / name for name in ("2.mcap", "11.mcap", "20.txt")]
    for path in kept:
        path.touch()
    dataset = StudyDataset.open(tmp_path)
    assert dataset.read()["member"].to_pylist() == [2, *range(10, 21), 23]
    table = dataset.read(["log", SEED], [21, 2, 24, 11, 20])
    assert table.to_pydict() == {"log": [*map(str, kept[:2]), None], SEED: [2, 1, 0]}
    with pytest.raises(DatasetError, match=r"no column 'noise.sed'; did you mean 'noise.seed'"):
        dataset.read(["noise.sed"])
    assert (tmp_path / "_journal.jsonl").read_bytes().count(b"\n") <= 6


def test_a_study_grows_from_part_to_part(tmp_path, parts_of_ten):
    """Parts are never changed: the next one begins where the last one ended."""
    with opened(tmp_path, 25) as dataset:
        add(dataset, range(24))
    for count, absent in [(1000, 976), (27, 3), (28, 1), (41, 13)]:
        before = {path: path.read_bytes() for path in (tmp_path / "parts").iterdir()}
        with opened(tmp_path, count) as dataset:
            assert sum(map(len, dataset.missing())) == absent
            if count < 1000:  # a study that was planned larger may end before
                complete(dataset, count)
        assert all(path.read_bytes() == content for path, content in before.items())
    assert parts(tmp_path) == [(0, 9), (10, 19), (20, 26), (27, 27), (28, 29), (30, 39), (40, 40)]
    with opened(tmp_path / "whole", 41) as dataset:
        complete(dataset, 0)
    assert content(tmp_path).equals(content(tmp_path / "whole"))
    assert (tmp_path / "_journal.jsonl").read_bytes() == b""
    with pytest.raises(DatasetError, match="member 40 is recorded, but only 12 members are plan"):
        opened(tmp_path, 12)


# --- kills and full disks ---

CALLS = ["write", "ftruncate", "fsync", "replace", "unlink"]  # of the system, that change files


class Killed(BaseException):
    """Ends a process that can do nothing about it: no file is changed any more."""


def run_until(folder, sizes, cut, error, added):
    """Write a dataset that grows, until so many calls were made; list what was added.

    The next call, if it writes, writes half; from then on calls have an error, on a full disk those
    that write.
    """
    made = []

    def failing(name, call):
        def fail(*arguments):
            assert name != "replace" or made[-1] == "fsync"  # or a power cut leaves an empty file
            made.append(name)
            if len(made) == cut + 1 and name == "write":
                call(arguments[0], arguments[1][: len(arguments[1]) // 2])
            if len(made) <= cut or (error is not Killed and name != "write"):
                return call(*arguments)
            raise error

        return fail

    with pytest.MonkeyPatch.context() as patch, suppress(Killed):
        for name in CALLS:
            patch.setattr(os, name, failing(name, getattr(os, name)))
        for size in sizes:
            with opened(folder, size) as dataset:
                complete(dataset, cut, added.append)


@pytest.mark.parametrize("instants", [12, pytest.param(120, marks=pytest.mark.campaign)])
def test_a_study_that_is_killed_at_any_instant_goes_on(tmp_path, undisturbed, instants):
    """What was added is there, once; in the end the content is that of an undisturbed study."""
    for cut in random.Random(instants).sample(range(120), instants):
        folder = tmp_path / str(cut)
        added = []
        run_until(folder, [35, COUNT], cut, Killed, added)
        run_until(folder, [COUNT], cut // 2 + 3, Killed, added)
        opened(folder, COUNT).close()
        left = numbers_in(folder)
        assert left == sorted(set(left))
        assert set(added) <= set(left)
        with opened(folder, COUNT) as dataset:
            complete(dataset, 1)
        assert content(folder).equals(undisturbed)
        assert not list(folder.rglob("_*tmp"))


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 15, 16, 40, 70, 85])
def test_a_full_disk_ends_a_study_that_goes_on_later(tmp_path, undisturbed, cut):
    """Wherever it is noticed: in the description, the journal, or a part."""
    folder = tmp_path / "x"
    full = OSError(28, os.strerror(28))
    added = []
    with pytest.raises(DatasetWriteError, match=r"No space left on device; what was recorded"):
        run_until(folder, [COUNT], cut, full, added)
    with opened(folder, COUNT) as dataset:
        assert set(added) <= set(numbers_in(folder))
        assert len(dataset) <= len(added) + 1  # the member whose part could not be written
        complete(dataset, 2)
    assert content(folder).equals(undisturbed)
    assert not list(folder.rglob("_*tmp"))


def test_who_reads_while_a_study_runs_misses_nothing_that_was_there_before(tmp_path, parts_of_ten):
    """Whatever moves from the journal into a part just then."""
    numbers = iter(range(COUNT))

    def going_on(method):
        def read(folder, *name):
            found = method(folder, *name)
            if name in [(dataset_module.JOURNAL,), (dataset_module.PARTS,)]:  # the writer goes on
                add(dataset, islice(numbers, 5))
            return found

        return read

    with opened(tmp_path, COUNT) as dataset:
        add(dataset, islice(numbers, 5))
        for before in (5, 15, 25, 35):
            with pytest.MonkeyPatch.context() as patch:
                for name in ("read", "names"):
                    patch.setattr(storage.Storage, name, going_on(getattr(storage.Storage, name)))
                found = numbers_in(tmp_path)
            assert found == sorted(set(found))
            assert set(range(before)) <= set(found) <= set(range(before + 10))
        earlier = cosim.open_study(tmp_path)
        complete(dataset, 0)
        assert earlier.table(["member"])["member"].to_pylist() == list(range(45))


def test_two_studies_cannot_write_one_dataset_at_once(folder):
    """The second is refused while the first writes; who reads is not."""
    with opened(folder, 30):
        with pytest.raises(DatasetError, match=rf"is writing there \(process {os.getpid()}\)"):
            opened(folder, 30, new=True)
        assert len(StudyDataset.open(folder)) == 25
    opened(folder, 30).close()


# --- damage ---


@pytest.mark.parametrize("stride", [83, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_flipped_bit_is_named_or_harmless(folder, stride):
    """Anywhere in any file: never is anything read that was not written."""
    rows = {row["member"]: row for row in content(folder).to_pylist()}
    named = []
    for path in [*folder.glob("*.json*"), *folder.glob("parts/*")]:
        whole = path.read_bytes()
        for place in range(0, len(whole), stride):
            flipped = whole[place] ^ (1 << place // stride % 8)
            path.write_bytes(whole[:place] + bytes([flipped]) + whole[place + 1 :])
            try:
                found = content(folder)
            except DatasetError as error:
                named.append((str(path), str(error)))
            else:
                assert all(rows[row["member"]] == row for row in found.to_pylist())
                assert len(found) >= 24  # the last line of a journal, as one that was cut
        path.write_bytes(whole)
    assert len(named) > 100
    assert all(path in text for path, text in named)


def test_what_is_damaged_is_removed_and_run_again(folder):
    """A part, and a line of the journal; one that a kill has cut is dropped by itself."""
    expected = content(folder)
    journal = folder / "_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join([lines[0], b"[1, 2\n", *lines[1:]]))
    with pytest.raises(DatasetError, match=r"_journal.jsonl: line 2 is damaged; remove that line"):
        StudyDataset.open(folder)
    journal.write_bytes(b"".join(lines)[:-9])
    part = min((folder / "parts").iterdir())
    part.write_bytes(part.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"part-0000000000-.*damaged.* remove it and run the st"):
        content(folder)
    part.unlink()
    with opened(folder, 30) as dataset:
        assert dataset.missing() == [range(10), range(24, 30)]
        add(dataset, [*range(10), 24])
    assert content(folder).equals(expected)


def test_files_of_another_dataset_are_none_of_this_one(folder, tmp_path):
    """Though it is one of the same study, or this one was begun anew while it is read."""
    with opened(tmp_path / "y", 30) as dataset:
        add(dataset, range(25), seed=1)
    reader = StudyDataset.open(folder)
    path, other = (min((place / "parts").iterdir()) for place in (folder, tmp_path / "y"))
    shutil.copy(other, folder / "parts")
    with pytest.raises(DatasetError, match=f"{other.name}: damaged, or of another one"):
        content(folder)
    path.unlink()
    with pytest.raises(DatasetError, match=f"{path.name}: removed while it was read"):
        reader.read()
    shutil.copy(tmp_path / "y" / "_journal.jsonl", folder)
    with pytest.raises(DatasetError, match="line 1 is damaged"):
        content(folder)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"format": 2, "cosim": "0.2.0"}, r"format 3, got 2; read it with cosim 0\.2\.0"),
        ({"format": 4}, r"format 3, got 4; read it with cosim 1\.0"),
        ({"study": {"members": 31}}, "study.json is damaged; .* new=True"),
    ],
)
def test_other_formats_and_damaged_descriptions_are_refused(folder, changes, text):
    """Those that were written before have the version as ``cosim``."""
    path = folder / "study.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(DatasetError, match=text):
        opened(folder, 30)
    with opened(folder, 30, new=True) as dataset:
        assert dataset.missing() == [range(30)]


# --- whose dataset it is ---


def test_another_study_is_refused_by_what_differs(folder):
    """Whatever the order of its keys. A new beginning removes the files of the dataset only."""
    mine = [folder / "notes.txt", folder / "parts" / "mine.parquet"]
    for path in mine:
        path.touch()
    before = content(folder)
    changed = SCENARIO | {"scenario": {"stop": 1, "until": "t > 1"}}
    changed["components"] = dict(reversed(SCENARIO["components"].items()))
    of = (parameter_column(SEED, [0.5]), *COLUMNS[2:])
    for other, text in (
        (
            identity(5, digests=scenario_digests(changed) | {"the metrics": "00"}),
            "key scenario.stop changed; key scenario.step is no longer part of it; FMU plant.fmu "
            "is no longer part of it; the metrics changed; key scenario.until is new",
        ),
        (
            identity(5, version="2.0", of=of),
            "the version of cosim was 1.0, is 2.0; varied key observer.filter_rate is no longer "
            "part of it; varied key noise.seed was int64, is double",
        ),
    ):
        with pytest.raises(DatasetError) as caught:
            StudyDataset.open_or_create(folder, other)
        assert str(caught.value) == (
            f"{folder} holds the dataset of another study: {text}; choose another folder, or use "
            "new=True to delete it and start over"
        )
    many = identity(5, digests={f"key a.{n}": "" for n in range(20)})
    assert differences(identity(5, digests={}), many).endswith("key a.7 is new; and 12 more")
    assert content(folder).equals(before)
    with StudyDataset.open_or_create(folder, other, new=True) as dataset:
        assert dataset.missing() == [range(5)]
    assert [*(folder / "parts").iterdir()] == mine[1:]
    assert mine[0].exists()


def test_files_that_a_study_is_grown_by_belong_to_it(folder):
    """From then on; those of a study that is planned need not be all."""
    opened(folder, 40, identity=identity(40, digests=DIGESTS | {"FMU other.fmu": "12"})).close()
    with pytest.raises(DatasetError, match=r"another study: FMU other.fmu is no longer part of it"):
        opened(folder, 40)


def test_members_that_were_renumbered_are_refused_by_the_first(folder):
    """Bit for bit; of those that are recorded."""
    seeds, rates = [n % 5 for n in range(30)], [rate(n) for n in range(30)]
    seeds[21] = 4
    rates[29] = 0.0  # not recorded yet
    with pytest.raises(DatasetError, match=r"member 21 was noise.seed = 1, is 4; members keep"):
        opened(folder, 30, {SEED: seeds, RATE: rates})
    rates[7] += 2**-40
    with pytest.raises(DatasetError, match=r"member 7 was observer.filter_rate = 19.487171"):
        opened(folder, 30, {SEED: seeds, RATE: rates})


def test_what_is_no_dataset_is_left_alone(folder, tmp_path):
    """Parts of nobody, a file of another program, two columns of one name, no dataset, no path."""
    (folder / "study.json").unlink()
    with pytest.raises(DatasetError, match=r"belongs to a dataset, but no study.json says to wh"):
        opened(folder, 30)
    (folder / "study.json").write_text('{"a": 1}')
    with pytest.raises(DatasetError, match=r"study\.json is not that of a dataset; choose another"):
        opened(folder, 30, new=True)
    assert (folder / "study.json").read_text() == '{"a": 1}'
    assert len(parts(folder)) == 2
    for names in (["status"], ["y", "y"]):
        of = tuple(metric_column(name, "") for name in names)
        with pytest.raises(DatasetError, match="already has this name"):
            opened(tmp_path / "y", 3, identity=identity(3, of=of))
    with pytest.raises(DatasetError, match=r"no study.json there; expected the dataset of a stud"):
        cosim.open_study(tmp_path / "y")
    with pytest.raises(UsageError, match="got an empty path"):
        opened("", 3)
    assert not (tmp_path / "y").exists()


# --- readers ---


@pytest.mark.slow
def test_other_programs_read_the_parts(folder):
    """By their folder or a pattern; what a kill has left of a part is none."""
    import duckdb
    import polars

    with opened(folder, 30) as dataset:
        complete(dataset, 0)
    (folder / "parts" / "_part-0000000030-0000000039-0.parquet.cosim-tmp").write_bytes(b"PAR1")
    study = cosim.open_study(folder)
    table = pyarrow.dataset.dataset(folder / "parts", ignore_prefixes=["_"]).to_table()
    assert table.equals(study.table().drop_columns("log"))
    assert table.schema.field("late").metadata[b"unit"] == b"s"
    errors = [None if number in FAILED else 1.0 / (number + 1) for number in range(30)]
    frame = polars.read_parquet(folder / "parts" / "part*.parquet")
    assert frame["error"].to_list() == study.to_polars()["error"].to_list() == errors
    query = f"select member from '{folder}/parts/*.parquet' where error is null order by member"
    assert duckdb.sql(query).fetchall() == [(number,) for number in FAILED]
    frame = pandas.read_parquet(folder / "parts")
    assert frame["member"][frame["error"].isna()].tolist() == FAILED


def test_a_study_says_what_it_holds(folder, monkeypatch):
    """Its names, units and failures; as a frame of pandas by member."""
    study = cosim.open_study(str(folder))
    assert study.parameters == (RATE, SEED)
    assert study.metrics == ("error", "late")
    assert study.columns[0] == "member"
    assert study.units == {RATE: "rad/s", "late": "s", "wall_time": "s"}
    assert study.failures == {n: f"NaN at {n} s" for n in FAILED}
    assert (study.logs, study.warnings) == ({}, {})
    assert repr(study) == "<Study 'tolerances': 25 of 30 members>"
    frame = study.to_pandas(["error"])
    assert (frame.index.tolist(), frame.columns.tolist()) == ([*range(25)], ["error"])
    assert [member.number for member in study.members([7, 5, 29])] == [5, 7]
    with pytest.raises(UsageError, match="no outcome of member 29; available: 25 of 30"):
        study.member(29)
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(UsageError, match=r"to_polars needs polars, .* pip install polars"):
        study.to_polars()
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match="studies need pyarrow, which is not installed: pip inst"):
        cosim.open_study(folder)
