"""The expression language against Python's own arithmetic."""

import ast
import math
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import UsageError, quoted
from cosim.native.numerics.expression import FUNCTIONS, compile_expression
from cosim.native.numerics.programs import evaluate, evaluate_at


def of_numbers(function):
    """Return a function that raises for NaN and infinity, as those of Python's math do."""

    def checked(*arguments):
        value = float(function(*arguments))
        if not all(map(math.isfinite, (*arguments, value))):
            raise ArithmeticError
        return value

    return checked


def kernel(name):
    """Return an elementary function of the kernel."""
    program = compile_expression(f"{name}(t)")
    return of_numbers(lambda x: evaluate(program, x))


@of_numbers
def power(a, b):
    return evaluate(compile_expression(f"({a!r})**({b!r})"), 0.0)


class PowersByCall(ast.NodeTransformer):
    """Write ``a**b`` as ``power(a, b)``."""

    def visit_BinOp(self, node):
        self.generic_visit(node)
        if not isinstance(node.op, ast.Pow):
            return node
        name = ast.Name("power", ast.Load())
        arguments = [node.left, node.right]
        return ast.Call(name, arguments, [])


ELEMENTARY = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log")
NAMES = {
    **{name: kernel(name) for name in ELEMENTARY},
    "power": power,
    "sqrt": math.sqrt,
    "abs": abs,
    "sign": of_numbers(lambda x: (x > 0) - (x < 0)),
    "step": of_numbers(lambda x: x >= 0),
    "min": of_numbers(min),
    "max": of_numbers(max),
    "pi": math.pi,
    "e": math.e,
}
numbers = st.one_of(st.floats(0.0, 1e6), st.integers(0, 100)).map(repr)
leaves = st.one_of(numbers, st.sampled_from(["t", "pi", "e"]))


def extend(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner).map(
            lambda p: f"({p[0]} {p[1]} {p[2]})"
        ),
        st.tuples(st.sampled_from(["+", "-"]), inner).map(lambda p: f"({p[0]}{p[1]})"),
        st.tuples(st.sampled_from(FUNCTIONS), inner).map(lambda p: f"{p[0]}({p[1]})"),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner).map(
            lambda p: f"{p[0]}({p[1]}, {p[2]})"
        ),
    )


@given(st.recursive(leaves, extend, max_leaves=12), st.floats(-10.0, 10.0))
def test_every_expression_is_what_python_makes_of_it(text, t):
    """Bit for bit, with the elementary functions of the kernel, one at a time.

    Where Python raises, the kernel gives NaN or infinity.
    """
    computed = evaluate(compile_expression(text), t)
    tree = ast.fix_missing_locations(PowersByCall().visit(ast.parse(text, mode="eval")))
    names = {**NAMES, "t": t}
    try:
        expected = float(eval(compile(tree, text, "eval"), {"__builtins__": {}}, names))
    except (ArithmeticError, ValueError):
        return  # an infinity inside may vanish again outside: 1/(1/0) is 0 in C
    assert computed == expected or (math.isnan(expected) and math.isnan(computed))


def test_many_instants_at_once_give_the_same_bits():
    """One call evaluates all expressions at all instants, in any order of the instants."""
    texts = ["exp(-t)*sin(50*t)", "t**3", "2"]
    programs = [compile_expression(text) for text in texts]
    t = np.random.default_rng(0).uniform(-3.0, 3.0, 200)
    rows = evaluate_at(programs, t)
    for instant, row in zip(t.tolist(), rows, strict=True):
        assert row.tolist() == [evaluate(program, instant) for program in programs]
    assert evaluate_at(programs, t[:0]).shape == (0, 3)


def test_powers_bind_as_in_python():
    """-t**2 is -(t**2), 2**3**2 is 2**9, t**-1 is 1/t."""
    assert evaluate(compile_expression("-t**2"), 3.0) == -9.0
    assert evaluate(compile_expression("2**3**2"), 0.0) == 512.0
    assert evaluate(compile_expression("t**-1"), 4.0) == 0.25
    assert evaluate(compile_expression("  1 - 2 - 3 "), 0.0) == -4.0


