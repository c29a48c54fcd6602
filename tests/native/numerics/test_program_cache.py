"""Values that expressions in t had in the run before: the same bits, and only where they are."""

import ctypes
import gc
import math

import numpy as np
import pytest

from cosim.native.blocks.functions import LinearResponse, linear_source_step, modulated_step
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.program_cache import ProgramCaches
from cosim.native.numerics.programs import ProgramStruct, expression_step

NO_INPUTS = np.zeros((1, 0))


def step_of(*texts):
    return expression_step([compile_expression(text) for text in texts])


def values(step, t):
    """Return the outputs of a step at instants t."""
    t = np.array(t, np.float64)
    ends = np.concatenate([[0.0], t])
    return step.advance(ends, 0.0, np.zeros((len(ends), 0)))


def caches_of(step):
    """Return the caches of a step's programs; None for one that has none."""
    structs = [kept for kept in step.keep if getattr(kept, "_type_", None) is ProgramStruct]
    return [
        program.cache.contents if program.cache else None for array in structs for program in array
    ]


def spoil(step):
    """Make all values that are kept of a step -7; return how many there are."""
    caches = [cache for cache in caches_of(step) if cache is not None]
    for cache in caches:
        (ctypes.c_double * cache.count).from_address(cache.values or 0)[:] = [-7.0] * cache.count
    return sum(cache.count for cache in caches)


def same_bits(one, other):
    return np.array_equal(one.view(np.int64), other.view(np.int64))


def test_a_second_run_reads_what_the_first_one_computed():
    t = np.linspace(0.0, 3.0, 100)
    step = step_of("sin(t)*exp(-t)", "t**3")
    plain = values(step, t)
    caches = ProgramCaches()
    caches.connect("u", step)
    assert same_bits(values(step, t), plain)
    caches.connect("u", step)
    assert same_bits(values(step, t), plain)
    caches.connect("u", step)
    assert spoil(step) == 200
    assert np.all(values(step, t) == -7.0)


def test_another_component_with_the_same_expression_reads_nothing_of_it():
    caches = ProgramCaches()
    one, other = step_of("cos(t)"), step_of("cos(t)")
    caches.connect("one", one)
    caches.connect("other", other)
    values(one, [0.5])
    spoil(one)
    assert values(other, [0.5]) == math.cos(0.5)


def test_a_component_that_is_built_again_reads_what_its_expression_was():
    caches = ProgramCaches()
    first = step_of("cos(t)", "exp(t)")
    caches.connect("u", first)
    values(first, [0.25, 0.5])
    again = step_of("cos(t)", "exp(t)")
    caches.connect("u", again)
    assert spoil(again) == 4
    assert np.all(values(again, [0.25, 0.5]) == -7.0)


@pytest.mark.parametrize("other", ["2.5*cos(t)", "2.0*sin(t)"], ids=["constant", "operation"])
def test_an_expression_that_differs_is_computed_from_then_on(other):
    t = [0.25, 0.5]
    caches = ProgramCaches()
    for text in ("2.0*cos(t)", other, "2.0*cos(t)"):
        step = step_of(text)
        plain = values(step, t)
        caches.connect("u", step)
        assert same_bits(values(step, t), plain)
    assert caches_of(step) == [None]


def test_instants_agree_in_their_bits_not_in_their_numbers():
    caches = ProgramCaches()
    step = step_of("sin(t)")
    caches.connect("u", step)
    assert not np.signbit(values(step, [0.0])[0, 0])
    caches.connect("u", step)
    assert np.signbit(values(step, [-0.0])[0, 0])


def test_a_run_with_other_instants_has_its_own_values():
    caches = ProgramCaches()
    step = step_of("exp(t)")
    first = [0.0, 0.1, 0.2, 0.25, 0.3, 0.4]
    second = [0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5]
    for t in (first, second, first, second[3:], first[:2], second):
        plain = values(step_of("exp(t)"), t)
        caches.connect("u", step)
        assert same_bits(values(step, t), plain)


