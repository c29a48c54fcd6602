"""The dataset of a study: what is added is there, once, bit for bit, whenever its writer ends."""

import json
import math
import multiprocessing
import os
import random
import shutil
import signal
import sys
from contextlib import suppress

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

DIGESTS = {"key scenario.stop": "ab", "FMU plant.fmu": "cd", "the metrics": "ef"}
COLUMNS = (
    StudyColumn("observer.filter_rate", "parameter", "double", "rad/s"),
    StudyColumn("noise.seed", "parameter", "int64"),
    metric_column("error", "rms(observer.delta - delta.y)"),
    StudyColumn("late", "metric", "double", "s", "first(t, plant.y > 1)"),
)
SESSION = ["wall_time", "worker"]  # what differs between sessions
FAILED = [3, 10, 17, 24]


def planned_by(values):
    """Return what returns the planned values of parameters of some members."""
    return lambda name, begin, end: values[name][begin:end]


def design(count):
    """Return the planned parameters."""
    return {
        "observer.filter_rate": [10.0 * 1.1 ** (number % 97) for number in range(count)],
        "noise.seed": [number % 5 for number in range(count)],
    }


def identity(members, *, of=COLUMNS, **others):
    """Return what the study is about."""
    values = {"text": '[study]\nscenario = "academic"\n', "digests": DIGESTS, "version": "1.0"}
    return StudyIdentity("tolerances", columns=of, members=members, **(values | others))


def add(dataset, numbers, seed=0):
    """Add the outcomes of members: every seventh failed, some have no ``late``."""
    for number in numbers:
        values = {"observer.filter_rate": 10.0 * 1.1 ** (number % 97), "noise.seed": number % 5}
        outcome = MemberOutcome(number, "failed", f"NaN at {number} s", number, {}, seed, "")
        if number % 7 != 3:
            late = number / 3 if number % 4 else None
            metrics = {"error": 1.0 / (number + 1), "late": late}
            outcome = MemberOutcome(number, "complete", "", 1000, metrics, seed, "here")
        dataset.add(StudyMember(number, values), outcome)


def opened(folder, count, **given):
    """Open the dataset of a study, or make it."""
    return StudyDataset.open_or_create(
        folder, identity(count), planned=planned_by(design(count)), **given
    )


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
    return StudyDataset.open(folder).read().drop_columns([*SESSION, "log"])


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
    given = {"identity": identity(16, of=(column,)), "planned": planned_by({"x": values})}
    with StudyDataset.open_or_create(tmp_path, **given) as dataset:
        for number, value in enumerate(values):
            member = StudyMember(number, {} if value is None else {"x": value})
            dataset.add(member, MemberOutcome(number, "complete"))
    assert parts(tmp_path) == [(0, 9)]
    found = [column.value(stored) for stored in cosim.open_study(tmp_path).table()["x"].to_pylist()]
    as_doubles = [None if value is None else float(value) for value in values * (kind == "double")]
    assert repr(found) == repr(as_doubles or values)
    StudyDataset.open_or_create(tmp_path, **given).close()