@pytest.mark.parametrize(
    "text",
    [
        "min(sqrt(-1), 0)",
        "max(0, sqrt(-1))",
        "max(sqrt(-1), 0)",
        "step(sqrt(-1))",
        "sign(log(-1))",
        "abs(0/0)",
    ],
)
def test_nan_is_not_swallowed(text):
    """What is no number stays none, so that the run stops there instead of going on with 0."""
    assert math.isnan(evaluate(compile_expression(text), 0.0))


REFUSED = {
    "sn(t)": "unknown function 'sn'; did you mean 'sin'? Available: sin, ",
    "2*x": "unknown name 'x'; did you mean 'max'? Available: t, pi, e, sin",
    "thet + 1": "unknown name 'thet'",
    "t.real": "got 't.real'; allowed: numbers, t, pi, e, + - * / ** and functions",
    "().__class__": "got '().__class__'; allowed: numbers",
    "__import__('os')": "unknown function '__import__'",
    "(lambda: 1)()": "; allowed: numbers",
    "f(t)(t)": "got 'f(t)(t)'; allowed: numbers",
    "sin(x=t)": "got 'sin(x=t)'; allowed: numbers",
    "sin(*t)": "got '*t'; allowed: numbers",
    "t < 1": "got 't < 1'; allowed: numbers",
    "t and 1": "got 't and 1'; allowed: numbers",
    "1 if t else 2": "got '1 if t else 2'; allowed: numbers",
    "t // 2": "got 't // 2'; allowed: numbers",
    "~t": "got '~t'; allowed: numbers",
    "[t]": "got '[t]'; allowed: numbers",
    "...": "got '...'; allowed: numbers",
    "'text'": "got 'text'; expected a real number",
    "sin('t')": "got 't'; expected a real number",
    "2j": "got 2j; expected a real number",
    "True": "got True; expected a real number",
    "None": "got None; expected a real number",
    "1e999": "got inf; expected a finite number",
    "1" * 400: "; expected a finite number",
    "": "not an expression",
    "   ": "not an expression",
    "1 +": "not an expression; expected something like",
    "t = 1": "not an expression at column",
    "sin t": "not an expression at column",
    "\0": "not an expression",
    "sin()": "got sin with 0 arguments; expected 1",
    "sin(t, t)": "got sin with 2 arguments; expected 1",
    "min(t)": "got min with 1 arguments; expected 2",
    "nan": "unknown name 'nan'",
    "inf": "unknown name 'inf'",
}


def test_only_the_language_is_compiled():
    """With what was found and what is there instead; nothing is evaluated, imported or called."""
    wrong = []
    for text, problem in REFUSED.items():
        with pytest.raises(UsageError) as error:
            compile_expression(text)
        message = str(error.value)
        if not (message.startswith(f"expression {quoted(text)}: ") and problem in message):
            wrong.append(message)
    assert wrong == []


def nested(depth):
    """Return a sum that needs a stack of ``depth``."""
    return "t + (" * (depth - 1) + "t" + ")" * (depth - 1)


def test_a_stack_that_is_too_deep_is_refused():
    """64 is the kernel's stack; one more would write beyond it."""
    assert evaluate(compile_expression(nested(64)), 1.0) == 64.0
    with pytest.raises(UsageError, match="at most 64 levels of nesting, got 65"):
        compile_expression(nested(65))


def test_a_long_sum_needs_no_deep_stack():
    """Sums from left to right keep two values."""
    assert evaluate(compile_expression("+".join(["t"] * 200)), 1.0) == 200.0


@pytest.mark.parametrize(
    "text",
    ["-" * 3000 + "1", "+".join(["1"] * 20000), "(" * 1000 + "1" + ")" * 1000],
    ids=["signs", "sum", "parentheses"],
)
def test_an_expression_that_is_too_deep_to_be_read_is_refused(text):
    """The parser's limits are not the user's traceback."""
    with pytest.raises(UsageError, match=r"not an expression|nested too deeply"):
        compile_expression(text)


def test_reading_an_expression_makes_no_warning_an_error(monkeypatch):
    """Filters of warnings are one for all threads: others may warn while an expression is read."""
    actions = []
    parse = ast.parse

    def observed(*arguments, **options):
        actions.append(warnings.filters[0][0])
        return parse(*arguments, **options)

    monkeypatch.setattr(ast, "parse", observed)
    before = list(warnings.filters)
    with pytest.raises(UsageError, match="got '1or 2'; allowed: numbers"):
        compile_expression("1or 2")
    assert actions == ["ignore"]
    assert warnings.filters == before
