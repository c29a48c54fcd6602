"""A study whose members and outcomes follow from their numbers."""

from __future__ import annotations

import io

from pyarrow import parquet

from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset import StudyDataset, StudyIdentity, metric_column, parameter_column

DIGESTS = {"key scenario.stop": "ab" * 32, "FMU plant.fmu": "cd" * 32, "the metrics": "ef" * 32}


def rates(count):
    """Return the values of ``observer.filter_rate``."""
    return [10.0 * 1.1 ** (number % 97) for number in range(count)]


def seeds(count):
    """Return the values of ``noise.seed``."""
    return [number % 5 for number in range(count)]


class Planned(dict):
    """Planned parameters, of all members, by name."""

    def column(self, name, begin=0, end=None):
        """Return the values of some members."""
        return self[name][begin:end]


def design(count):
    """Return the planned parameters."""
    return Planned({"observer.filter_rate": rates(count), "noise.seed": seeds(count)})


def columns():
    """Return the parameters and metrics."""
    return (
        parameter_column("observer.filter_rate", rates(3), "rad/s"),
        parameter_column("noise.seed", seeds(3)),
        metric_column("error", "rms(observer.delta - delta.y)"),
        metric_column("late", "first(t, plant.y > 1)", "s"),
    )


def identity(members, *, digests=None, version="1.0", of=None):
    """Return what the study is about."""
    return StudyIdentity(
        name="tolerances",
        text='[study]\nscenario = "academic"\n',
        digests=DIGESTS if digests is None else digests,
        columns=columns() if of is None else of,
        members=members,
        version=version,
    )


def member(number):
    """Return a member."""
    values = {"observer.filter_rate": 10.0 * 1.1 ** (number % 97), "noise.seed": number % 5}
    return StudyMember(number, values)


def outcome(number, *, wall_time=0.25, worker="here"):
    """Return what a member came to: every seventh failed, some have no ``late``."""
    if number % 7 == 3:
        return MemberOutcome(number, "failed", f"NaN at {number} s", number, {}, wall_time)
    metrics = {"error": 1.0 / (number + 1), "late": number / 3 if number % 4 else None}
    return MemberOutcome(number, "complete", "", 1000, metrics, wall_time, worker)


def add(dataset, numbers, report=lambda number: None):
    """Add the outcomes of members, and report each that is added."""
    for number in numbers:
        dataset.add(member(number), outcome(number))
        report(number)


def parts(folder):
    """Return the first and the last member of each part in a folder."""
    names = sorted(path.name.split("-") for path in (folder / "parts").glob("part-*"))
    return [(int(first), int(last)) for _, first, last, _ in names]


def change_part(place, change):
    """Change the table of the only part of a dataset, as its own writer would have written it."""
    dataset = StudyDataset.open(place)
    (path,) = (place / "parts").iterdir()
    stream = io.BytesIO()
    parquet.write_table(change(parquet.read_table(path)), stream)
    checksum = dataset._checksum(stream.getvalue())
    path.unlink()
    path.with_name(f"{path.name[:26]}-{checksum}.parquet").write_bytes(stream.getvalue())
