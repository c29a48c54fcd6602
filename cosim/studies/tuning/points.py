"""Names of points: by them a tuning knows what it has tried, also after it was stopped.

A dataset has one type for a column. So it gives a whole number back as a float, or a tuple as a
list, where other values of the key need that: such pairs have one name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

_LARGEST_EXACT: Final = 2**53  # every whole number up to it is a float


def point_name(point: Mapping[str, Any]) -> str:
    """Return a text that two points share only if all their values are equal, to the bit."""
    return value_name(point)


def value_name(value: Any) -> str:
    """Return a text that two values share only if they are equal, to the bit.

    Truth values are no numbers, and zeros of different signs are not equal.
    """
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return value.hex()
        case int():
            return float(value).hex() if abs(value) <= _LARGEST_EXACT else str(value)
        case Mapping():
            entries = sorted((json.dumps(key), value_name(item)) for key, item in value.items())
            return f"{{{','.join(f'{key}:{name}' for key, name in entries)}}}"
        case list() | tuple():
            return f"[{','.join(map(value_name, value))}]"
        case _:
            return json.dumps(str(value))
