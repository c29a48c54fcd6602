"""Sources that jump, at communication points or not at all; expressions over other signals."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

import cosim
from cosim.blocks.source import Table
from cosim.core.clock import Clock
from cosim.errors import ScenarioError, UsageError
from cosim.report.inspection import describe_log
from cosim.report.verification import verify
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.kinds.tables import held_from_points
from tests.scenario.refusals import check_refused

H = 0.125


def run(folder, table, *, start_time=0.0, stop=1.0, step=H):
    """Run a source with an integrator behind it: x' = u."""
    text = (
        f'[scenario]\nname = "u"\nstart_time = {start_time}\nstop = {stop}\nstep = {step}\n'
        f'[components.u]\n{table}\n[components.x]\nkind = "integrator"\n'
        '[connections]\n"x.u" = "u.y"\n'
    )
    return cosim.run(parse(Document(text, "u", folder)))


HELD = 'kind = "table"\ninterpolation = "zero-order"\n'


@pytest.mark.parametrize(
    ("table", "integral"),
    [
        (HELD + "t = [0.0, 0.5, 2.0]\ny = [1.0, 3.0, 3.0]", 2.0),
        (HELD + "t = [0.0, 0.3, 2.0]\ny = [1.0, 1.0, 3.0]", 1.0),
        (HELD + "t = [0.0, 0.5, 0.5, 2.0]\ny = [1.0, 1.0, 3.0, 3.0]", 2.0),
        (HELD + "t = [0.0, 0.0, 0.5, 0.5, 0.5, 2.0]\ny = [9.0, 1.0, 1.0, 8.0, 3.0, 3.0]", 2.0),
        (HELD + 't = [0.25, 0.5]\ny = [1.0, 3.0]\nextrapolation = "hold"', 2.0),
        ('kind = "expression"\ny = "1 + 2*step(t - 0.5)"\ndiscrete = true', 2.0),
        ('kind = "expression"\ny = "1 + step(t) + step(t - 3)"', 2.0),
        ('kind = "expression"\ny = "8*max(0, t - 0.5)"', 1.0),
        ('kind = "table"\nt = [0.0, 0.5, 1.0]\ny = [0.0, 0.0, 4.0]', 1.0),
        ('kind = "table"\nt = [0.5, 0.75]\ny = [1.0, 3.0]\nextrapolation = "hold"', 1.75),
        ('kind = "step"\ntime = 0.5\nbefore = 1.0\nafter = 3.0', 2.0),
        ('kind = "constant"\nvalue = 2.0', 2.0),
    ],
)
def test_an_integral_over_a_source_is_exact(tmp_path, table, integral):
    """Of what holds and jumps at communication points, and of what is linear between them.

    Each number is a short binary fraction, so there is no rounding.
    """
    assert run(tmp_path, table)["x.y"][-1] == integral


EXPRESSION = 'kind = "expression"\n'
SAMPLED = EXPRESSION + "discrete = true\n"
TERM = '{ alpha = "step(t - 0.5)", family = "sine", theta = 1.0 }'
DISTURBANCE = f'kind = "disturbance"\nterms = [{TERM}]'
TABLE = 'kind = "table"\n'
Y = "\ny = [0.0, 1.0, 3.0, 4.0]"


