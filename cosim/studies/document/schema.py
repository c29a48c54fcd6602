"""The schema of a study: [study], [vary] and [metrics], their keys and the types of the values."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import Field

from cosim.scenario.document.schema import LARGEST_SEED, Flag, Number, NumberRow, TomlTable, Whole
from cosim.scenario.document.schema import Name as NameOfStudy

SamplingMethod: TypeAlias = Literal["random", "latin-hypercube", "sobol", "saltelli"]

MOST_SAMPLES: Final = 10_000_000
MOST_POINTS: Final = 100_000  # of a key of the grid
MOST_SEEDS: Final = 10_000_000


class StudySettings(TomlTable):
    """The table [study]."""

    name: NameOfStudy | None = Field(
        None, description="of the study; default: that of its file or scenario"
    )
    scenario: str | None = Field(
        None,
        description="what is run: a shipped scenario by name, or a path from this file; of a log: "
        "the scenario of its run, which is replayed",
    )
    set: dict[str, Any] = Field(
        {}, description='values that all members have: { "observer.filter_rate" = 300.0 }'
    )
    swap: dict[str, str] = Field({}, description="swaps that all members have")
    map: dict[str, str | list[str]] = Field({}, description="ports of what is swapped")
    replay: str | tuple[str, ...] | None = Field(
        None, description='logs that each member replays, such as ["field-*.mcap"]'
    )
    allow_code: Flag | None = Field(
        None,
        description="whether replays compute components of users' classes, too, which runs the "
        "code of the classes that the logs name",
    )
    cases: str | None = Field(
        None,
        description="table of members (.csv, .parquet): a column for each key, a row for each case",
    )
    sampling: SamplingMethod | None = Field(
        None,
        description='how distributions are drawn: "random" (default), "latin-hypercube", "sobol", '
        'or "saltelli" for Sobol indices',
    )
    samples: Annotated[Whole, Field(ge=1, le=MOST_SAMPLES)] | None = Field(
        None, description="how many times all distributions are drawn"
    )
    seed: Annotated[Whole, Field(ge=0, le=LARGEST_SEED)] = Field(
        0, description="that all random numbers of the study follow from"
    )
    seeds: Annotated[Whole, Field(ge=1, le=MOST_SEEDS)] | None = Field(
        None, description="how many seeds each noise source gets; default: its own one alone"
    )
    timeout: Annotated[Number, Field(gt=0.0)] | None = Field(
        None,
        description="wall time after which a member has failed [s]; default: ten times the longest "
        "of the first ones, at least 60 s; an hour until a member is completed",
    )
    keep: str | tuple[Whole, ...] | None = Field(
        None,
        description='members whose logs are kept: "failed", "all", "worst 5 of METRIC", '
        '"best 5 of METRIC", or their numbers',
    )
    results: Flag | None = Field(
        None,
        description="keep what the result of a run says, beside the metrics; default: where there "
        "are no metrics",
    )


class VariationTable(TomlTable):
    """What a key of [vary] is varied by: one of these, with what belongs to it."""

    values: list[Any] | None = Field(None, description="each of these values")
    linear: NumberRow | None = Field(None, description="from the first to the last, evenly")
    log: NumberRow | None = Field(None, description="from the first to the last, by one factor")
    points: Annotated[Whole, Field(ge=2, le=MOST_POINTS)] | None = Field(
        None, description="how many values 'linear' and 'log' have"
    )
    uniform: NumberRow | None = Field(None, description="[lower, upper]")
    log_uniform: NumberRow | None = Field(
        None, alias="log-uniform", description="[lower, upper] of uniform logarithms"
    )
    normal: NumberRow | None = Field(None, description="[mean, deviation]; may have bounds")
    lognormal: NumberRow | None = Field(
        None, description="[median, deviation of the natural logarithm]"
    )
    triangular: NumberRow | None = Field(None, description="[lower, mode, upper]")
    exponential: Number | NumberRow | None = Field(None, description="the mean")
    beta: NumberRow | None = Field(None, description="[alpha, beta]; bounds are 0 and 1 unless set")
    weibull: NumberRow | None = Field(None, description="[scale, shape]")
    choice: list[Any] | None = Field(None, description="one of these values, at random")
    weights: NumberRow | None = Field(None, description="of the values of 'choice'")
    tolerance: Number | None = Field(
        None, description="relative to the scenario's own value, such as 0.05"
    )
    distribution: Literal["uniform", "normal"] | None = Field(
        None,
        description='of a tolerance: "uniform" (default), or "normal" with a third of it as '
        "deviation, and nothing beyond it",
    )
    lower: Number | None = Field(None, description="bound of 'normal' and 'beta'")
    upper: Number | None = Field(None, description="bound of 'normal' and 'beta'")


class StudyTables(TomlTable):
    """The content of a study file; entries of [vary] are validated each on its own."""

    study: StudySettings
    vary: dict[str, Any] = Field({}, description="what is varied, by dotted key")
    metrics: dict[str, str] = Field({}, description="expressions over signals, by name")
