"""The dataset of a study: what is added is there, once; what is damaged or changed is named."""

import json
import math
import os
import re

import pandas
import pyarrow
import pyarrow.dataset
import pytest

import cosim
from cosim.errors import DatasetError, DatasetWriteError, UsageError
from cosim.studies import storage
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset import (
    StudyDataset,
    differences,
    metric_column,
    parameter_column,
    result_columns,
    scenario_digests,
)
from tests.studies.outcomes import (
    DIGESTS,
    Planned,
    add,
    columns,
    design,
    identity,
    member,
    outcome,
    parts,
)

pytestmark = pytest.mark.usefixtures("parts_of_ten")
FAILED = [3, 10, 17, 24]


def opened(folder, members=25, **given):
    """Open the dataset of a study for writing."""
    return StudyDataset.open_or_create(folder, identity(members), **given)


@pytest.fixture
def folder(tmp_path):
    """Return a study with two parts and a journal."""
    with opened(tmp_path, 30) as dataset:
        add(dataset, range(25))
    return tmp_path


# --- what is added is there ---


def test_rows_are_read_in_the_order_of_members(tmp_path):
    """From parts and from the journal alike, whatever the order in which members ended."""
    with opened(tmp_path) as dataset:
        add(dataset, [*range(9, -1, -1), 23, 12, 20])
        table = dataset.read()
    numbers = [*range(10), 12, 20, 23]
    assert table["member"].to_pylist() == numbers
    assert table["noise.seed"].to_pylist() == [number % 5 for number in numbers]
    assert table["late"].to_pylist() == [outcome(n).metrics.get("late") for n in numbers]
    assert StudyDataset.open(tmp_path).read().equals(table)
    assert parts(tmp_path) == [(0, 9)]


def test_a_dataset_goes_on_where_it_was(tmp_path):
    """What has an outcome is not missing, and the last part is whole at the end of the study."""
    with opened(tmp_path, design=design(25)) as dataset:
        assert dataset.missing() == [range(25)]
        add(dataset, [0, 1, 3, *range(10, 20)])
    with opened(tmp_path, design=design(25)) as dataset:
        assert dataset.missing() == [range(2, 3), range(4, 10), range(20, 25)]
        for absent in dataset.missing():
            add(dataset, absent)
        assert (dataset.missing(), len(dataset), dataset.failed) == ([], 25, 4)
    assert (tmp_path / "_journal.jsonl").read_bytes() == b""
    assert parts(tmp_path) == [(0, 9), (10, 19), (20, 24)]


@pytest.mark.parametrize("sizes", [(25, 42), (3, 5, 9, 10, 11), (19, 20, 40)])
def test_a_study_that_grows_has_the_rows_of_one_that_was_large_at_once(tmp_path, sizes):
    """Its last part is replaced by a longer one; only what is new is missing."""
    done = 0
    for size in sizes:
        with opened(tmp_path / "x", size, design=design(size)) as dataset:
            assert dataset.missing() == [range(done, size)]
            add(dataset, range(done, size))
            done = size
    with opened(tmp_path / "whole", done) as dataset:
        add(dataset, range(done))
    assert (
        StudyDataset.open(tmp_path / "x")
        .read()
        .equals(StudyDataset.open(tmp_path / "whole").read())
    )
    assert parts(tmp_path / "x") == parts(tmp_path / "whole")


def test_a_part_that_has_grown_is_read_while_it_is_incomplete(tmp_path):
    """Its rows stand in the old part, the new ones in the journal."""
    with opened(tmp_path, 3) as dataset:
        add(dataset, range(3))
    with opened(tmp_path, 8) as dataset:
        add(dataset, [6])
        assert dataset.missing() == [range(3, 6), range(7, 8)]
    again = StudyDataset.open(tmp_path)
    assert again.read(["member"])["member"].to_pylist() == [0, 1, 2, 6]
    assert (len(again), parts(tmp_path)) == (4, [(0, 2)])
    with opened(tmp_path, 8) as dataset:
        add(dataset, [3, 4, 5, 7])
    assert parts(tmp_path) == [(0, 7)]


def test_a_study_that_was_planned_larger_than_it_went_can_end_before(tmp_path):
    """What is recorded stays in the plan; with a member beyond it the study is refused."""
    with opened(tmp_path, 1000) as dataset:
        add(dataset, range(13))
    with opened(tmp_path, 15) as dataset:
        add(dataset, [13, 14])
    assert parts(tmp_path) == [(0, 9), (10, 14)]
    with pytest.raises(DatasetError, match="member 14 is recorded, but only 12 members"):
        opened(tmp_path, 12)
    assert StudyDataset.open(tmp_path).total == 15


