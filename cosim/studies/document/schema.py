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
        None, description="name of the study; default: that of its file or scenario"
    )
    scenario: str | None = Field(
        None,
        description="scenario to run: the name of a shipped one, or a path relative to this file; "
        "of a log: its scenario, as a replay",
    )
    set: dict[str, Any] = Field(
        {}, description='values of all members: { "observer.filter_rate" = 300.0 }'
    )
    swap: dict[str, str] = Field({}, description="swaps of all members")
    map: dict[str, str | list[str]] = Field({}, description="ports of swapped components")
    replay: str | tuple[str, ...] | None = Field(
        None, description='logs that each member replays, such as ["field-*.mcap"]'
    )
    allow_code: Flag | None = Field(
        None,
        description="whether replays also compute components of user classes; this runs the code "
        "that the logs name",
    )
    cases: str | None = Field(
        None,
        description="table of members (.csv, .xlsx, ...): a column for each key, a row per case",
    )
    sampling: SamplingMethod | None = Field(
        None,
        description='how distributions are drawn: "random" (default), "latin-hypercube", "sobol", '
        'or "saltelli" for Sobol indices',
    )
    samples: Annotated[Whole, Field(ge=1, le=MOST_SAMPLES)] | None = Field(
        None, description="number of draws from all distributions"
    )
    seed: Annotated[Whole, Field(ge=0, le=LARGEST_SEED)] = Field(
        0, description="seed of all random numbers of the study"
    )
    seeds: Annotated[Whole, Field(ge=1, le=MOST_SEEDS)] | None = Field(
        None, description="number of seeds for each noise source; default: only its own"
    )
    timeout: Annotated[Number, Field(gt=0.0)] | None = Field(
        None,
        description="wall time limit of a member [s]; default: ten times the longest of the first "
        "ones, at least 60 s; one hour until a member completes",
    )
    keep: str | tuple[Whole, ...] | None = Field(
        None,
        description='members whose logs are kept: "failed", "all", "worst 5 of METRIC", '
        '"best 5 of METRIC", or their numbers',
    )
    results: Flag | None = Field(
        None,
        description="also keep the results of each run (estimates, errors, verdicts); default: "
        "only if there are no metrics",
    )


class VariationTable(TomlTable):
    """What a key of [vary] is varied by: one of these, with what belongs to it."""

    values: list[Any] | None = Field(None, description="each of these values")
    linear: NumberRow | None = Field(None, description="from the first to the last, linearly")
    log: NumberRow | None = Field(None, description="from the first to the last, logarithmically")
    points: Annotated[Whole, Field(ge=2, le=MOST_POINTS)] | None = Field(
        None, description="number of values of 'linear' and 'log'"
    )
    uniform: NumberRow | None = Field(None, description="[lower, upper]")
    log_uniform: NumberRow | None = Field(
        None, alias="log-uniform", description="[lower, upper] of a uniform logarithm"
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
        "deviation, truncated at the tolerance",
    )
    lower: Number | None = Field(None, description="bound of 'normal' and 'beta'")
    upper: Number | None = Field(None, description="bound of 'normal' and 'beta'")


class StudyTables(TomlTable):
    """The content of a study file; entries of [vary] are validated each on its own."""

    study: StudySettings
    vary: dict[str, Any] = Field({}, description="what is varied, by dotted key")
    metrics: dict[str, str] = Field({}, description="expressions over signals, by name")
