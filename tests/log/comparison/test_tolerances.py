"""Tolerances of their own for some signals of a comparison."""

import math

import numpy as np
import pytest

from cosim.errors import UnknownSignalError, UsageError
from cosim.log import open_log
from cosim.log.diff import diff
from cosim.log.signal_comparison import Tolerances
from tests.log.recordings import layout, record, table


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return a log, and one whose u, x_a[1] and theta[0] are apart by 1, 1e-3 and 1e-6."""
    folder = tmp_path_factory.mktemp("pair")
    rows = np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)
    rows = np.round(rows * 1024) / 1024  # so that the sums below are exact to the last bit but one
    record(folder / "a.mcap", rows=rows)
    changed = rows.copy()
    changed[50, 0] += 1.0
    changed[60, 2] += 1e-3
    changed[70, 8] += 1e-6
    record(folder / "b.mcap", rows=changed)
    return open_log(folder / "a.mcap"), open_log(folder / "b.mcap")


def statuses(pair, **options):
    difference = diff(*pair, **options)
    return {row.signal: row.status for row in difference.rows if row.status != "equal"}


def test_a_signal_has_its_own_tolerance_in_the_place_of_that_of_all(pair):
    """A larger one lets it pass, a smaller one does not, and the others keep that of all."""
    apart = {"plant.u": "outside", "plant.x_a": "outside", "identifier.theta": "outside"}
    assert statuses(pair) == apart
    assert statuses(pair, tol={"plant.u": 1.1}) == apart | {"plant.u": "within"}
    own = {"plant.u": 1.1, "plant.x_a": 1e-4}
    found = statuses(pair, atol=1e-2, tol=own)
    assert found == {"plant.u": "within", "plant.x_a": "outside", "identifier.theta": "within"}
    assert statuses(pair, atol=2.0, tol={"identifier.theta": 0})["identifier.theta"] == "outside"
    assert diff(*pair, tol={"plant.u": 1.1, "*": 1e-9}).rows[0].tolerance == 1e-9


def test_the_last_pattern_that_matches_counts(pair):
    """So that what is particular stands behind what is general."""
    assert diff(*pair, tol={"*": 1e-2, "plant.u": 2.0}).within
    assert not diff(*pair, tol={"plant.u": 2.0, "*": 1e-2}).within
    shown = diff(*pair, tol={"*": 1e-2, "plant.u": 2.0}).to_dict()
    assert shown["tol"] == {"*": 1e-2, "plant.u": 2.0}


def test_it_takes_the_place_of_a_relative_tolerance_too(pair):
    """The tolerance of a row is what its values were compared with."""
    difference = diff(*pair, rtol=0.5, tol={"plant.x_a": 1e-4})
    rows = {row.signal: row for row in difference.rows}
    assert rows["plant.x_a"].tolerance == 1e-4
    assert rows["plant.u"].tolerance == 0.5 * rows["plant.u"].scale


def test_signals_are_chosen_by_patterns(pair):
    """Of both runs, each once."""
    rows = diff(*pair, signals=["*.x_a", "plant.*", "identifier.theta[0]"]).rows
    names = [row.signal for row in rows]
    assert names == [*("plant.x_a", "plant.u", "plant.der(x)", "plant.n"), "identifier.theta[0]"]
    with pytest.raises(UnknownSignalError, match=r"'plnt\.\*'"):
        diff(*pair, signals=["plnt.*"])


def test_the_worst_is_the_one_that_exceeds_its_tolerance_most(pair):
    """Whatever its size is; among those without a tolerance the ratio to the scale decides."""
    assert diff(*pair).worst.signal == "plant.u"
    worst = diff(*pair, atol=1e-9, tol={"plant.u": 0.5, "plant.x_a": 1e-5}).worst
    assert worst.signal == "identifier.theta"
    assert diff(*pair, tol={"*": 0.9, "plant.x_a": 1e-4}).worst.signal == "plant.x_a"
    assert diff(pair[0], pair[0]).worst is None


def test_a_tolerance_that_is_no_number_from_0_on_is_refused(pair, subtests):
    """Each by its name."""
    for value in (-1.0, math.nan, math.inf, "1", True, None):
        with subtests.test(case=value):
            with pytest.raises(UsageError, match=rf"^tol\['plant\.u'\]: .*>= 0, got {value!r}"):
                diff(*pair, tol={"plant.u": value})
            with pytest.raises(UsageError, match=rf"^atol: .*>= 0, got {value!r}"):
                diff(*pair, atol=value)


def test_a_tolerance_of_no_compared_signal_is_refused(pair):
    """It would be forgotten in silence: a misspelled name must not make a comparison strict."""
    with pytest.raises(UsageError, match=r"^tol\['plant\.v'\]: .*did you mean 'plan"):
        diff(*pair, tol={"plant.v": 1.0})
    with pytest.raises(UsageError, match=r"^tol\['identifier\.\*'\]: no compared signal"):
        diff(*pair, tol={"identifier.*": 1.0}, signals=["plant.u"])


def test_tolerances_are_a_mapping():
    """Not a number: that is atol."""
    with pytest.raises(UsageError, match=r"^tol: expected a mapping .*got 1e-06"):
        Tolerances(own=1e-6)