def test_members_come_back_from_their_rows(tmp_path):
    """Keys, swaps and logs of a member; a metric that is NaN is none."""
    values = {"mixed": {"kind": "sine"}, "swap.plant": "b ä.fmu", "recording": "one.mcap"}
    columns = [parameter_column(name, [value]) for name, value in values.items()]
    members = [StudyMember(0, {"mixed": {"kind": "sine"}}, {"plant": "b ä.fmu"}, "one.mcap")]
    members += [StudyMember(1)]
    planned = identity(2, of=(*columns, metric_column("y", "")))
    with StudyDataset.open_or_create(tmp_path, planned) as dataset:
        for member, y in zip(members, (math.nan, -0.0), strict=True):
            dataset.add(member, MemberOutcome(member.number, "complete", metrics={"y": y}))
    study = cosim.open_study(tmp_path)
    assert study.members([0, 1]) == members
    assert repr(study.table()["y"].to_pylist()) == "[None, -0.0]"


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
    for name in ("2.mcap", "11.mcap", "20.txt"):
        (tmp_path / "logs" / name).touch()
    dataset = StudyDataset.open(tmp_path)
    assert dataset.read()["member"].to_pylist() == [2, *range(10, 21), 23]
    table = dataset.read(["log", "noise.seed"], [21, 2, 24, 11, 20])
    assert table.column_names == ["log", "noise.seed"]
    kept = [str(tmp_path / "logs" / name) for name in ("2.mcap", "11.mcap")]
    assert table["log"].to_pylist() == [*kept, None]
    assert table["noise.seed"].to_pylist() == [2, 1, 0]
    with pytest.raises(DatasetError, match=r"no column 'noise.sed'; did you mean 'noise.seed'"):
        dataset.read(["noise.sed"])
    assert (tmp_path / "_journal.jsonl").read_bytes().count(b"\n") <= 6


def test_what_has_no_column_of_its_own_is_kept_as_json(tmp_path):
    """Results of other names or types; texts that are no Unicode are written with escapes."""
    results = result_columns({"plant.y": 1.5, "verdict": "good", "late": 3.0}, ["late"])
    with StudyDataset.open_or_create(tmp_path, identity(1, of=results)) as dataset:
        said = {"plant.y": "none", "verdict": "identifiable", "other.z": 2.0}
        outcome = MemberOutcome(0, "complete", "\udcff", 1, said, 0.0, "", ("a", "b"))
        row = dataset.row_of(StudyMember(0), outcome)
        dataset.add(StudyMember(0), outcome)
    (found,) = StudyDataset.open(tmp_path).read().drop_columns("log").to_pylist()
    assert found == row
    assert found["plant.y"] is None
    assert found["verdict"] == "identifiable"
    assert json.loads(found["other_results"]) == {"plant.y": "none", "other.z": 2.0}
    assert found["reason"] == "\\udcff"
    assert found["warnings"] == "a\nb"


# --- growth ---


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


def test_parts_of_a_thousand_grow_within_and_across(tmp_path):
    """As users have them."""
    for count in (700, 1300, 2500):
        with opened(tmp_path, count) as dataset:
            complete(dataset, count)
    assert parts(tmp_path) == [(0, 699), (700, 999), (1000, 1299), (1300, 1999), (2000, 2499)]
    table = StudyDataset.open(tmp_path).read(["noise.seed"])
    assert table["noise.seed"].to_pylist() == design(2500)["noise.seed"]


# --- kills and full disks ---

COUNT = 60
CALLS = ["write", "ftruncate", "fsync", "replace", "unlink"]  # of the system, that change files
processes = multiprocessing.get_context("forkserver")
processes.set_forkserver_preload([__name__])