WRONG_JUMPS = [
    (f"{HELD}t = [0.0, 0.37, 0.6, 2.0]{Y}", r"y jumps at t\[1\] = 0\.37 s.* 0\.25 s or .*\(2 such"),
    (f"{TABLE}t = [0.0, 0.5, 0.5, 2.0]{Y}", r"t\[1\] and t\[2\] are both 0\.5 s.*zero-order"),
    (f"{HELD}t = [0.0, 0.5, 0.4, 2.0]{Y}", r"t\[2\] = 0\.4 s.* 0\.5 s"),
    (
        f"{HELD}t = [0.0, 0.3, 0.3, 2.0]\ny = [0, 0, 3, 3]",
        r"table: y jumps at t\[2\] = 0\.3 s.* 0\.375 s",
    ),
    (f"{TABLE}t = [0.5, 0.6, 0.7, 2.0]{Y}", r'1\.0 s .*0\.5 s to 2\.0 s; extrapolation = "hold"'),
    (EXPRESSION + 'y = "step(t - 0.5)"', r"step\(t - 0\.5\) jumps at 0\.5 s; .*discrete = true"),
    (EXPRESSION + 'y = "t + sign(sin(t))"', r"sign\(sin\(t\)\) jumps; "),
    (EXPRESSION + 'y = "sign(t)"', r"sign\(t\) jumps at 0\.0 s"),
    (EXPRESSION + 'y = ["1", "step(1 - 2*t)"]', r"step\(1 - 2 \* t\) jumps at 0\.5 s"),
    (SAMPLED + 'y = "step(t - 0.37)"', r"step\(t - 0\.37\) jumps at 0\.37 s.* 0\.25 s or 0\.375 s"),
    (SAMPLED + 'y = "sign(t - 0.5)"', r"sign\(t - 0\.5\) .*; write 2\*step\(t - 0\.5\) - 1"),
    (SAMPLED + 'y = "step(0.5 - t)"', r"write 1 - step\(t - 0\.5\)"),
    (DISTURBANCE, r"step\(t - 0\.5\) jumps at 0\.5 s.*expected continuous alphas"),
    ('kind = "step"\ntime = 0.37', r"time: .*0\.37 s.*0\.125 s"),
]


def test_a_jump_that_would_be_wrong_is_refused(tmp_path):
    """With its instant, the nearest points, and the way out."""
    check_refused(WRONG_JUMPS, lambda table: run(tmp_path, table), ScenarioError)


def test_a_value_that_rounding_delays_is_refused(tmp_path):
    """3 t - 0.9 at t = 0.3 is -1.1e-16: the jump would come a step late."""
    with pytest.raises(ScenarioError, match=r"step\(3 \* t - 0\.9\) .* 0\.3 s .*write step\(t -"):
        run(tmp_path, SAMPLED + 'y = "step(3*t - 0.9)"', step=0.1)
    found = run(tmp_path, SAMPLED + 'y = "step(t - 0.3)"', step=0.1)["u.y"]
    assert found.tolist() == [0.0] * 3 + [1.0] * 8


@pytest.mark.parametrize(
    "table",
    [
        EXPRESSION + 'y = "step(t - 0.37) + sign(t - 9.1)"',
        HELD + "t = [0.0, 0.37, 9.1]\ny = [1.0, 0.0, 3.0]",
    ],
)
def test_jumps_outside_of_the_run_do_not_matter(tmp_path, table):
    """Before the start and after the end nothing is computed."""
    assert (run(tmp_path, table, start_time=2.0, stop=3.0)["u.y"] == 0.0).all()


def test_jumps_whose_instants_are_not_known_are_said(tmp_path):
    """They cannot all be found, and a square wave by the sign of a sine is a usual thing."""
    recording = run(tmp_path, SAMPLED + 'y = "step(sin(9*t))"')
    (message,) = [message for message in recording.messages() if message.source == "u"]
    assert "step(sin(9 * t)) jumps where its argument passes 0; between" in message.text


@given(
    st.integers(1, 10**9),
    st.integers(0, 10**12),
    st.lists(st.integers(0, 50), min_size=2, max_size=8, unique=True).map(sorted),
    st.data(),
)
def test_a_held_table_has_its_value_from_its_instant_on(step_ns, start_ns, numbers, data):
    """Also where the instants are sums and products of doubles, a few spacings off.

    What is more than that beside a communication point is refused.
    """
    clock = Clock((start_ns + 50 * step_ns) / 1e9, step_ns / 1e9, start_time=start_ns / 1e9)
    exact = (start_ns + np.array(numbers) * step_ns) / 1e9
    shifts = data.draw(st.lists(st.integers(-2, 2), min_size=len(numbers), max_size=len(numbers)))
    t = exact + np.array(shifts) * np.spacing(exact)
    y = np.arange(float(len(t)))[:, np.newaxis]
    held = held_from_points(t, y, clock)
    assert (held == exact).all()
    table = Table(held, y, hold=True, extrapolate=True)
    block = next(Clock(clock.stop, clock.step, 50, clock.start_time).blocks(50))
    found = [table.outputs(time, np.zeros(0))[0] for time in block.time]
    expected = np.searchsorted(numbers, np.arange(51), side="right") - 1
    assert found == np.maximum(expected, 0).tolist()
    beside = exact.copy()
    beside[-1] += 0.3 * step_ns / 1e9
    if numbers[-1] < 50 and step_ns > 10**6:
        with pytest.raises(UsageError, match="between two communication points"):
            held_from_points(beside, y, clock)


