"""What a study will take, beside what it then took."""

import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.kept_logs import kept_count
from cosim.studies.plan import plan_study
from cosim.studies.study_file import read_keep, read_study
from cosim.studies.studying import estimate_study

SCENARIO = """
scenario = { name = "x", stop = 10.0, step = 0.001 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 1.0 }
"""
AMPLITUDES = {"u.amplitude": {"linear": [1.0, 2.0], "points": 7}}


@pytest.fixture
def planned(tmp_path):
    """Return what plans a study of seven sines."""
    (tmp_path / "x.toml").write_text(SCENARIO)

    def plan(vary=AMPLITUDES, **given):
        study = read_study(tmp_path / "x.toml")
        return plan_study(study.with_options(vary=vary, metrics={"y": "max(u.y)"}, **given))

    return plan


def test_the_logs_take_what_was_said(planned, tmp_path):
    """Those of all members are about as large as that of the first: their values have no zeros."""
    plan = planned(keep="all")
    estimate = estimate_study(plan, 2)
    assert estimate.members == 7
    runs = estimate.first_time + 3 * estimate.member_time  # 4 a worker
    assert estimate.study_time > runs  # each runs again for its log
    assert estimate_study(planned(), 2).log_bytes == 0
    study = cosim.study(plan.study, out=tmp_path / "out", workers=2)
    size = sum(path.stat().st_size for path in (tmp_path / "out" / "logs").iterdir())
    assert len(study.logs) == 7
    assert estimate.log_bytes == pytest.approx(size, rel=0.1)
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("keep", "count"),
    [
        ("all", 7),
        ("worst 9 of y", 7),
        ("best 3 of y", 3),
        ((2, 5, 7), 2),
        ("failed", None),
        (None, 0),
    ],
)
def test_kept_logs_are_counted(keep, count):
    """Never more than there are members; how many fail is not known."""
    assert kept_count(read_keep(keep), 7) == count


def test_a_member_that_fails_is_no_measure(planned, tmp_path):
    """It is named with its reason."""
    (tmp_path / "x.toml").write_text(SCENARIO + 'v = { kind = "expression", y = "1/(t - 0.5)" }\n')
    with pytest.raises(UsageError, match="none of the first 7 members completed"):
        estimate_study(planned(), 1)


def test_the_dataset_takes_what_was_said_before_compression(planned, tmp_path):
    """Texts their length; numbers, and what is empty, 8 bytes."""
    plan = planned(results=True)
    estimate = estimate_study(plan, 1)
    table = cosim.study(plan.study, out=tmp_path / "out", workers=1).table().drop_columns(["log"])
    total = 0
    for row in table.to_pylist():
        for value in row.values():
            total += len(value.encode()) if isinstance(value, str) else 8
    assert estimate.dataset_bytes == pytest.approx(total, rel=0.02)