def write(pipe, folder, cut):
    """Make a dataset that grows, or go on with it, until the call that kills this process."""
    dataset_module.PART_SIZE = 10
    calls = iter(range(10**9))

    def cutting(call):
        def killing(*arguments):
            if next(calls) < cut:
                return call(*arguments)
            if call is os_write:  # half of it
                call(arguments[0], arguments[1][: len(arguments[1]) // 2])
            os.kill(os.getpid(), signal.SIGKILL)

        return killing

    os_write = os.write
    for name in CALLS:
        setattr(os, name, cutting(getattr(os, name)))
    for count in (35, COUNT):
        with opened(folder, count) as dataset:
            complete(dataset, cut, pipe.send)
    pipe.send(None)


def killed(folder, cut):
    """Return the members that a process has added until it was killed; None: it has not been."""
    receiver, sender = processes.Pipe(duplex=False)
    process = processes.Process(target=write, args=(sender, folder, cut))
    process.start()
    sender.close()
    added = []
    with suppress(EOFError):
        while True:
            added.append(receiver.recv())
    process.join()
    return added


@pytest.mark.skipif(sys.platform == "win32", reason="no signals to kill with")
@pytest.mark.parametrize("instants", [20, pytest.param(150, marks=pytest.mark.campaign)])
def test_a_study_that_is_killed_at_any_instant_goes_on(tmp_path, parts_of_ten, instants):
    """What was added is there, once; in the end the content is that of an undisturbed study."""
    with opened(tmp_path / "whole", COUNT) as dataset:
        complete(dataset, 0)
    expected = content(tmp_path / "whole")
    for cut in sorted(random.Random(instants).sample(range(150), instants)):
        folder = tmp_path / str(cut)
        added = killed(folder, cut)
        if None in added:
            break
        added += killed(folder, cut // 2 + 3)
        opened(folder, COUNT).close()
        left = StudyDataset.open(folder).read(["member"])["member"].to_pylist()
        assert left == sorted(set(left))
        assert set(added) - {None} <= set(left)
        with opened(folder, COUNT) as dataset:
            complete(dataset, 1)
        assert content(folder).equals(expected)
        assert not list(folder.rglob("_*tmp"))
    assert cut > 90


@pytest.mark.parametrize("room", [1, 700, 1700, 2000, 5000, 9000, 20000])
def test_a_full_disk_ends_a_study_that_goes_on_later(tmp_path, parts_of_ten, monkeypatch, room):
    """Wherever it is noticed: in the description, the journal, or a part."""
    with opened(tmp_path / "whole", COUNT) as dataset:
        complete(dataset, 0)
    added = []
    os_write = os.write
    left = [room]

    def full(descriptor, content):
        if not left[0]:
            raise OSError(28, os.strerror(28))
        written = os_write(descriptor, content[: left[0]])
        left[0] -= written
        return written

    with monkeypatch.context() as patch:
        patch.setattr(storage.os, "write", full)
        with (
            pytest.raises(DatasetWriteError, match=r"No space left on device; what was recorded"),
            opened(tmp_path / "x", COUNT) as dataset,
        ):
            complete(dataset, 1, added.append)
    with opened(tmp_path / "x", COUNT) as dataset:
        assert set(added) <= set(dataset.read(["member"])["member"].to_pylist())
        assert len(dataset) <= len(added) + 1  # the member whose part could not be written
        complete(dataset, 2)
    assert content(tmp_path / "x").equals(content(tmp_path / "whole"))
    assert not list((tmp_path / "x").rglob("_*tmp"))


def test_who_reads_while_a_study_runs_misses_nothing_that_was_there_before(tmp_path, parts_of_ten):
    """Whatever moves from the journal into a part just then."""
    with opened(tmp_path, COUNT) as dataset:
        read = storage.Storage.read
        numbers = iter(range(COUNT))

        def reading(folder, name):
            found = read(folder, name)
            if name == dataset_module.JOURNAL:  # the writer goes on
                add(dataset, [next(numbers) for _ in range(12)])
            return found

        for count in (0, 12, 24, 36):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(storage.Storage, "read", reading)
                study = StudyDataset.open(tmp_path)
            found = study.read(["member"])["member"].to_pylist()
            assert found == sorted(set(found))
            assert set(range(count)) <= set(found) <= set(range(count + 12))
        earlier = cosim.open_study(tmp_path)
        complete(dataset, 0)
        assert earlier.table(["member"])["member"].to_pylist() == list(range(48))


def test_two_studies_cannot_write_one_dataset_at_once(folder):
    """The second is refused while the first writes; who reads is not."""
    with opened(folder, 30):
        with pytest.raises(DatasetError, match=rf"is writing there \(process {os.getpid()}\)"):
            opened(folder, 30, new=True)
        assert len(StudyDataset.open(folder)) == 25
    opened(folder, 30).close()


# --- damage ---


@pytest.mark.parametrize("stride", [41, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_flipped_bit_is_named_or_harmless(folder, stride):
    """Anywhere in any file: never is anything read that was not written."""
    expected = content(folder)
    rows = {row["member"]: row for row in expected.to_pylist()}
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
        StudyDataset.open(folder).read()
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
        StudyDataset.open(folder).read()
    path.unlink()
    with pytest.raises(DatasetError, match=f"{path.name}: removed while it was read"):
        reader.read()
    shutil.copy(tmp_path / "y" / "_journal.jsonl", folder)
    with pytest.raises(DatasetError, match="line 1 is damaged"):
        StudyDataset.open(folder)


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

SCENARIO = {
    "scenario": {"stop": 1.0, "step": 0.1},
    "components": {"a": {"kind": "lag"}, "b": {"kind": "sine"}},
    "connections": {"a.u": "b.y"},
    "actions": [{"at": 1.0}],
    "record": {},
}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, ""),
        ({"components": {"b": {"kind": "sine"}, "a": {"kind": "lag"}}}, ""),
        ({"scenario": {"stop": 1, "step": 0.1}}, "key scenario.stop changed"),
        ({"scenario": {"stop": 1.0}}, "key scenario.step is no longer part of it"),
        ({"scenario": {"stop": 1.0, "step": 0.1, "until": "t > 1"}}, "key scenario.until is new"),
        ({"connections": {"a": {"u": "b.y"}}}, "key connections.a.u is no longer part of it; "),
        ({"record": {"every": 2}}, "key record is no longer part of it; key record.every is new"),
        ({"components": {f"c{i}": {} for i in range(20)}}, "; and 14 more"),
    ],
)
def test_every_key_of_a_scenario_tells_studies_apart(changes, text):
    """Whatever their order; those that differ are named, or counted where they are many."""
    before = identity(5, digests=scenario_digests(SCENARIO))
    found = differences(before, identity(5, digests=scenario_digests(SCENARIO | changes)))
    assert text in found
    assert bool(text) == bool(found)


def test_another_study_is_refused_by_what_differs(folder):
    """A new beginning removes the files of the dataset, and no others."""
    (folder / "notes.txt").touch()
    (folder / "parts" / "mine.parquet").touch()
    before = content(folder)
    of = (parameter_column("noise.seed", [0.5]), *COLUMNS[2:])
    digests = {"key scenario.stop": "00", "the metrics": "00"}
    other = identity(5, digests=digests, version="2.0", of=of)
    with pytest.raises(DatasetError) as caught:
        StudyDataset.open_or_create(folder, other)
    assert str(caught.value) == (
        f"{folder} holds the dataset of another study: the version of cosim was 1.0, is 2.0; "
        "key scenario.stop changed; FMU plant.fmu is no longer part of it; the metrics "
        "changed; varied key observer.filter_rate is no longer part of it; varied key noise.seed "
        "was int64, is double; choose another folder, or use new=True to delete it and start over"
    )
    assert content(folder).equals(before)
    with StudyDataset.open_or_create(folder, other, new=True) as dataset:
        assert dataset.missing() == [range(5)]
    assert [path.name for path in (folder / "parts").iterdir()] == ["mine.parquet"]
    assert (folder / "notes.txt").exists()


def test_files_that_a_study_is_grown_by_belong_to_it(folder):
    """From then on; those of a study that is planned need not be all."""
    more = DIGESTS | {"FMU other.fmu": "12"}
    StudyDataset.open_or_create(folder, identity(40, digests=more)).close()
    with pytest.raises(DatasetError, match=r"another study: FMU other.fmu is no longer part of it"):
        opened(folder, 40)


def test_members_that_were_renumbered_are_refused_by_the_first(folder):
    """Bit for bit; of those that are recorded."""
    planned = design(30)
    planned["noise.seed"][21] = 4
    planned["observer.filter_rate"][29] = 0.0  # not recorded yet
    with pytest.raises(DatasetError, match=r"member 21 was noise.seed = 1, is 4; members keep"):
        StudyDataset.open_or_create(folder, identity(30), planned=planned_by(planned))
    planned["observer.filter_rate"][7] += 2**-40
    with pytest.raises(DatasetError, match=r"member 7 was observer.filter_rate = 19.487171"):
        StudyDataset.open_or_create(folder, identity(30), planned=planned_by(planned))
    one = identity(1, of=(parameter_column("x", [0.0]),))
    with StudyDataset.open_or_create(folder, one, new=True) as dataset:
        dataset.add(StudyMember(0, {"x": -0.0}), MemberOutcome(0, "complete"))
    with pytest.raises(DatasetError, match=r"member 0 was x = -0.0, is 0.0"):
        StudyDataset.open_or_create(folder, one, planned=planned_by({"x": [0.0]}))


def test_what_is_no_dataset_is_left_alone(folder, tmp_path):
    """Parts of nobody, a file of another program, two columns of one name, no dataset, no path."""
    (folder / "study.json").unlink()
    with pytest.raises(DatasetError, match=r"belongs to a dataset, but no study.json says to wh"):
        opened(folder, 30)
    assert len(parts(folder)) == 2
    (folder / "study.json").write_text('{"a": 1}')
    with pytest.raises(DatasetError, match=r"study\.json is not that of a dataset; choose another"):
        opened(folder, 30, new=True)
    assert (folder / "study.json").read_text() == '{"a": 1}'
    for of in ([metric_column("status", "")], [metric_column("y", ""), metric_column("y", "")]):
        with pytest.raises(DatasetError, match="already has this name"):
            StudyDataset.open_or_create(tmp_path / "y", identity(3, of=tuple(of)))
    with pytest.raises(DatasetError, match=r"no study.json there; expected the dataset of a stud"):
        cosim.open_study(tmp_path / "y")
    with pytest.raises(UsageError, match="got an empty path"):
        opened("", 3)
    assert not (tmp_path / "y").exists()


# --- readers ---


@pytest.fixture
def whole(folder):
    """Return a study of 30 that is complete, beside what a kill has left of a part."""
    with opened(folder, 30) as dataset:
        complete(dataset, 0)
    (folder / "parts" / "_part-0000000030-0000000039-0.parquet.cosim-tmp").write_bytes(b"PAR1")
    return folder


def test_pandas_and_pyarrow_read_the_parts(whole):
    """By their folder; what a kill has left of a part is none."""
    frame = pandas.read_parquet(whole / "parts")
    assert frame["observer.filter_rate"].tolist() == design(30)["observer.filter_rate"]
    assert frame["member"][frame["status"] == "failed"].tolist() == FAILED
    table = pyarrow.dataset.dataset(whole / "parts", ignore_prefixes=["_"]).to_table()
    assert table.equals(cosim.open_study(whole).table().drop_columns("log"))
    assert table.schema.field("late").metadata[b"unit"] == b"s"


@pytest.mark.slow
def test_polars_and_duckdb_read_the_parts(whole):
    """By a pattern; the names of columns are those of the study."""
    import duckdb
    import polars

    pattern = whole / "parts" / "*.parquet"
    errors = [None if number in FAILED else 1.0 / (number + 1) for number in range(30)]
    assert polars.read_parquet(pattern)["error"].to_list() == errors
    assert cosim.open_study(whole).to_polars()["error"].to_list() == errors
    query = f"""select member, "noise.seed" from '{pattern}' where error < 0.04 order by member"""
    assert duckdb.sql(query).fetchall() == [(n, n % 5) for n in range(25, 30)]


def test_a_study_says_what_it_holds(folder, monkeypatch):
    """Its names, units and failures; as a frame of pandas by member."""
    study = cosim.open_study(str(folder))
    assert study.parameters == ("observer.filter_rate", "noise.seed")
    assert study.metrics == ("error", "late")
    assert study.columns[0] == "member"
    assert study.units == {"observer.filter_rate": "rad/s", "late": "s", "wall_time": "s"}
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