def test_types_do_not_depend_on_values(tmp_path):
    """A part without any metric has the schema of the others; NaN is no value, infinity is one."""
    with opened(tmp_path, 20) as dataset:
        for number in range(10):
            dataset.add(member(number), MemberOutcome(number, "failed", "it crashed"))
        for number in range(10, 20):
            metrics = {"error": math.nan, "late": math.inf}
            dataset.add(member(number), MemberOutcome(number, "complete", metrics=metrics))
        tables = list(dataset.tables())
    assert tables[0].schema == tables[1].schema
    assert tables[0].schema.field("late").type == pyarrow.float64()
    assert tables[1]["error"].to_pylist() == [None] * 10
    assert tables[1]["late"].to_pylist() == [math.inf] * 10


def test_values_of_every_type_come_back(tmp_path):
    """Numbers bit for bit, texts, lists of numbers; other values as JSON."""
    values = {
        "plant.x": [0.1, -0.0, 5e-324],
        "seed": [2**62 + 1, 0, -1],
        "on": [True, False, None],
        "swap.plant": ["a.fmu", "b ä.fmu", "c.fmu"],
        "recording": ["one.mcap", "two.mcap", "one.mcap"],
        "x0": [[1.0, 2.0], [], [1 / 3]],
        "mixed": ["auto", 3, {"kind": "sine", "rate": 1.5}],
    }
    of = tuple(parameter_column(name, column) for name, column in values.items())
    kinds = ["double", "int64", "bool", "string", "string", "list<double>", "json"]
    assert [column.type for column in of] == kinds
    planned = identity(3, of=of)
    with StudyDataset.open_or_create(tmp_path, planned, design=Planned(values)) as dataset:
        for number in range(3):
            chosen = {name: column[number] for name, column in values.items()}
            swap, recording = {"plant": chosen.pop("swap.plant")}, chosen.pop("recording")
            found = MemberOutcome(number, "complete")
            dataset.add(StudyMember(number, chosen, swap, recording), found)
        table = dataset.read()
    for name in values.keys() - {"mixed"}:
        assert repr(table[name].to_pylist()) == repr(values[name])
    assert table["mixed"].to_pylist() == ['"auto"', "3", '{"kind": "sine", "rate": 1.5}']
    with StudyDataset.open_or_create(tmp_path, planned, design=Planned(values)) as dataset:
        assert dataset.missing() == []


def test_results_that_have_no_column_are_kept_as_json(tmp_path):
    """Those that another member has, and those of another type than that of the column."""
    found = {"plant.y": 1.5, "identifier verdict": "identifiable", "noise.seed": 3.0}
    results = result_columns(found, ["noise.seed"])
    assert [column.type for column in results] == ["double", "string"]
    of = (parameter_column("noise.seed", [1]), *results)
    with StudyDataset.open_or_create(tmp_path, identity(1, of=of)) as dataset:
        said = {"plant.y": "none", "identifier verdict": "identifiable", "other.z": 2.0}
        dataset.add(StudyMember(0, {"noise.seed": 1}), MemberOutcome(0, "complete", metrics=said))
        (row,) = dataset.read().to_pylist()
    assert (row["plant.y"], row["identifier verdict"]) == (None, "identifiable")
    assert json.loads(row["other_results"]) == {"plant.y": "none", "other.z": 2.0}


def test_chosen_columns_and_members_are_read(folder):
    """And the logs that are kept, which are made after the parts."""
    (folder / "logs").mkdir()
    for number in (3, 21):
        (folder / "logs" / f"{number}.mcap").touch()
    dataset = StudyDataset.open(folder)
    table = dataset.read(["log", "noise.seed"], [21, 3, 27, 11])
    kept = [str(folder / "logs" / "3.mcap"), None, str(folder / "logs" / "21.mcap")]
    assert table.to_pydict() == {"log": kept, "noise.seed": [3, 1, 1]}
    with pytest.raises(DatasetError, match=r"no column 'noise.sed'; did you mean 'noise.seed'"):
        dataset.read(["noise.sed"])


# --- whose dataset it is ---