def test_a_held_table_may_have_the_stamps_of_a_step_that_is_a_fraction():
    """So a log has its times: whole nanoseconds; what is beside them is refused."""
    clock = Clock(1.0, Fraction(1, 60))
    stamps = np.array([0.0, 0.016666667, 0.033333333, 0.05])
    y = np.arange(4.0)[:, np.newaxis]
    assert held_from_points(stamps, y, clock).tolist() == (np.arange(4) / 60).tolist()
    with pytest.raises(UsageError, match="between two communication points"):
        held_from_points(np.array([0.0, 0.016666668, 0.033333333, 0.05]), y, clock)


def test_a_regressor_refuses_alphas_that_jump():
    """The delayed instants t - D are rounded, so a product could have one of them a step late."""
    terms = [{"alpha": "1 + step(t - 1)", "family": "exponential"}]
    with pytest.raises(ScenarioError, match=r"step\(t - 1\) jumps at 1\.0 s.*continuous alpha"):
        cosim.run("academic", set={"regressor.terms": terms, "regressor.delays": [0.1, 0.2]})


@pytest.mark.parametrize(
    ("t", "y", "text"),
    [
        ([0.0, 0.51, 0.55, 0.59, 1.0], [0.0, 0.0, 9.0, 0.0, 0.0], "1 rows .* t = 0.55 s it is 1 "),
        ([0.0, 0.45, 0.450001, 1.0], [0.0, 0.0, 1.0, 1.0], "2 rows .* t = 0.45 s it is 0.5 "),
        ([0.0, 0.5, 1.0], [0.0, 1.0, 0.0], ""),  # the kink is at a point
        ([0.0, 0.55, 1.0], [0.0, 0.5501, 1.0], ""),  # hardly a kink
        ([0.0, 2.05, 2.1, 3.0], [0.0, 0.0, 9.0, 9.0], ""),  # behind the run
    ],
)
def test_rows_of_a_table_that_fall_between_communication_points_are_said(tmp_path, t, y, text):
    """A straight line from point to point cannot show them; step 0.1 s."""
    table = f'kind = "table"\nextrapolation = "hold"\nt = {t}\ny = {y}'
    result = run(tmp_path, table, step=0.1)
    notes = [message.text for message in result.messages() if message.source == "u"]
    assert len(notes) == bool(text)
    if text:
        assert re.search(text, notes[0])


JUMPING = {
    "components.u": {"kind": "step", "time": 0.5},
    "scenario.stop": 0.6,
    "components.identifier.start": 0.55,
    "components.regressor.delays": [0.01, 0.02, 0.03],
}


@pytest.fixture(scope="module")
def jumping_log(tmp_path_factory):
    """Return the log of the academic scenario with a step of u at 0.5 s; y = x1 - u."""
    out = tmp_path_factory.mktemp("jumping") / "jumping.mcap"
    return cosim.run("academic", set=JUMPING, out=out)


