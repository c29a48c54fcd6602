"""Expressions over signals and conditions: the grammar, against Python's own comparisons."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import UsageError
from cosim.native.numerics.expression import compile_condition, compile_over_signals
from cosim.native.numerics.programs import RowProgram

ROW = {"a.x": 0, "a.y": 1, "b.z[2]": 2}
values = st.one_of(st.sampled_from([0.0, 1.0, 2.0, -1.0, 0.5]), st.floats(-3.0, 3.0))
numbers = st.one_of(st.sampled_from(list(ROW)), st.sampled_from(["0", "1.5", "-1", "t", "2*a.x"]))
comparators = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
comparisons = st.one_of(
    st.tuples(numbers, comparators, numbers).map(" ".join),
    st.tuples(numbers, comparators, numbers, comparators, numbers).map(" ".join),
)


def extend(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(lambda p: f"({' '.join(p)})"),
        inner.map(lambda text: f"(not {text})"),
    )


conditions = st.recursive(comparisons, extend, max_leaves=8)


def evaluated(program, row, t=0.0):
    columns = [ROW[name] for name in program.signals]
    rows = np.array([row], np.float64)
    return RowProgram(program.with_columns(columns)).evaluate(np.array([t]), rows)[0]


def in_python(text, row, t):
    for name, column in ROW.items():
        text = text.replace(name, f"({row[column]!r})")
    return eval(text, {"__builtins__": {}}, {"t": t})


@pytest.mark.slow
@given(conditions, st.tuples(values, values, values), values)
def test_a_condition_of_numbers_is_what_python_makes_of_it(text, row, t):
    """Also chains, and negations of all that."""
    assert evaluated(compile_condition(text).program, row, t) == float(in_python(text, row, t))


def certain(text, row):
    """Return whether a condition is true whatever a.x, which has no value, would be.

    Every comparison in these is between a.x and a number, so seven values decide.
    """
    tried = [-10.0, -1.0, -0.5, 0.0, 0.7, 1.5, 10.0]
    return all(in_python(text, (value, *row[1:]), 0.0) for value in tried)


@given(conditions, st.tuples(values, values))
def test_a_missing_value_makes_no_condition_true(text, rest):
    """Of a condition that is true with NaN, the parts without NaN alone make it true.

    So it is true whatever the missing value would be, and so is no negation of it.
    """
    row = (math.nan, *rest)
    program = compile_condition(text).program
    negation = compile_condition(f"not ({text})").program
    is_true = evaluated(program, row) == 1.0
    if is_true:
        assert certain(text, row)
    assert not (is_true and evaluated(negation, row) == 1.0)


@pytest.mark.parametrize("comparator", ["<", "<=", ">", ">=", "==", "!="])
def test_a_comparison_with_nan_is_false_and_so_is_its_negation(comparator):
    """Of every comparison, with NaN at either side or at both."""
    for text in (f"a.x {comparator} 1", f"1 {comparator} a.x", f"a.x {comparator} a.x"):
        assert evaluated(compile_condition(text).program, (math.nan, 0.0, 0.0)) == 0.0
        assert evaluated(compile_condition(f"not {text}").program, (math.nan, 0.0, 0.0)) == 0.0


@given(values, values)
def test_an_expression_over_signals_is_what_python_makes_of_it(x, y):
    """Signals stand where numbers do; one that is named twice is one."""
    program = compile_over_signals("max(a.x - 2*a.y, 0)**2 + a.x")
    assert program.signals == ("a.x", "a.y")
    assert evaluated(program, (x, y, 0.0)) == max(x - 2 * y, 0.0) ** 2 + x


def test_rows_are_evaluated_at_once_and_may_be_strided():
    """As one by one."""
    rows = np.arange(24.0).reshape(6, 4)[::2, 1:]
    program = compile_over_signals("a.x + 10*'b.z[2]' + 100*t").with_columns([0, 2])
    values = RowProgram(program).evaluate(np.array([0.0, 1.0, 2.0]), rows)
    assert values.tolist() == [1 + 30, 9 + 110 + 100, 17 + 190 + 200]
    assert RowProgram(program).evaluate(np.empty(0), rows[:0]).tolist() == []


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("plant.x_a[0] + plant.x_a[ 1 ]", ("plant.x_a[0]", "plant.x_a[1]")),
        ("car.body.frame.r[1,2]", ("car.body.frame.r[1,2]",)),
        ("'plant.der(x)' - \"my-plant.y\"", ("plant.der(x)", "my-plant.y")),
        ("t.y + e.y + t", ("t.y", "e.y")),
        ("größe.ß + \u00e9.x", ("größe.ß", "\u00e9.x")),
        ("e\u0301.x", ("\u00e9.x",)),
        ("a.\ufb01", ("a.\ufb01",)),
    ],
)
def test_names_of_signals_are_taken_as_written(text, names):
    """Elements, names with dots, names in quotes; composed as the names of a scenario are."""
    assert compile_over_signals(text).signals == names


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("a.x < 1", 0),
        ("a.x < 1 for 1 s", 10**9),
        ("a.x < 1 for 10 ms", 10**7),
        ("a.x < 1 for 0.5", 5 * 10**8),
        ("(a.x < 1)for .5", 5 * 10**8),
        ("a.x < 1 and a.y > 2  for  1.5e3us ", 15 * 10**5),
        ("a.x < 1 for 2 min", 120 * 10**9),
        ("a.x < 1 for 1 h", 3600 * 10**9),
        ("a.x < 1 for 7 ns", 7),
        ("a.x < 1\nfor 1 s", 10**9),
        ("'for.x' < 1 for 1 s", 10**9),
        ("'a.for 1 s' < 1", 0),
    ],
)
def test_a_condition_may_have_to_hold_for_a_duration(text, ns):
    """In one of the units, or in seconds."""
    assert compile_condition(text).duration_ns == ns


REFUSED = {
    "a.x": "got 'a.x'; expected a comparison, such as plant.y < 1",
    "1": "got '1'; expected a comparison",
    "a.x < 1 and a.y": "got 'a.y'; expected a comparison",
    "a.x < (a.y < 1)": "got 'a.y < 1'; allowed: numbers, t, pi, e, signals such as plant.y",
    "not a.x": "got 'a.x'; expected a comparison",
    "a.x in (1, 2)": "got 'a.x in (1, 2)'; expected a comparison",
    "a.x is 1": "got 'a.x is 1'; expected a comparison",
    "True": "got 'True'; expected a comparison",
    "obs < 1": "unknown name 'obs'; did you mean 'cos'? Available: t, pi, e, sin",
    "my-plant.y < 1": "unknown name 'my'; available: t, pi, e, sin",
    "ab(a.x) < 1": "unknown function 'ab'; did you mean 'abs'? Available: sin",
    "a.x() < 1": "got 'a.x()'; allowed: numbers",
    "a.x[b.y] < 1": "got 'a.x[b.y]'; allowed: numbers",
    "a.x[f()] < 1": "got 'a.x[f()]'; allowed: numbers",
    "f().x < 1": "got 'f().x'; allowed: numbers",
    "().__class__ < 1": "got '().__class__'; allowed: numbers",
    "(a.x := 1) < 2": "not a condition at column",
    "[a.x for b in c] < 1": "got '[a.x for b in c]'; allowed: numbers",
    "a.x = 1": "not a condition at column 5; expected something like 'abs(observer",
    "": "not a condition",
    "a.x < 1 for": "got '' after 'for'; expected a duration, such as 10 ms, 1 s, or 0.5 in",
    "a.x < 1 for t": "got 't' after 'for'; expected a duration",
    "a.x < 1 for -1 s": "got '-1 s' after 'for'; expected a duration",
    "a.x < 1 for 1 2 s": "got '1 2 s' after 'for'; expected a duration",
    "a.x < 1 for 1 sec": "got '1 sec' after 'for': unknown unit 'sec'; ",
    "a.x < 1 for 1 mss": "unknown unit 'mss'; did you mean 'ms'? Available: ns, us, ms, s, min, h",
    "a.x < 1 for 0 s": "got '0 s' after 'for'; expected a positive duration",
    "a.x < 1 for 1e300 s": "expected a positive duration of less than 292 years",
    "a.x < 1 for 1.5 ns": "got '1.5 ns' after 'for'; expected a whole number of nanoseconds",
    "a.x < 1 for 1e-999 s": "got '1e-999 s' after 'for'; expected a whole number of nanoseconds",
    "(a.x < 1 for 1 s) and a.y > 1": "not a condition at column",
    "a.x < 1 for forty s": "got 'forty s' after 'for'; expected a duration",
    "a.x < 1 for 1 s and a.y > 1": "not a condition at column",
    "a.x < 1 for 1 s for 2 s": "not a condition at column",
    "__import__('os').system('x') < 1": "got \"__import__('os').system('x')\"; allowed: numbers",
}


def test_only_conditions_are_compiled():
    """With what was found and what is possible instead; nothing is evaluated or called."""
    wrong = []
    for text, problem in REFUSED.items():
        with pytest.raises(UsageError) as error:
            compile_condition(text)
        message = str(error.value)
        if not (message.startswith("condition ") and problem in message):
            wrong.append(message)
    assert wrong == []


def test_an_expression_over_signals_is_no_condition():
    """And an expression in t has no signals."""
    with pytest.raises(UsageError, match=r"got 'a\.x < 1'; allowed: numbers, t, pi, e, signals"):
        compile_over_signals("a.x < 1")
    with pytest.raises(UsageError, match=r"a signal is COMPONENT\.SIGNAL, in quotes where"):
        compile_over_signals("x + 1")


@pytest.mark.parametrize("text", ["not " * 3000 + "a.x < 1", "a.x < " + "-" * 3000 + "1"])
def test_a_condition_that_is_too_deep_to_be_read_is_refused(text):
    """The parser's limits are not the user's traceback."""
    with pytest.raises(UsageError, match=r"not a condition|nested too deeply"):
        compile_condition(text)


def test_many_conditions_need_no_deep_stack():
    """Joined from left to right; nested to the right they need one place each."""
    text = " and ".join(["a.x < 1"] * 200)
    assert evaluated(compile_condition(text).program, (0.0, 0.0, 0.0)) == 1.0
    assert evaluated(compile_condition(text).program, (1.0, 0.0, 0.0)) == 0.0
    deep = "a.x < 1 or (" * 70 + "a.x < 1" + ")" * 70
    with pytest.raises(UsageError, match="at most 64 levels of nesting, got 72"):
        compile_condition(deep)