SCENARIO = {
    "scenario": {"stop": 1.0, "step": 0.1},
    "connections": {"a.u": "b.y"},
    "actions": [{"at": 1.0}],
    "record": {},
}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, ""),
        ({"scenario": {"step": 0.1, "stop": 1.0}}, ""),
        ({"scenario": {"stop": 1, "step": 0.1}}, "key scenario.stop changed"),
        ({"scenario": {"stop": 1.0}}, "key scenario.step is no longer part of it"),
        ({"scenario": {"stop": 1.0, "step": 0.1, "until": "t > 1"}}, "key scenario.until is new"),
        ({"actions": []}, "key actions changed"),
        ({"components": {f"c{i}": {} for i in range(20)}}, "; and 12 other differences"),
    ],
)
def test_every_key_of_a_scenario_tells_studies_apart(changes, text):
    """Whatever their order; those that differ are named, or counted where they are many."""
    before = identity(5, digests=scenario_digests(SCENARIO))
    found = differences(before, identity(5, digests=scenario_digests(SCENARIO | changes)))
    assert text in found
    assert bool(text) == bool(found)


def test_another_study_is_refused_by_what_differs(folder):
    """Everything that outcomes depend on; a new beginning removes files of a dataset only."""
    (folder / "notes.txt").touch()
    (folder / "parts" / "mine.parquet").touch()
    digests = {"key scenario.stop": "00" * 32, "the metrics": "00" * 32}
    of = (parameter_column("noise.seed", [0.5]), *columns()[2:])
    other = identity(5, digests=digests, version="2.0", of=of)
    with pytest.raises(DatasetError) as caught:
        StudyDataset.open_or_create(folder, other)
    for text in (
        "cosim 1.0, this is 2.0",
        "key scenario.stop changed",
        "FMU plant.fmu is no longer part of it",
        "the metrics changed",
        "observer.filter_rate is no longer varied",
        "noise.seed were of type int64, are double",
        "new=True",
    ):
        assert text in str(caught.value)
    assert len(StudyDataset.open(folder)) == 25
    with StudyDataset.open_or_create(folder, other, new=True) as dataset:
        assert dataset.missing() == [range(5)]
    assert [path.name for path in (folder / "parts").iterdir()] == ["mine.parquet"]
    assert (folder / "notes.txt").exists()


def test_files_that_a_study_is_grown_by_are_no_difference(tmp_path):
    """As another plant among the values of the first key; from then on it belongs to it."""
    opened(tmp_path, 5).close()
    more = DIGESTS | {"FMU other.fmu": "12" * 32}
    StudyDataset.open_or_create(tmp_path, identity(8, digests=more)).close()
    with pytest.raises(DatasetError, match=r"another study: FMU other.fmu is no longer part of it"):
        opened(tmp_path, 8)


def test_members_that_were_renumbered_are_refused_by_the_first(tmp_path):
    """Bit for bit: a zero of another sign is another value."""
    with opened(tmp_path) as dataset:
        add(dataset, [*range(2, 12), 21])
    planned = design(25)
    planned["noise.seed"][21] = 4
    with pytest.raises(DatasetError, match=r"member 21 was noise.seed = 1, is 4; members keep"):
        opened(tmp_path, design=planned)
    planned["observer.filter_rate"][7] += 2**-40
    with pytest.raises(DatasetError, match=r"member 7 was observer.filter_rate = 19.487171"):
        opened(tmp_path, design=planned)
    planned = design(25)
    planned["observer.filter_rate"][13] = 0.0  # not recorded yet
    opened(tmp_path, design=planned).close()
    of = (parameter_column("plant.x", [0.0]),)
    with StudyDataset.open_or_create(tmp_path, identity(1, of=of), new=True) as dataset:
        dataset.add(StudyMember(0, {"plant.x": -0.0}), MemberOutcome(0, "complete"))
    planned = Planned({"plant.x": [0.0]})
    with pytest.raises(DatasetError, match=r"member 0 was plant.x = -0.0, is 0.0"):
        StudyDataset.open_or_create(tmp_path, identity(1, of=of), design=planned)


def test_two_studies_cannot_write_one_dataset_at_once(tmp_path):
    """The second is refused while the first writes; who reads is not."""
    with opened(tmp_path) as dataset:
        add(dataset, [0])
        for new in (False, True):
            with pytest.raises(DatasetError, match=rf"writing there \(process {os.getpid()}\)"):
                opened(tmp_path, new=new)
        assert len(StudyDataset.open(tmp_path)) == 1
    assert len(opened(tmp_path)) == 1


@pytest.mark.parametrize("name", ["steps", "log", "noise.seed"])
def test_two_columns_of_one_name_are_refused(tmp_path, name):
    """A metric with the name of a parameter, or of a column that every dataset has."""
    of = (*columns(), metric_column(name))
    with pytest.raises(DatasetError, match=f"metric '{name}': a column of the dataset already"):
        StudyDataset.open_or_create(tmp_path / "x", identity(5, of=of))
    assert not (tmp_path / "x").exists()