def test_a_jump_of_u_does_not_throw_the_reconstruction(jumping_log):
    """What the step adds to delta_hat is F x1' - x1'; x1' = -x1 + x2 - 1, x2' = -x1 - 2 x2 + 1.

    It jumps by 1, as -x1' does. A ramp of y over the step before would throw it by
    1000 (1 - (1 - e^-1)) = 368. Linear interpolation of x1 errs by h^2/8 x1'' in it, and by
    1000 times that in delta_hat: 1e-3 / 8 of x1'' = 3 at the jump.
    """
    without = cosim.run("academic", set={**JUMPING, "components.u.after": 0.0})
    added = jumping_log["observer.delta"] - without["observer.delta"]
    assert np.abs(added[:500]).max() == 0.0
    A = np.array([[-1.0, 1.0, 0.0, -1.0], [-1.0, -2.0, 0.0, 1.0], [1e3, 0.0, -1e3, 0.0], [0.0] * 4])
    propagate = expm(1e-3 * A)
    x = np.array([0.0, 0.0, 0.0, 1.0])  # x1, x2, q, u
    for k in range(500, 601):
        exact = 1e3 * (x[0] - x[2]) - A[0] @ x
        assert abs(added[k] - exact) < 4e-4
        x = propagate @ x
    limits = {event.signal: event.values for event in jumping_log.events()}
    assert {event.time_ns for event in jumping_log.events()} == {500_000_000}
    # rounding of a q: 2^-52 of 1000
    jump = jumping_log["observer.delta"][500] - limits["observer.delta"][0]
    assert jump == pytest.approx(1.0, abs=1e-11)
    y = jumping_log["plant.y"][500]
    assert limits["plant.y"][0] - y == pytest.approx(1.0, abs=16 * 2.0**-52)


@pytest.mark.slow
def test_a_run_with_jumps_has_one_hash_and_is_replayed(jumping_log, tmp_path):
    """In blocks of any length; also where the plant is taken from the log, which shows them."""
    content = describe_log(str(jumping_log.path))
    assert content["run"]["events"] == f"{len(jumping_log.events())} jumps of continuous outputs"
    assert "overrides" not in content
    for block in (1, 7):
        log = cosim.run("academic", set=JUMPING, block=block, out=tmp_path / f"{block}.mcap")
        assert log.content_hash() == jumping_log.content_hash()
        assert log.events() == jumping_log.events()
    verification = verify(jumping_log, cosim.replay(jumping_log))
    assert verification.passed
    loaded = cosim.load("academic").set(JUMPING).swap(plant=str(jumping_log.path))
    swapped = cosim.run(loaded)
    for signal in ("observer.delta", "regressor.mu", "plant.y"):
        assert swapped[signal].tobytes() == jumping_log[signal].tobytes()
    assert swapped.events() == jumping_log.events()


# --- derived signals: an expression over signals of other components ---

DERIVED = """
scenario = {{ name = "derived", stop = 2.0, step = 0.01 }}
[components]
s = {{ kind = "sine", rate = 3.0 }}
two = {{ kind = "constant", value = [1.0, -2.0] }}
x = {{ kind = "lag", time_constant = 0.5 }}
z = {{ kind = "lag", time_constant = 0.2 }}
h = {{ kind = "expression", y = "step(t - 1)", discrete = true }}
[components.d]
kind = "expression"
{d}

[connections]
"x.u" = "s.y"
{connections}
"""


def derived(folder, d, connections='"z.u" = "d.y"'):
    path = folder / "derived.toml"
    path.write_text(DERIVED.format(d=d, connections=connections))
    return path


def test_it_is_the_expression_of_its_signals_at_every_row(tmp_path):
    """Signals of all kinds, elements, several expressions; blocks and a replay give its bits."""
    path = derived(
        tmp_path, 'y = ["s.y - 2*x.y", "max(x.y, two.y[1])*t", "\'s.y\'**2"]', '"z.u" = "d.y[1]"'
    )
    run = cosim.run(path, out=tmp_path / "a.mcap")
    s, x, t = run["s.y"], run["x.y"], run.time("s.y")
    expected = np.column_stack([s - 2 * x, np.maximum(x, -2.0) * t, s * s])
    # a power of the kernel may differ by its last bit
    np.testing.assert_array_equal(run["d.y"][:, :2], expected[:, :2])
    np.testing.assert_allclose(run["d.y"][:, 2], expected[:, 2], rtol=2**-51)
    np.testing.assert_array_equal(run["d.u3"], np.full(len(t), -2.0))
    for block in (1, 7, 1000):
        assert cosim.diff(run, cosim.run(path, block=block)).equal
    verification = verify(run, cosim.replay(run.path))
    assert verification.passed, verification.problems
    assert "d.y" in verification.computed


