"""Derived signals: the kind ``expression`` over signals of other components."""

import re

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.verification import verify
from tests.scenario.refusals import check_refused

BASE = """
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


def file(folder, d, connections='"z.u" = "d.y"'):
    path = folder / "derived.toml"
    path.write_text(BASE.format(d=d, connections=connections))
    return path


def test_it_is_the_expression_of_its_signals_at_every_row(tmp_path):
    """Signals of all kinds, elements, several expressions; blocks and a replay give its bits."""
    path = file(
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
        path = file(tmp_path, 'y = "s.y - 3*x.y"')
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
        log = cosim.run(file(tmp_path, d), out=tmp_path / "a.mcap", force=True)
        assert log.held["z"].tolist() == [held]


def test_jumps_of_interpolated_signals_are_warned_about(tmp_path):
    """They become ramps over a step, or come late; where all is held they do neither."""

    def warned(d):
        run = cosim.run(file(tmp_path, d))
        return [m.text for m in run.messages() if m.source == "d" and m.level == "warning"]

    (ramp,) = warned('y = "step(x.y)"')
    assert ramp.startswith("step(x.y): jumps with its signals, where these are interpolated")
    assert "becomes a ramp over that step" in ramp
    (late,) = warned('y = "sign(x.y)"\ndiscrete = true')
    assert "that shows at the second" in late
    assert warned('y = "abs(x.y)"') == []
    assert warned('y = "step(h.y - 0.5)"') == []


REFUSED = {
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

    def start(d):
        cosim.load(file(tmp_path, d)).start()

    place = r"\A.*:[89]: components\.d"
    cases = [(d, rf"{place}[^\n]*{re.escape(part)}[^\n]*\Z") for d, part in REFUSED.items()]
    check_refused(cases, start, ScenarioError)

    path = file(tmp_path, 'y = "s.y"', '"d.u1" = "x.y"\n"z.u" = "d.y"')
    with pytest.raises(ScenarioError, match=r"'d\.u1' has its source from the table of 'd'"):
        cosim.load(path)