def test_a_run_finds_its_place_again_behind_instants_of_the_run_before():
    """Such as those of an event that is elsewhere now."""
    caches = ProgramCaches()
    step = step_of("exp(t)")
    caches.connect("u", step)
    values(step, [0.0, 0.1, 0.15, 0.2, 0.3])
    caches.connect("u", step)
    spoil(step)
    again = values(step, [0.0, 0.1, 0.2, 0.25, 0.3])[:, 0]
    assert again.tolist() == [-7.0, -7.0, -7.0, math.exp(0.25), -7.0]


def test_a_longer_run_adds_its_values():
    caches = ProgramCaches()
    step = step_of("exp(t)")
    for count in (10, 30, 20, 30):
        caches.connect("u", step)
        values(step, np.arange(count) / 8)
    caches.connect("u", step)
    assert spoil(step) == 30


def test_room_grows_with_the_runs_to_its_limit():
    t = np.arange(50_000) / 8
    step = step_of("exp(-t)")
    plain = values(step, t)
    caches = ProgramCaches(most_bytes=2**21)
    counts = []
    for _ in range(5):
        caches.connect("u", step)
        assert same_bits(values(step, t), plain)
        counts.append(caches_of(step)[0].count)
    assert counts == [2**12, 2**14, 50_000, 50_000, 50_000]
    small = ProgramCaches(most_bytes=2**16)
    for _ in range(3):
        small.connect("u", step)
        assert same_bits(values(step, t), plain)
        assert caches_of(step)[0].count == 2**12
    other = step_of("cos(t)")
    small.connect("other", other)
    assert values(other, [1.0]) == math.cos(1.0)
    assert spoil(other) == 0
    small.connect("u", step_of("exp(t)"))  # in its place: it gives its room back
    for _ in range(2):
        small.connect("other", other)
        assert values(other, [1.0]) == math.cos(1.0)
    assert spoil(other) == 1


def test_the_expressions_of_what_is_inside_a_step_are_found():
    """Factors of responses, and of a source whose outputs are multiplied."""
    t, numbers = compile_expression("cos(t)"), np.array([1.0])
    response = LinearResponse(factor=t, G=-np.eye(1), c=numbers, beta=numbers, element=0)
    inner = linear_source_step(
        [compile_expression("sin(t)"), compile_expression("exp(t)")], [response]
    )
    step = modulated_step(inner, [0], [0])
    caches = ProgramCaches()
    u = np.ones((4, 1))
    instants = np.array([0.0, 0.1, 0.2, 0.3])
    plain = step.advance(instants, 0.1, u)
    for _ in range(2):
        caches.connect("u", step)
        assert same_bits(step.advance(instants, 0.1, u), plain)
    assert [cache.count for cache in caches_of(inner)] == [3, 3, 3]


def test_a_step_may_outlive_the_caches_that_it_reads():
    step = step_of("sin(t)")
    caches = ProgramCaches()
    caches.connect("u", step)
    plain = values(step, [0.5, 1.0])
    caches.connect("u", step)
    del caches
    gc.collect()
    np.empty(2**14)[:] = 0.0
    assert same_bits(values(step, [0.5, 1.0]), plain)


def test_a_run_with_other_instants_takes_the_place_of_the_one_before():
    """Where it goes on along its own, the next run reads those."""
    caches = ProgramCaches()
    step = step_of("exp(t)")
    first = np.arange(100) / 8
    second = np.concatenate([first[:10], first[10:] + 1 / 16])
    for t in (first, second):
        caches.connect("u", step)
        values(step, t)
    caches.connect("u", step)
    kept = spoil(step)
    again = values(step, second)[:, 0]
    assert kept == 100 - 16
    assert np.sum(again == -7.0) == kept


@pytest.mark.parametrize("text", ["1.5", "2.0*t + 1.0", "max(t, abs(t))", "step(t - 1)*sqrt(t)"])
def test_programs_computed_as_fast_as_they_are_read_are_not_kept(text):
    caches = ProgramCaches()
    step = step_of(text)
    caches.connect("u", step)
    assert caches_of(step) == [None]