def test_places_that_hold_no_dataset_are_refused(tmp_path):
    """A folder without its description, a file, an empty path, another program's study.json."""
    with pytest.raises(DatasetError, match=r"no study.json there"):
        StudyDataset.open(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match=r"file: .*; expected a writable folder"):
        opened(tmp_path / "file")
    with pytest.raises(UsageError, match="got an empty path"):
        opened("")
    (tmp_path / "study.json").write_text('{"a": 1}')
    with pytest.raises(DatasetError, match=r"study\.json is not that of a dataset"):
        opened(tmp_path, new=True)
    assert (tmp_path / "study.json").read_text() == '{"a": 1}'


@pytest.mark.parametrize("older", [1, 2])
def test_older_formats_are_refused_with_the_version_that_reads_them(folder, older):
    """As their description names it."""
    content = {**json.loads((folder / "study.json").read_text()), "format": older}
    content["cosim"] = "0.3.0"
    (folder / "study.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=f"format 3, got {older}; read it with cosim 0.3.0"):
        StudyDataset.open(folder)


# --- damage, full disks ---


def flips(content, most):
    """Yield contents with a byte changed, and two that are cut."""
    for place in range(0, len(content), max(len(content) // most, 1)):
        yield content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :]
    yield content[: len(content) // 2]
    yield b""


def read_or_problem(folder):
    """Return the rows of a dataset, or why it cannot be read."""
    try:
        return StudyDataset.open(folder).read().to_pylist(), ""
    except DatasetError as error:
        return [], str(error)


@pytest.mark.parametrize("most", [60, pytest.param(10**6, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("name", ["study.json", "_journal.jsonl", "parts"])
def test_what_is_damaged_is_named_and_never_read(folder, name, most):
    """Whatever byte it is; of the journal, a last line that is cut was never written."""
    path = min((folder / name).iterdir()) if name == "parts" else folder / name
    whole = StudyDataset.open(folder).read().to_pylist()
    content = path.read_bytes()
    named = 0
    for damaged in flips(content, most):
        path.write_bytes(damaged)
        rows, problem = read_or_problem(folder)
        if problem:
            assert path.name in problem
            named += 1
            continue
        assert name == "_journal.jsonl"
        assert rows == whole[: len(rows)]
        assert len(rows) >= 20
    assert named >= min(most, len(content)) - 10
    path.unlink()
    if name == "parts":
        with opened(folder, 30) as dataset:
            assert dataset.missing() == [range(10), range(25, 30)]
            add(dataset, range(10))
            assert dataset.read().to_pylist() == whole


def test_a_part_of_another_study_is_refused(tmp_path):
    """Though it has the name of one of this study."""
    for name, version in (("a", "1"), ("b", "2")):
        with StudyDataset.open_or_create(tmp_path / name, identity(5, version=version)) as dataset:
            add(dataset, range(5))
    (part,) = (tmp_path / "a" / "parts").iterdir()
    (own,) = (tmp_path / "b" / "parts").iterdir()
    own.unlink()
    part.rename(tmp_path / "b" / "parts" / part.name)
    with pytest.raises(DatasetError, match="or a part of another study"):
        StudyDataset.open(tmp_path / "b").read()


def test_parts_that_belong_nowhere_are_refused(folder):
    """Of another plan; or without a description that says of which study they are."""
    name = folder / "parts" / "part-0000000020-0000000033-00000000.parquet"
    name.touch()
    with pytest.raises(DatasetError, match=r"0033-0{8}.parquet: not a part of this dataset"):
        StudyDataset.open(folder)
    name.unlink()
    (folder / "study.json").unlink()
    with pytest.raises(DatasetError, match=r"belongs to a dataset, but no study.json says"):
        opened(folder, 30)
    assert len(parts(folder)) == 2


@pytest.mark.parametrize("line", ["[1, 2", "{}", "[99]", "7", '["00000000", [1]]', "[" * 100_000])
def test_a_damaged_line_of_the_journal_is_named(folder, line):
    """But for the last one, which a kill may have cut: that is dropped."""
    path = folder / "_journal.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([lines[0], line + "\n", *lines[1:]]))
    with pytest.raises(DatasetError, match=r"_journal.jsonl: line 2 is damaged; remove that line"):
        StudyDataset.open(folder)
    path.write_text("".join([*lines, line]))
    assert len(StudyDataset.open(folder)) == 25
    with opened(folder, 30) as dataset:
        add(dataset, [29])
    assert len(StudyDataset.open(folder)) == 26


class FullDisk:
    """Writes take so many bytes, a part of the last one, and then none."""

    def __init__(self, room):
        self.room = room
        self.write = os.write

    def __call__(self, descriptor, content):
        if self.room == 0:
            raise OSError(28, os.strerror(28))
        written = self.write(descriptor, content[: self.room])
        self.room -= written
        return written


@pytest.mark.parametrize("room", [1, 150, 1500, 4000, 9000, 20_000])
def test_a_full_disk_ends_a_study_that_goes_on_later(tmp_path, monkeypatch, room):
    """Wherever it is noticed: in the journal, or in a part; nothing that was added is lost."""
    with opened(tmp_path / "whole", 60) as dataset:
        add(dataset, range(60))
    added = []
    dataset = opened(tmp_path / "x", 60)
    with monkeypatch.context() as patch:
        patch.setattr(storage.os, "write", FullDisk(room))
        with pytest.raises(DatasetWriteError, match=r"No space left on device; all outcomes so"):
            add(dataset, range(60), added.append)
        dataset.close()
    with opened(tmp_path / "x", 60) as dataset:
        left = dataset.read(["member"])["member"].to_pylist()
        assert added == left[: len(added)]
        assert len(left) <= len(added) + 1  # the member whose part could not be written
        for absent in dataset.missing():
            add(dataset, absent)
        assert dataset.read().equals(StudyDataset.open(tmp_path / "whole").read())
    assert not [path for path in tmp_path.rglob("*.tmp")]


# --- other readers, and Python ---


def test_others_read_the_parts(folder):
    """By their folder, or a pattern; what a kill has left of a part has no name of one."""
    (folder / "parts" / "_part.parquet.00ff.tmp").write_bytes(b"PAR1")
    frame = pandas.read_parquet(sorted((folder / "parts").glob("*.parquet")))
    assert frame["error"].isna().tolist() == [number in FAILED for number in range(20)]
    table = pyarrow.dataset.dataset(folder / "parts", exclude_invalid_files=False).to_table()
    assert table.equals(cosim.open_study(folder).table(members=range(20)).drop_columns("log"))


@pytest.mark.slow
def test_duckdb_and_polars_read_the_parts(folder):
    """In one line; the names of the columns are those of the study."""
    import duckdb
    import polars

    pattern = folder / "parts" / "*.parquet"
    query = f"""select member, "observer.filter_rate" from '{pattern}' where error < 0.06"""
    found = [outcome(number).metrics.get("error", 1.0) for number in range(20)]
    wanted = [number for number, error in enumerate(found) if error < 0.06]
    rows = duckdb.sql(f"{query} order by member").fetchall()
    assert [number for number, _ in rows] == wanted
    assert polars.read_parquet(pattern)["member"].to_list() == list(range(20))
    assert cosim.open_study(folder).to_polars()["member"].to_list() == list(range(25))


def test_a_study_says_what_it_holds(folder):
    """Its names, units and failures, its members, and frames of them."""
    study = cosim.open_study(str(folder))
    assert (len(study), study.planned) == (25, 30)
    assert study.parameters == ("observer.filter_rate", "noise.seed")
    assert study.metrics == ("error", "late")
    assert study.units == {"observer.filter_rate": "rad/s", "late": "s", "wall_time": "s"}
    assert study.failures == {n: f"NaN at {n} s" for n in FAILED}
    assert study.logs == {}
    assert repr(study) == "<Study 'tolerances': 25 of 30 members>"
    assert study.member(7) == member(7)
    with pytest.raises(UsageError, match="no outcome of member 27; available: 25 of 30"):
        study.member(27)
    frame = study.to_pandas(["error"])
    assert (frame.index.tolist(), frame.columns.tolist()) == (list(range(25)), ["error"])


@pytest.mark.parametrize("name", ["pandas", "polars", "pyarrow"])
def test_a_library_that_is_missing_is_named(folder, monkeypatch, name):
    """With the command that installs it."""
    study = cosim.open_study(folder)
    monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(UsageError, match=rf"need.* {name}, .* pip install {name}"):
        opened(folder) if name == "pyarrow" else getattr(study, f"to_{name}")()


def test_numbers_of_parts_stand_in_their_names(folder):
    """With a checksum of the content."""
    names = sorted(path.name for path in (folder / "parts").iterdir())
    assert all(re.fullmatch(r"part-\d{10}-\d{10}-[0-9a-f]{8}\.parquet", name) for name in names)
