"""Points of the unit cube."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from cosim.errors import UsageError, shell_language
from cosim.studies.design import unit_points

KEYS = ("a.x", "b.y[0]", "c.z")
METHODS = ("random", "latin-hypercube", "sobol", "saltelli")


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["random", "sobol"]),
    st.integers(1, 300),
    st.integers(1, 300),
    st.integers(1, 4),
    st.integers(0, 2**53),
)
def test_more_samples_begin_with_the_same_ones(method, n, more, dimensions, seed):
    """To the bit, of random samples and of Sobol sequences."""
    keys = [f"k.{number}" for number in range(dimensions)]
    few = unit_points(method, keys, n, seed=seed)
    many = unit_points(method, keys, n + more, seed=seed)
    assert few.shape == (dimensions, n)
    assert (few == many[:, :n]).all()


def test_more_samples_of_a_latin_hypercube_are_another_design():
    """As every part of each axis has one point; so are those of Saltelli's."""
    few = unit_points("latin-hypercube", KEYS, 8, seed=1)
    assert not (few == unit_points("latin-hypercube", KEYS, 16, seed=1)[:, :8]).any()


@pytest.mark.parametrize("method", METHODS)
def test_points_follow_from_the_seed_alone(method):
    """They are the same again, others with another seed, and inside of the cube."""
    points = unit_points(method, KEYS, 64, seed=5)
    assert (points == unit_points(method, KEYS, 64, seed=5)).all()
    assert not (points == unit_points(method, KEYS, 64, seed=6)).any()
    assert points.min() > 0.0
    assert points.max() < 1.0


def test_random_numbers_of_a_key_do_not_depend_on_the_others():
    """Each has a stream of its own."""
    all_keys = unit_points("random", KEYS, 10, seed=1)
    assert (unit_points("random", KEYS[2:], 10, seed=1)[0] == all_keys[2]).all()
    assert not (all_keys[0] == all_keys[1]).any()


@pytest.mark.parametrize("method", ["random", "latin-hypercube", "sobol"])
def test_points_are_uniform_and_uncorrelated(method):
    """A Kolmogorov-Smirnov test of each key, and correlations within 5/sqrt(n)."""
    points = unit_points(method, KEYS, 4096, seed=3)
    for column in points:
        assert stats.kstest(column, "uniform").pvalue > 1e-4
    off_diagonal = np.corrcoef(points) - np.eye(3)
    assert np.abs(off_diagonal).max() < 5 / 64


@pytest.mark.parametrize("n", [1, 2, 7, 100])
def test_a_latin_hypercube_has_one_point_in_each_part(n):
    """Of every axis."""
    points = unit_points("latin-hypercube", KEYS, n, seed=2)
    for column in points:
        assert sorted(np.floor(column * n).astype(int).tolist()) == list(range(n))


@pytest.mark.parametrize("exponent", [0, 1, 4, 10])
def test_a_sobol_sequence_has_one_point_in_each_dyadic_part(exponent):
    """Of every axis, of 2**m points: they are a (t, m, s)-net, whose projections are (0, m, 1)."""
    n = 2**exponent
    points = unit_points("sobol", KEYS, n, seed=2)
    for column in points:
        assert sorted(np.floor(column * n).astype(int).tolist()) == list(range(n))


def test_saltelli_has_the_matrices_one_after_the_other():
    """A, B, and A with each of its columns from B, as scipy makes them."""
    from scipy.stats import _sensitivity_analysis

    n = 16
    points = unit_points("saltelli", KEYS, n, seed=4)
    assert points.shape == (3, 5 * n)
    blocks = points.reshape(3, 5, n)
    first, second = blocks[:, 0], blocks[:, 1]
    assert not (first == second).any()
    expected = _sensitivity_analysis.sample_AB(first, second)
    for number in range(3):
        assert (blocks[:, number + 2] == expected[number]).all()
    whole = unit_points("sobol", [*KEYS, *"abc"], n, seed=4)
    assert (np.concatenate([first, second]) == whole).all()


@pytest.mark.parametrize(("samples", "way_out"), [(3, "2 or 4"), (100, "64 or 128")])
def test_saltelli_of_another_number_than_a_power_of_two_is_refused(samples, way_out):
    """Its sequence would not be balanced."""
    message = f"--samples: .*power of two.*got {samples}; nearest: {way_out}"
    with shell_language(), pytest.raises(UsageError, match=message):
        unit_points("saltelli", KEYS, samples, seed=1)


def test_a_sobol_sequence_has_no_more_dimensions_than_scipy():
    """Which a study of so many keys is told."""
    with pytest.raises(UsageError, match="at most 21201 dimensions, and the study has 21202"):
        unit_points("saltelli", ["a"] * 10601, 2, seed=1)
