"""Where expressions jump."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import UsageError
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.jumps import jumps
from cosim.native.numerics.programs import evaluate


@pytest.mark.parametrize(
    "text",
    [
        "abs(t - 1) + min(t, 1) + max(t, 2)*sin(3*t)",
        "step(1) + sign(-2*pi) + step(sqrt(2) - 1)",
        "t*step(t - t + 1)",
        "exp(-t)/(1 + t**2)",
    ],
)
def test_continuous_expressions_have_no_jumps(text):
    """abs, min and max are continuous; step and sign of a constant are constants."""
    assert jumps(text) == ()


@pytest.mark.parametrize(
    ("argument", "slope", "instant"),
    [
        ("t", 1.0, 0.0),
        ("t - 0.5", 1.0, 0.5),
        ("0.5 - t", -1.0, 0.5),
        ("2*(t - 3) + t*4/2 - 2", 4.0, 2.0),
        ("-(t - 1)/4", -0.25, 1.0),
        ("t - pi/2", 1.0, math.pi / 2),
        ("sqrt(4)*t - log(e)", 2.0, 0.5),
        ("+t - max(1, 2)", 1.0, 2.0),
    ],
)
def test_a_linear_argument_says_when(argument, slope, instant):
    """At -b/a of a t + b, whatever the linear form is."""
    for function in ("step", "sign"):
        (jump,) = jumps(f"3 + {function}({argument})")
        assert (jump.function, jump.slope) == (function, slope)
        assert jump.instant == pytest.approx(instant, rel=1e-15)


@pytest.mark.parametrize(
    "argument", ["sin(t)", "t**2 - 1", "abs(t) - 1", "t*t", "1/t", "t/0", "2**t", "step(t - 1)"]
)
def test_another_argument_does_not(argument):
    """Its zeros are not searched."""
    assert jumps(f"sign({argument})")[0].instant is None


@given(
    st.sampled_from(["step", "sign"]), st.sampled_from([-2.0, -1.0, 0.5, 3.0]), st.integers(-9, 9)
)
def test_the_remedy_is_the_same_function_with_the_value_after_the_jump(function, slope, instant):
    """Everywhere else they are equal, and at the jump it is continuous from the right."""
    (jump,) = jumps(f"{function}({slope}*t - {slope}*({instant}))")
    assert jump.instant == instant
    for t in (-20.0, instant - 0.1, instant + 0.1, 20.0):
        given_value = evaluate(compile_expression(jump.text), t)
        assert evaluate(compile_expression(jump.remedy), t) == given_value
    after = evaluate(compile_expression(jump.text), instant + 0.1)
    assert evaluate(compile_expression(jump.remedy), float(instant)) == after


def test_only_expressions_have_jumps():
    with pytest.raises(UsageError, match="unknown function"):
        jumps("step(t) + stop(t)")
