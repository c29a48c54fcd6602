"""What other readers find in the parts, and what a study is for its user."""

import json
import sys

import pandas
import pyarrow.dataset
import pytest
from pyarrow import parquet

import cosim
from cosim.digests import digest_of
from cosim.errors import DatasetError, UsageError
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.outcomes import add, identity, outcome, parts, rates

COUNT = 30


@pytest.fixture
def folder(tmp_path):
    """Return a study that is complete."""
    with StudyDataset.open_or_create(tmp_path / "x", identity(COUNT)) as dataset:
        add(dataset, range(COUNT))
    return tmp_path / "x"


def errors():
    """Return the metric ``error`` of every member."""
    return [outcome(number).metrics.get("error") for number in range(COUNT)]


def test_pandas_reads_the_parts(folder):
    """By their folder."""
    frame = pandas.read_parquet(folder / "parts")
    assert frame["observer.filter_rate"].tolist() == rates(COUNT)
    assert frame["error"].isna().tolist() == [error is None for error in errors()]


@pytest.mark.slow
def test_polars_reads_the_parts(folder):
    """By a pattern, and lazily."""
    import polars

    frame = polars.read_parquet(folder / "parts" / "*.parquet")
    assert frame["error"].to_list() == errors()
    failed = polars.scan_parquet(folder / "parts").filter(polars.col("status") == "failed")
    assert failed.collect()["member"].to_list() == [3, 10, 17, 24]


@pytest.mark.slow
def test_duckdb_reads_the_parts(folder):
    """In one line of SQL; the names of the columns are those of the study."""
    import duckdb

    parts = folder / "parts" / "*.parquet"
    query = f"""select member, "observer.filter_rate" from '{parts}' where error < 0.05"""
    found = duckdb.sql(f"{query} order by member").fetchall()
    wanted = [n for n, error in enumerate(errors()) if error is not None and error < 0.05]
    assert found == [(number, rates(COUNT)[number]) for number in wanted]


def test_pyarrow_reads_the_folder_of_parts_as_one_dataset(folder):
    """All parts have one schema."""
    dataset = pyarrow.dataset.dataset(folder / "parts")
    assert dataset.to_table().equals(cosim.open_study(folder).table().drop_columns("log"))


def test_a_part_that_is_being_written_is_not_seen_by_readers(folder):
    """What a kill has left of it has no name of a part."""
    (folder / "parts" / "_part-0000000030-0000000039.parquet.00ff.tmp").write_bytes(b"PAR1")
    assert len(pyarrow.dataset.dataset(folder / "parts").to_table()) == COUNT


@pytest.mark.slow
def test_duckdb_does_not_see_a_part_that_is_being_written(folder):
    """Nor by a pattern."""
    import duckdb

    (folder / "parts" / "_part-0000000030-0000000039.parquet.00ff.tmp").write_bytes(b"PAR1")
    parts = folder / "parts" / "*.parquet"
    assert duckdb.sql(f"select count(*) from '{parts}'").fetchall() == [(COUNT,)]


def test_a_study_says_what_it_holds(folder):
    """Its names, units and failures."""
    study = cosim.open_study(folder)
    assert len(study) == study.planned == COUNT
    assert study.parameters == ("observer.filter_rate", "noise.seed")
    assert study.metrics == ("error", "late")
    assert study.columns[0] == "member"
    assert study.units == {"observer.filter_rate": "rad/s", "late": "s", "wall_time": "s"}
    assert study.failures == {n: f"NaN at {n} s" for n in (3, 10, 17, 24)}
    assert study.logs == {}
    assert "academic" in study.text
    assert repr(study) == "<Study 'tolerances': 30 of 30 members>"


def test_a_study_becomes_a_frame_of_pandas(folder):
    """By member."""
    study = cosim.open_study(str(folder))
    frame = study.to_pandas(["error"])
    assert frame.index.tolist() == list(range(COUNT))
    assert frame.columns.tolist() == ["error"]


@pytest.mark.slow
def test_a_study_becomes_a_frame_of_polars(folder):
    """Missing values are none."""
    assert cosim.open_study(folder).to_polars()["error"].to_list() == errors()


def test_a_study_that_runs_is_read_as_it_was_when_it_was_opened(tmp_path):
    """What is added later is in the next study that is opened."""
    with StudyDataset.open_or_create(tmp_path, identity(20)) as dataset:
        add(dataset, range(7))
        study = cosim.open_study(tmp_path)
        add(dataset, range(7, 15))
        assert study.table(["member"])["member"].to_pylist() == list(range(7))
        assert len(cosim.open_study(tmp_path)) == 15


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_a_library_that_is_missing_is_named(folder, monkeypatch, name):
    """With the command that installs it."""
    monkeypatch.setitem(sys.modules, name, None)
    study = cosim.open_study(folder)
    with pytest.raises(UsageError, match=rf"to_{name} needs {name}, .* pip install {name}"):
        getattr(study, f"to_{name}")()


def test_studies_without_pyarrow_are_refused(tmp_path, monkeypatch):
    """Before anything is made."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match="studies need pyarrow, which is not installed: pip inst"):
        StudyDataset.open_or_create(tmp_path / "x", identity(1))
    assert not (tmp_path / "x").exists()


def test_a_folder_without_a_study_is_refused(tmp_path):
    """With what was expected."""
    with pytest.raises(DatasetError, match=r"no study.json there; expected the dataset of a stud"):
        cosim.open_study(tmp_path)


def test_datasets_of_format_1_are_read(tmp_path):
    """Their parts have no column of warnings; members added later have one."""
    with StudyDataset.open_or_create(tmp_path, identity(20)) as dataset:
        add(dataset, range(13))
    (path,) = (tmp_path / "parts").iterdir()
    older = parquet.read_table(path).drop_columns(["warnings"])
    parquet.write_table(older, path)
    journal = tmp_path / "_journal.jsonl"
    column = older.column_names.index("reason") + 1
    rows = [json.loads(line) for line in journal.read_text().splitlines()]
    lines = [json.dumps([*row[:column], *row[column + 1 :]]) for row in rows]
    journal.write_text("\n".join(lines) + "\n")
    description = tmp_path / "study.json"
    content = {**json.loads(description.read_text()), "format": 1}
    del content["checksum"]
    description.write_text(json.dumps({**content, "checksum": digest_of(content)}))
    read = StudyDataset.open(tmp_path).read()
    assert read.drop_columns(["warnings", "log"])[:10].equals(older)
    assert read["member"].to_pylist() == list(range(13))
    assert read["warnings"].null_count == 13
    with StudyDataset.open_or_create(tmp_path, identity(20)) as dataset:
        add(dataset, range(13, 20))
    assert len(StudyDataset.open(tmp_path).read(["warnings"])) == 20
    assert len(parts(tmp_path)) == 2