def test_it_closes_a_loop(tmp_path):
    """x' = 2 (u - x) with u = s - 3 x; the loop's error is of first order, so with the step."""
    errors = []
    for step in (0.01, 0.005):
        path = derived(tmp_path, 'y = "s.y - 3*x.y"')
        run = cosim.run(path, set={"scenario.step": step, "connections.x.u": "d.y"})
        t = run.time("x.y")
        # x' = 2 sin(3 t) - 8 x
        exact = (16 * np.sin(3 * t) - 6 * np.cos(3 * t) + 6 * np.exp(-8 * t)) / 73
        errors.append(np.abs(run["x.y"] - exact).max())
    assert 1.7 < errors[0] / errors[1] < 4.6


@pytest.mark.slow
def test_optional_allows_signals_without_a_value(tmp_path):
    """Of theta_hat before T_id; else its connection is refused."""
    text = cosim.load("academic").document.text
    path = tmp_path / "academic.toml"
    table = '\n[components.d]\nkind = "expression"\ny = "2*identifier.theta[0]"\noptional = {}\n'
    path.write_text(text.replace("[connections]", table.format("true") + "\n[connections]"))
    run = cosim.run(path, set={"scenario.stop": 8.0})
    at = np.searchsorted(run.time_ns("d"), run.time_ns("identifier"))
    np.testing.assert_array_equal(run["d.y"][at], 2 * run["identifier.theta"][:, 0])
    assert np.isnan(run["d.y"][0])
    assert not np.isnan(run["d.y"][-1])
    path.write_text(text.replace("[connections]", table.format("false") + "\n[connections]"))
    with pytest.raises(ScenarioError, match=r"components\.d: .*identifier\.theta"):
        cosim.run(path)


def test_it_is_held_where_its_signals_are(tmp_path):
    """A signal of discrete ones is discrete; with t in it, it is not."""
    for d, held in (
        ('y = "h.y + 1"', True),
        ('y = "h.y + t"', False),
        ('y = "h.y + x.y"', False),
        ('y = "h.y + x.y"\ndiscrete = true', True),
    ):
        log = cosim.run(derived(tmp_path, d), out=tmp_path / "a.mcap", force=True)
        assert log.held["z"].tolist() == [held]


def test_jumps_of_interpolated_signals_are_warned_about(tmp_path):
    """They become ramps over a step, or come late; where all is held they do neither."""

    def warned(d):
        run = cosim.run(derived(tmp_path, d))
        return [m.text for m in run.messages() if m.source == "d" and m.level == "warning"]

    (ramp,) = warned('y = "step(x.y)"')
    assert ramp.startswith("step(x.y): jumps with its signals, where these are interpolated")
    assert "becomes a ramp over that step" in ramp
    (late,) = warned('y = "sign(x.y)"\ndiscrete = true')
    assert "that shows at the second" in late
    assert warned('y = "abs(x.y)"') == []
    assert warned('y = "step(h.y - 0.5)"') == []


WRONG_EXPRESSIONS = {
    'y = "s.yy"': "'d.u1': 's.yy': ",
    'y = "s.y + xx.y"': "'d.u2': 'xx.y': ",
    'y = "x.u"': "'d.u1': 'x.u'",
    'y = "two.y"': "two.y -> d.u1: size 2",
    'y = "two.y[2]"': "'two.y'",
    'y = "s.y > 1"': "'s.y > 1'",
    'y = "s.y + v"': "'v'",
    "y = \"s.y + 'v'\"": "'v'",
    'y = "f(s.y)"': "'f'",
    'y = "t"\noptional = true': "optional: expected a signal in y",
}


def test_a_wrong_expression_is_refused_with_its_line(tmp_path):
    """One error each, at the component."""
    place = r"\A.*:[89]: components\.d"
    cases = [
        (d, rf"{place}[^\n]*{re.escape(part)}[^\n]*\Z") for d, part in WRONG_EXPRESSIONS.items()
    ]
    check_refused(cases, lambda d: cosim.load(derived(tmp_path, d)).start(), ScenarioError)

    path = derived(tmp_path, 'y = "s.y"', '"d.u1" = "x.y"\n"z.u" = "d.y"')
    with pytest.raises(ScenarioError, match=r"'d\.u1' has its source from the table of 'd'"):
        cosim.load(path)
