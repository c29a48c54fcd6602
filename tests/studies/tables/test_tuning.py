"""The lines that a tuning prints."""

from dataclasses import replace

import numpy as np

from cosim.studies.tables.tuning import tuning_lines
from tests.studies.tuning.curves import LINE, T, fitted, line


def test_a_value_has_the_digits_that_its_error_leaves():
    """Two of the error, in value and interval; six digits where the error has more."""
    noise = np.random.default_rng(3).standard_normal(T.size)
    for deviation, digits in ((1e-6, 9), (1.0, 6)):
        result = fitted(line, LINE, line(T, 3.0, -2.0) + deviation * noise, starts=1)
        shown = tuning_lines(replace(result, expression="rms(x)", command="cosim run x"))[1]
        value, error, interval = shown.split(", ")
        slope = result.estimate["slope"]
        found = result.errors.errors["slope"]
        low, high = result.errors.intervals["slope"]
        assert value == f"  slope = {slope:.{digits}g}"
        assert error == f"standard error {found:.2g}"
        assert interval == f"95 % interval {low:.{digits}g} to {high:.{digits}g}"
