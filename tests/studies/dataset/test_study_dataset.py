"""The dataset of a study: what is added is there, once, in whole parts or in the journal."""

import math
from dataclasses import replace

import pyarrow
import pytest

from cosim.errors import DatasetError
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset import metric_column, parameter_column, result_columns
from cosim.studies.dataset import differences, scenario_digests
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.outcomes import (
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


def test_rows_are_read_in_the_order_of_members(tmp_path):
    """From parts and from the journal alike, whatever the order in which members ended."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, [*range(9, -1, -1), 23, 12, 20])
        table = dataset.read()
    numbers = [*range(10), 12, 20, 23]
    assert table["member"].to_pylist() == numbers
    assert table["noise.seed"].to_pylist() == [number % 5 for number in numbers]
    assert table["status"].to_pylist() == [outcome(number).status for number in numbers]
    expected = [outcome(number).metrics.get("late") for number in numbers]
    assert table["late"].to_pylist() == expected
    assert StudyDataset.open(tmp_path).read().equals(table)
    assert parts(tmp_path) == ["part-0000000000-0000000009.parquet"]


def test_a_dataset_goes_on_where_it_was(tmp_path):
    """What has an outcome is not missing, and the last part is whole at the end of the study."""
    with StudyDataset.open_or_create(tmp_path, identity(25), design=design(25)) as dataset:
        assert dataset.missing() == [range(25)]
        add(dataset, [0, 1, 3, *range(10, 20)])
    with StudyDataset.open_or_create(tmp_path, identity(25), design=design(25)) as dataset:
        assert dataset.missing() == [range(2, 3), range(4, 10), range(20, 25)]
        assert dataset.missing(6) == [range(2, 3), range(4, 6)]
        assert dataset.empty_parts() == [range(20, 25)]
        for absent in dataset.missing():
            add(dataset, absent)
        assert dataset.missing() == []
        assert len(dataset) == 25
    assert (tmp_path / "_journal.jsonl").read_bytes() == b""
    assert parts(tmp_path)[-1] == "part-0000000020-0000000024.parquet"


def test_a_study_that_has_grown_keeps_the_parts_it_has(tmp_path):
    """A part ends where the study ended before; only what is new is missing."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, range(25))
    before = StudyDataset.open(tmp_path).read()
    grown = identity(42, part_size=99)
    with StudyDataset.open_or_create(tmp_path, grown, design=design(42)) as dataset:
        assert dataset.missing() == [range(25, 42)]
        add(dataset, range(25, 42))
        assert dataset.read(members=range(25)).equals(before)
        assert len(dataset) == 42
    first_members = [int(name[5:15]) for name in parts(tmp_path)]
    assert first_members == [0, 10, 20, 25, 30, 40]


def test_a_study_that_was_planned_larger_than_it_went_can_end_before(tmp_path):
    """What is recorded stays in the plan; with a member beyond it the study is refused."""
    with StudyDataset.open_or_create(tmp_path, identity(1000)) as dataset:
        add(dataset, range(13))
    with StudyDataset.open_or_create(tmp_path, identity(15)) as dataset:
        add(dataset, [13, 14])
    assert parts(tmp_path)[-1] == "part-0000000010-0000000014.parquet"
    problem = "member 14 is recorded, but only 12 members are planned; a study can only grow"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open_or_create(tmp_path, identity(12))
    assert StudyDataset.open(tmp_path).layout.total == 15


def test_types_do_not_depend_on_values(tmp_path):
    """A part without any metric has the schema of the others; NaN is no value, infinity is one."""
    with StudyDataset.open_or_create(tmp_path, identity(10, part_size=5)) as dataset:
        for number in range(5):
            dataset.add(member(number), MemberOutcome(number, "failed", "it crashed"))
        for number in range(5, 10):
            metrics = {"error": math.nan, "late": math.inf}
            dataset.add(member(number), MemberOutcome(number, "complete", metrics=metrics))
        tables = list(dataset.tables())
    assert tables[0].schema == tables[1].schema
    assert tables[0].schema.field("late").type == pyarrow.float64()
    assert tables[0].schema.field("late").metadata[b"unit"] == b"s"
    assert tables[1]["error"].to_pylist() == [None] * 5
    assert tables[1]["late"].to_pylist() == [math.inf] * 5


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
    planned = identity(3, of=of, part_size=2)
    with StudyDataset.open_or_create(tmp_path, planned, design=Planned(values)) as dataset:
        for number in range(3):
            chosen = {name: column[number] for name, column in values.items()}
            swap = {"plant": chosen.pop("swap.plant")}
            recording = chosen.pop("recording")
            dataset.add(
                StudyMember(number, chosen, swap, recording), MemberOutcome(number, "complete")
            )
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
    assert [(column.name, column.type) for column in results] == [
        ("plant.y", "double"),
        ("identifier verdict", "string"),
    ]
    of = (parameter_column("noise.seed", [1]), *results)
    with StudyDataset.open_or_create(tmp_path, identity(1, of=of)) as dataset:
        said = {"plant.y": "none", "identifier verdict": "identifiable", "other.z": 2.0}
        dataset.add(StudyMember(0, {"noise.seed": 1}), MemberOutcome(0, "complete", metrics=said))
        (row,) = dataset.read().to_pylist()
    assert row["plant.y"] is None
    assert row["identifier verdict"] == "identifiable"
    assert row["other_results"] == '{"plant.y": "none", "other.z": 2.0}'


def test_a_part_that_a_task_writes_twice_is_there_once(tmp_path):
    """A task elsewhere needs no lock, and knows by the hash whose dataset it is."""
    with StudyDataset.open_or_create(tmp_path, identity(15)) as dataset:
        for _ in range(2):
            task = StudyDataset.open(tmp_path, sha256=dataset.sha256)
            task.write_part(10, [(member(number), outcome(number)) for number in range(14, 9, -1)])
        dataset.note_part(10)
        assert dataset.missing() == [range(10)]
        assert dataset.read(["member"])["member"].to_pylist() == [10, 11, 12, 13, 14]
    with StudyDataset.open_or_create(tmp_path, identity(3, version="2.0"), new=True):
        pass
    with pytest.raises(DatasetError, match="now holds the dataset of another study"):
        StudyDataset.open(tmp_path, sha256=dataset.sha256)


def test_a_part_of_another_study_is_refused(tmp_path):
    """A task that was late writes into what another study has begun."""
    with StudyDataset.open_or_create(tmp_path, identity(5)) as dataset:
        late = StudyDataset.open(tmp_path)
        add(dataset, range(5))
    with StudyDataset.open_or_create(tmp_path, identity(5, version="2"), new=True) as dataset:
        late.write_part(0, [(member(number), outcome(number)) for number in range(5)])
    opened = StudyDataset.open(tmp_path)
    with pytest.raises(DatasetError, match=r"0004.parquet is a part of another study; remove it"):
        opened.read()


def test_chosen_columns_and_members_are_read(tmp_path):
    """And the logs that are kept, which are made after the parts."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, range(22))
        (tmp_path / "logs").mkdir()
        for number in (3, 21):
            (tmp_path / "logs" / f"{number}.mcap").touch()
        table = dataset.read(["log", "noise.seed"], [21, 3, 24, 11])
    assert table.column_names == ["log", "noise.seed"]
    kept = [str(tmp_path / "logs" / "3.mcap"), None, str(tmp_path / "logs" / "21.mcap")]
    assert table["log"].to_pylist() == kept
    assert table["noise.seed"].to_pylist() == [3, 1, 1]
    with pytest.raises(DatasetError, match=r"no column 'noise.sed'; did you mean 'noise.seed'"):
        dataset.read(["noise.sed"])


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
        ({"scenario": {"stop": 2.0, "step": 0.1}}, "key scenario.stop changed"),
        ({"scenario": {"stop": 1, "step": 0.1}}, "key scenario.stop changed"),
        ({"scenario": {"stop": 1.0}}, "key scenario.step is no longer part of it"),
        ({"scenario": {"stop": 1.0, "step": 0.1, "until": "t > 1"}}, "key scenario.until is new"),
        ({"connections": {"a": {"u": "b.y"}}}, "key connections.a.u is no longer part of it; "),
        ({"actions": []}, "key actions changed"),
        ({"record": {"every": 2}}, "key record is no longer part of it; key record.every is new"),
        ({"components": {f"c{i}": {} for i in range(20)}}, "; and 14 other differences"),
    ],
)
def test_every_key_of_a_scenario_tells_studies_apart(changes, text):
    """Whatever their order; those that differ are named, or counted where they are many."""
    before = identity(5, digests=scenario_digests(SCENARIO))
    after = identity(5, digests=scenario_digests(SCENARIO | changes))
    found = differences(before, after)
    assert text in found
    assert bool(text) == bool(found) == (before.sha256 != after.sha256)


def test_details_of_an_outcome_are_not_recorded(tmp_path):
    """They are for who asked; all else is a row."""
    with StudyDataset.open_or_create(tmp_path, identity(5)) as dataset:
        outcome = MemberOutcome(0, "complete", metrics={"root": 1.0})
        row = dataset.row_of(member(0), outcome)
        assert dataset.row_of(member(0), replace(outcome, details={"log": "yes"})) == row


def test_another_study_is_refused_by_what_differs(tmp_path):
    """Everything that outcomes depend on; the way out is a new beginning."""
    with StudyDataset.open_or_create(tmp_path, identity(5)) as dataset:
        add(dataset, range(5))
    (tmp_path / "notes.txt").touch()
    (tmp_path / "parts" / "mine.parquet").touch()
    digests = {"key scenario.stop": "00" * 32, "the metrics": "00" * 32}
    of = (parameter_column("noise.seed", [0.5]), *columns()[2:])
    other = identity(5, digests=digests, version="2.0", of=of)
    with pytest.raises(DatasetError) as caught:
        StudyDataset.open_or_create(tmp_path, other)
    assert str(caught.value) == (
        f"{tmp_path} holds the dataset of another study: it was made by cosim 1.0, this is 2.0; "
        "key scenario.stop changed; FMU plant.fmu is no longer part of it; the metrics changed; "
        "observer.filter_rate is no longer varied; the values of noise.seed were of type int64, "
        "are double; choose another folder, or use new=True to delete it and start over"
    )
    assert len(StudyDataset.open(tmp_path)) == 5
    with StudyDataset.open_or_create(tmp_path, other, new=True) as dataset:
        assert dataset.missing() == [range(5)]
    assert parts(tmp_path) == ["mine.parquet"]
    assert (tmp_path / "notes.txt").exists()


def test_files_that_a_study_is_grown_by_are_no_difference(tmp_path):
    """As another plant among the values of the first key; from then on it belongs to it."""
    with StudyDataset.open_or_create(tmp_path, identity(5)):
        pass
    more = DIGESTS | {"FMU other.fmu": "12" * 32}
    with StudyDataset.open_or_create(tmp_path, identity(8, digests=more)) as dataset:
        assert dataset.missing() == [range(8)]
    with pytest.raises(DatasetError, match=r"another study: FMU other.fmu is no longer part of it"):
        StudyDataset.open_or_create(tmp_path, identity(8))


def test_members_that_were_renumbered_are_refused_by_the_first(tmp_path):
    """Bit for bit: a zero of another sign is another value."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, [*range(2, 12), 21])
    planned = design(25)
    planned["noise.seed"][21] = 4
    problem = r"member 21 was noise.seed = 1, is 4; members keep their numbers where"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open_or_create(tmp_path, identity(25), design=planned)
    planned["observer.filter_rate"][7] += 2**-40
    with pytest.raises(DatasetError, match=r"member 7 was observer.filter_rate = 19.487171"):
        StudyDataset.open_or_create(tmp_path, identity(25), design=planned)
    planned = design(25)
    planned["observer.filter_rate"][13] = 0.0  # not recorded yet
    with StudyDataset.open_or_create(tmp_path, identity(25), design=planned):
        pass
    of = (parameter_column("plant.x", [0.0]),)
    with StudyDataset.open_or_create(tmp_path, identity(1, of=of), new=True) as dataset:
        dataset.add(StudyMember(0, {"plant.x": -0.0}), MemberOutcome(0, "complete"))
    with pytest.raises(DatasetError, match=r"member 0 was plant.x = -0.0, is 0.0"):
        StudyDataset.open_or_create(
            tmp_path, identity(1, of=of), design=Planned({"plant.x": [0.0]})
        )


def test_two_studies_cannot_write_one_dataset_at_once(tmp_path):
    """The second is refused while the first writes; who reads is not."""
    with StudyDataset.open_or_create(tmp_path, identity(5)) as dataset:
        add(dataset, [0])
        problem = (
            r"another study is writing there \(process \d+ on .*\); wait until it ends, or choose"
        )
        with pytest.raises(DatasetError, match=problem):
            StudyDataset.open_or_create(tmp_path, identity(5))
        with pytest.raises(DatasetError, match=problem):
            StudyDataset.open_or_create(tmp_path, identity(5), new=True)
        assert len(StudyDataset.open(tmp_path)) == 1
    with StudyDataset.open_or_create(tmp_path, identity(5)) as dataset:
        assert len(dataset) == 1


def test_a_dataset_needs_a_folder_and_to_be_read_its_description(tmp_path):
    with pytest.raises(DatasetError, match=r"no study.json there; expected the dataset of a"):
        StudyDataset.open(tmp_path)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(DatasetError, match=r"file: .*; expected a writable folder"):
        StudyDataset.open_or_create(file, identity(5))


@pytest.mark.parametrize("name", ["steps", "log", "noise.seed"])
def test_two_columns_of_one_name_are_refused(tmp_path, name):
    """A metric with the name of a parameter, or of a column that every dataset has."""
    problem = f"metric '{name}': a column of the dataset already has this name"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open_or_create(
            tmp_path / "x", identity(5, of=(*columns(), metric_column(name)))
        )
    assert not (tmp_path / "x").exists()
