"""Values, messages and statuses on their way between an FMU and us."""

import numpy as np
import pytest

from cosim.errors import RunError
from cosim.fmi.binary.loaded import from_fmu_type, to_fmu_type
from tests.fmi.probes import opened

WHOLE = [
    *((value, "Int64") for value in (0, 2**53, -(2**53), 2**53 + 2, -(2**63), 2**63 - 1024)),
    *((value, "UInt64") for value in (2**53, 2**64 - 2048)),
]
ROUNDED = [
    *((value, "Int64") for value in (2**53 + 1, -(2**53) - 1, 1 - 2**63, 2**63 - 1)),
    *((value, "UInt64") for value in (2**53 + 1, 2**64 - 1)),
]


def test_integers_are_carried_exactly_or_not_at_all():
    """float64 holds every one up to 2**53, beyond it those with 53 significant bits."""
    for value, variable_type in WHOLE:
        dtype = np.dtype(variable_type.lower())
        received = from_fmu_type("m", np.array([value], dtype))
        assert [int(number) for number in received] == [value]
        assert to_fmu_type("m", variable_type, dtype, received).tolist() == [value]
    for value, variable_type in ROUNDED:
        text = rf"m: an integer beyond 2\*\*53 cannot be carried exactly: \[{value}\]"
        with pytest.raises(RunError, match=text):
            from_fmu_type("m", np.array([value], variable_type.lower()))


def test_numbers_outside_a_type_are_refused(subtests):
    """Without a warning of numpy."""
    for variable_type, value in [
        ("Int32", 1e300),
        ("Int64", 2.0**63),
        ("UInt64", 2.0**64),
        ("Int64", -(2.0**63) - 2048.0),
        ("UInt8", -1.0),
        ("Boolean", 2.0),
        ("Int32", np.nan),
    ]:
        with subtests.test(variable_type=variable_type, value=value):
            dtype = np.bool_ if variable_type == "Boolean" else np.dtype(variable_type.lower())
            with pytest.raises(RunError, match=f"expected numbers of type {variable_type}"):
                to_fmu_type("m", variable_type, dtype, np.array([value]))


@pytest.mark.parametrize(
    ("status", "label", "freed"),
    [(3, "error", 1), (4, "fatal", 0), (5, "pending", 1), (9, "no status of the standard", 1)],
)
def test_only_a_fatal_status_forbids_freeing(probe2, status, label, freed):
    """FMI 2.0.4 section 2.1.3: after fmi2Fatal no call is allowed.

    After any other status the instance can be freed.
    """
    with opened(probe2, interface_type="cs") as (fmu, instance):
        references = instance.description.references_of(["answer"])
        instance.set_float64(references, np.array([float(status)]))
        with pytest.raises(RunError, match=rf"probe2.fmu: fmi2Reset returned {status} \({label}\)"):
            instance._calls.reset()
        if status == 4:
            with pytest.raises(
                RunError, match=r"fmi2Reset cannot be called: fmi2Reset returned 4 \(fatal\) before"
            ):
                instance._calls.reset()
    assert [text for *_, text in fmu.drain()].count("freed") == freed
