"""The keys of kinds that read tables: what their files do not show by themselves."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cosim.scenario.data_files.table import TableForm
from cosim.scenario.document.schema import TomlTable, Whole


class TableKeys(TomlTable):
    """How a table stands in its file, where that is not as it is found."""

    separator: str | None = Field(
        None,
        description="column separator of a text; default: tab, semicolon, vertical bar or "
        "comma, the one that splits its lines into equally many cells; several blanks are one",
    )
    decimal: Literal[".", ","] | None = Field(
        None, description="decimal separator of a text; default: as found in its numbers"
    )
    skip: Annotated[Whole, Field(ge=0)] | None = Field(
        None,
        description="lines before the names of the columns; default: the names are found, above "
        "the first row of numbers, or between them a row of units",
    )
    comment: Annotated[str, Field(max_length=10)] | None = Field(
        None, description='what lines begin with that are left out; default: "#"'
    )
    sheet: str | None = Field(None, description="sheet of a workbook; default: its only one")

    @property
    def form(self) -> TableForm:
        """What is given of the form of the table."""
        return TableForm(**self.model_dump(include=set(TableKeys.model_fields)))
