"""The certificate of a run: right where it gives a number, and none where it cannot know one."""

import json
from functools import cache, partial
from signal import SIGINT, raise_signal

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import cosim
from cosim.errors import Interrupted, LogError, ScenarioError, UnknownSignalError, UsageError
from cosim.scenario.exporting import export_component
from cosim.scenario.running import certificate as certificate_module
from tests.fmi import lag
from tests.scenario import certified
from tests.scenario.certified import lag_behind, write

# What the shipped scenarios leave to their defaults, as numbers: the monolithic solutions need it.
STARTS = {"observer.x_a0": [1.0, 0.0], "observer.q0": [1.0], "identifier.method": "least-squares"}


def _signals_of_time():
    """Return a linear system without inputs whose outputs are sin t and delta, and its state at 0.

    A block (s, c)' = [[sigma, w], [-w, sigma]] (s, c) is e^(sigma t) (sin w t, cos w t).
    """

    def block(sigma, w):
        return np.array([[sigma, w], [-w, sigma]])

    S = block_diag(block(0.0, 1.0), -0.1, block(-0.1, 1.7), -0.3, block(-0.3, 2.3))
    sine = np.array([1.0, 0, 0, 0, 0, 0, 0, 0])
    delta = np.array([0, 0, 1.35, 0.25, 0, 1.10, 0, 0.20])
    return S, sine, delta, np.array([0.0, 1, 1, 0, 1, 1, 0, 1])


def monolithic(step, steps, *, closed):
    """Return the exact delta_hat and x_a at the communication points: one matrix exponential.

    Plant, observer (18) and filter (19) with the numbers of C01 in tests/reference/cases.json; in
    the closed loop an actuator x' = 20 (sin t - K x_a - x) drives the plant, u = x.
    """
    A_a = np.array([[-1.0, 1], [-1, -2]])
    B_1a, B_2a = np.array([-1.0, 1]), np.array([1.0, 0])
    C3, F, L = np.array([1.0, 0]), np.array([1.0, 0]), np.array([4.0, 0])
    M_a, N = np.array([[0.0, 0], [-1, -2]]), np.array([0.0, 1])
    rate = 1e3
    S, sine, delta, of_time = _signals_of_time()
    n = 14  # signals of time 8, x_a 2, z 2, q, actuator

    def row(begin, values):
        whole = np.zeros(n)
        whole[begin : begin + len(values)] = values
        return whole

    u = row(13, [1.0]) if closed else row(0, sine)
    w = row(8, C3)  # y - C4 u
    x_hat = np.array([row(10, [1.0, 0]), row(10, [0.0, 1])]) + np.outer(F, w)
    q = row(12, [1.0])
    A = np.zeros((n, n))
    A[:8, :8] = S
    A[8:10, 8:10] = A_a
    A[8:10] += np.outer(B_1a, u) + np.outer(B_2a, row(0, delta))
    A[10:12] = (M_a - np.outer(L, C3)) @ x_hat + np.outer(N, u) + np.outer(L, w)
    A[12] = rate * (w - q)
    A[13] = 20.0 * (row(0, sine) - np.array([0.5, 0.8]) @ x_hat - row(13, [1.0]))
    delta_hat = rate * (w - q) - (C3 @ A_a) @ x_hat - (C3 @ B_1a) * u
    state = np.concatenate([of_time, [1.0, -1.0], [0.0, 0.0], [1.0], [0.0]])
    transition = expm(A * step)
    rows = np.empty((steps + 1, 3))
    for k in range(steps + 1):
        rows[k] = delta_hat @ state, state[8], state[9]
        state = transition @ state
    return rows


@cache
def certified_run(name, stop):
    """Run a shipped scenario with a certificate."""
    log = cosim.run(name, set={**STARTS, "scenario.stop": stop}, certify=True)
    return log, cosim.certificate(log)


@pytest.mark.fast("academic-False")
@pytest.mark.parametrize(("name", "closed"), [("academic", False), ("closed-loop", True)])
@pytest.mark.usefixtures("without_verdicts")
def test_estimate_is_the_difference_from_the_monolithic_solution(name, closed):
    """The error of the step in delta_hat, and in the states, within 20 % of the true one.

    In the cascade it is that of straight lines, of second order; in the loop that of inputs that
    are held, of first order in the states.
    """
    log, certificate = certified_run(name, 5.0)
    exact = monolithic(1e-3, 5000, closed=closed)
    errors = np.column_stack([log["observer.delta"], log["plant.x_a"]]) - exact
    signals = ("observer.delta", "plant.x_a[0]", "plant.x_a[1]")
    for signal, error in zip(signals, errors.T, strict=True):
        found = certificate[signal]
        assert found.largest == pytest.approx(np.abs(error).max(), rel=0.2), signal
        assert found.time == pytest.approx(np.abs(error).argmax() * 1e-3, abs=0.05), signal
        assert found.last == pytest.approx(error[-1], rel=0.2), signal
        assert found.order == pytest.approx(1.0 if closed and "x_a" in signal else 2.0, abs=0.05)


@pytest.mark.slow
def test_share_of_the_coupling_in_theta_is_that_of_the_run():
    """Against the same scenario with a quarter of the step, which keeps 1/16 of the error."""
    settings = {"scenario.stop": 8.0}
    log = cosim.run("academic-as-printed", set=settings, certify=True)
    fine = {**settings, "scenario.step": 2.5e-4, "identifier.start": 6.461}
    limit = cosim.run("academic-as-printed", set=fine)["identifier.theta"][-1]
    shares = cosim.certificate(log).shares
    assert [share.estimate for share in shares] == ["identifier.theta[0]", "identifier.theta[1]"]
    for share, value, at_end in zip(shares, log["identifier.theta"][-1], limit, strict=True):
        assert share.coupling == pytest.approx(value - at_end, rel=0.2)
        assert share.error != 0.0


@pytest.mark.slow
def test_rows_and_hash_are_those_of_the_run_without_a_certificate(tmp_path):
    set_ = {**STARTS, "scenario.stop": 2.0}
    plain = cosim.run("academic", set=set_, out=tmp_path / "a.mcap")
    log = cosim.run("academic", set=set_, out=tmp_path / "b.mcap", certify=True)
    assert log.recorded_hash == plain.recorded_hash
    assert cosim.certificate(log) == cosim.certificate(
        cosim.run("academic", set=set_, certify=True)
    )
    assert json.loads(log.attachment("result.json"))["certificate"]["step"] == 1e-3
    with pytest.raises(LogError, match=r"cosim\.run with certify=True"):
        cosim.certificate(plain)
    with pytest.raises(LogError, match=r"no error estimate of 'observer\.x'; "):
        cosim.certificate(log)["observer.x"]


class InRun:
    """Does something when a run of some number, from 0 on, has reached its end; for progress."""

    def __init__(self, number, act):
        self.number = number
        self.act = act

    def __call__(self, time, end):
        if time < end:
            return
        if self.number == 0:
            self.act()
        self.number -= 1


@pytest.mark.fast("1-ends0")
@pytest.mark.parametrize(("number", "ends"), [(1, [2.0]), (2, [2.0])])
def test_an_interrupt_behind_the_run_leaves_its_log_whole(tmp_path, number, ends):
    """In the run with half the step, or a quarter: the certificate is missing, nothing else."""
    set_ = {**STARTS, "scenario.stop": 2.0}
    plain = cosim.run("academic", set=set_)
    path = tmp_path / "a.mcap"
    cosim.run("academic", set={"scenario.stop": 0.1}, out=path)  # an older one of that name
    interrupt = InRun(number, partial(raise_signal, SIGINT))
    with pytest.raises(Interrupted, match="interrupted by the user") as raised:
        cosim.run("academic", set=set_, out=path, force=True, certify=True, progress=interrupt)
    assert raised.value.exit_code == 130
    assert raised.value.__notes__ == [
        "no error estimate: a run with a smaller step did not complete",
        f"{path} holds the run up to t = 2.0 s",
    ]
    log = cosim.open_log(path)
    assert (log.status, log.reason) == ("complete", "")
    assert log.content_hash() == log.recorded_hash
    assert cosim.diff(log, plain).equal
    certificate = cosim.certificate(log)
    reason = "a run with a smaller step did not complete: interrupted by the user"
    assert (certificate.problem, list(certificate.ends)) == (reason, ends)
    assert list(certificate) == []
    with pytest.raises(UnknownSignalError, match=f"no error estimate of 'plant.y': {reason}"):
        certificate["plant.y"]


def test_an_interrupt_in_the_run_itself_ends_it_there(tmp_path):
    """What there is of it is its log; nothing runs behind it."""
    path = tmp_path / "a.mcap"
    runs = []

    def interrupt(time, end):
        runs.append(time)
        raise_signal(SIGINT)

    set_ = {**STARTS, "scenario.stop": 20.0}
    with pytest.raises(Interrupted) as raised:
        cosim.run("academic", set=set_, out=path, certify=True, progress=interrupt, block=100)
    assert len(runs) == 1
    log = cosim.open_log(path)
    assert log.status == "interrupted"
    assert raised.value.__notes__ == [f"{path} holds the run up to t = {log.end_ns / 1e9} s"]
    assert cosim.certificate(log).problem == "the run ended early: interrupted by the user"


def test_an_interrupted_search_says_that_nothing_is_written(tmp_path):
    """An older log of that name is as it was."""
    path = tmp_path / "a.mcap"
    old = cosim.run("academic", set={"scenario.stop": 0.1}, out=path).recorded_hash
    interrupt = InRun(1, partial(raise_signal, SIGINT))
    tolerances = {"plant.y": 1e-3}
    with pytest.raises(Interrupted) as raised:
        cosim.run("academic", out=path, force=True, find_step=tolerances, progress=interrupt)
    assert raised.value.__notes__ == ["no step was found yet, so nothing is recorded"]
    assert cosim.open_log(path).recorded_hash == old


def test_a_certificate_is_a_mapping():
    """Of the elements of outputs, as the run that it is of is one of signals."""
    log, certificate = certified_run("academic", 5.0)
    names = list(certificate)
    assert len(certificate) == len(certificate.signals) == len(set(names))
    assert {name.partition("[")[0] for name in names} <= set(log)
    assert "plant.x_a[1]" in certificate
    assert "plant.x_a[2]" not in certificate
    assert "plant.u" not in certificate  # an input: what drives it is there
    for name, error in certificate.items():
        assert error is certificate[name]
        assert error.signal == name
    assert certificate.get("plant.z") is None
    text = r"'plant\.x_a'; available: plant\.x_a\[0\], plant\.x_a\[1\]$"
    with pytest.raises(UnknownSignalError, match=text):
        certificate["plant.x_a"]
    with pytest.raises(UnknownSignalError, match=r"'plant\.yy'; did you mean 'plant\.y'\?"):
        certificate["plant.yy"]


@pytest.mark.slow
def test_certificate_does_not_depend_on_blocks():
    set_ = {**STARTS, "scenario.stop": 1.0}
    whole = cosim.certificate(cosim.run("academic", set=set_, certify=True))
    single = cosim.certificate(cosim.run("academic", set=set_, block=1, certify=True))
    assert whole == single


def test_memory_is_bounded_and_the_estimate_nearly_the_same(monkeypatch):
    """Of 401 points 81 are kept, the last among them: the error is one of 2 rad/s, seen to 1 %.

    A cosine is lower by (2 rad/s 0.025 s)^2 / 2 = 0.1 % half of 0.05 s from its top.
    """
    scenario = certified.parsed(certified.SPRING)
    whole = cosim.certificate(cosim.run(scenario, certify=True))
    width = 6  # three inputs, three outputs
    monkeypatch.setattr(certificate_module, "MOST_VALUES", 401 * width / 5)
    thinned = cosim.certificate(cosim.run(scenario, certify=True))
    assert thinned.every == 5
    assert thinned["mass.y"].largest == pytest.approx(whole["mass.y"].largest, rel=0.01)
    assert thinned["mass.y"].last == pytest.approx(whole["mass.y"].last, rel=0.01)
    assert any("every 5th" in note for note in thinned.notes())


# --- where the confident sentence would be false ---


def reasons(path, **changes):
    """Return what is said of each signal that has no estimate."""
    certificate = cosim.certificate(cosim.run(path, certify=True, set=changes))
    return {entry.signal: entry.reason for entry in certificate.signals if entry.largest is None}


def test_a_signal_behind_a_jump_between_points_has_no_estimate(tmp_path, subtests):
    """A jump in the first quarter of a step looks like first order, with twice the true error."""
    for offset in [0.0, 1e-3, 2.4e-3, 4e-3, 6e-3, 9e-3]:
        with subtests.test(offset=offset):
            found = reasons(write(tmp_path, lag_behind(("Jump", 1.0 + offset))))
            assert list(found) == ["lag.y"]
            assert "source.y jumps" in found["lag.y"]


def test_a_signal_behind_a_discrete_jump_at_an_unknown_instant_has_no_estimate(subtests):
    """In the last quarter of a step all three runs have it at the same point, and do not differ."""
    for offset in [1e-3, 4e-3, 6e-3, 9e-3]:
        with subtests.test(offset=offset):
            square = (1.0 + offset) ** 2
            scenario = certified.parsed(f"""
                [components]
                jump = {{ kind = "expression", y = "step(t**2 - {square!r})", discrete = true }}
                lag = {{ kind = "lag", time_constant = 0.5 }}

                [connections]
                "lag.u" = "jump.y"
                """)
            certificate = cosim.certificate(cosim.run(scenario, certify=True))
            assert certificate["lag.y"].largest is None
            assert "jump.y jumps" in certificate["lag.y"].reason


DELAYED = """
    [components]
    sine = {{ kind = "sine", rate = 2.0 }}
    meter = {{ kind = "sensor", delay = {} }}
    lag = {{ kind = "lag", time_constant = 0.5, initial = 0.0 }}

    [connections]
    "meter.u" = "sine.y"
    "lag.u" = "meter.y"
    """


def test_a_delay_that_leaves_another_part_of_a_step_over_in_each_run_has_no_estimate():
    """Of 2.75 ms at 10 ms these are 0.275, 0.55 and 0.1: r (1 - r) = 0.2, 0.25 and 0.09.

    The differences, 0.137 and 0.057 of h^2 y''/2, look like order 1, and a sum that is 38 % high.
    """
    scenario = certified.parsed(DELAYED.format(0.00275))
    certificate = cosim.certificate(cosim.run(scenario, certify=True))
    reason = "0.00275 s of meter is not a whole number of steps"
    for name in ("meter.y", "lag.y"):
        assert certificate[name].largest is None
        assert certificate[name].reason.startswith(reason)
    assert certificate["sine.y"].largest == 0.0


def test_a_delay_that_leaves_the_same_part_over_has_its_order():
    """Nothing of it, or a third and two thirds: r (1 - r) h^2 4/2 of sin 2t.

    Of the largest, which is at a communication point near the top of the sine, 2 (0.03)^2 / 2.
    """
    whole = certified.parsed(DELAYED.format(0.02))
    found = cosim.certificate(cosim.run(whole, certify=True))["meter.y"]
    assert found.largest == 0.0 or found.is_rounding
    grid = {"scenario.step": 0.03, "scenario.stop": 3.9}
    third = certified.parsed(DELAYED.format(0.01))
    found = cosim.certificate(cosim.run(third, set=grid, certify=True))["meter.y"]
    assert found.order == pytest.approx(2.0, abs=0.02)
    assert found.largest == pytest.approx(2.0 / 9.0 * 0.03**2 * 2.0, rel=0.01)


def test_jumps_at_known_instants_do_no_harm():
    """A step in a table of the scenario, and samples of a period: exact behind a lag."""
    scenario = certified.parsed("""
        [components]
        step = { kind = "step", time = 1.0 }
        sine = { kind = "sine", rate = 1.0 }
        sampled = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]], period = 0.5 }
        a = { kind = "lag", time_constant = 0.5, initial = 0.0 }
        b = { kind = "lag", time_constant = 0.5, initial = 0.0 }

        [connections]
        "a.u" = "step.y"
        "sampled.u" = "sine.y"
        "b.u" = "sampled.y"
        """)
    certificate = cosim.certificate(cosim.run(scenario, certify=True))
    for signal in ("a.y", "b.y"):
        assert certificate[signal].largest == 0.0 or certificate[signal].is_rounding


def test_samples_of_unknown_components_count_as_regular_where_they_are(tmp_path):
    """A class that holds its input for 0.1 s tells nobody of it; eight jumps at points are enough.

    Of three within the run, each may be anywhere in the last quarter of a step.
    """
    path = write(tmp_path, certified.HOLDER)
    certificate = cosim.certificate(cosim.run(path, certify=True))
    assert certificate["lag.y"].largest == 0.0 or certificate["lag.y"].is_rounding
    found = reasons(path, **{"holder.every": 1.0})
    assert "holder.y jumps at an unknown instant" in found["lag.y"]


def test_an_estimate_behind_a_bend_is_at_most_a_third_off(tmp_path, subtests):
    """|t - s| and its straight line enclose the area s' (h - s'), which the lag takes over 0.5 s.

    At s' < h/4 the differences are s' h/2 and s' h/4, which look like first order of s' h: a third
    more than the area at s' = h/4.
    """
    for offset in [2e-4, 1e-3, 2.4e-3, 2.5e-3, 2.6e-3, 5e-3, 7.5e-3, 9.8e-3]:
        with subtests.test(offset=offset):
            log = cosim.run(write(tmp_path, lag_behind(("Bend", 1.0 + offset))), certify=True)
            found = cosim.certificate(log)["lag.y"]
            area = offset * (1e-2 - offset)
            if found.largest is not None:
                # The lag's own decay over the step is 2 %.
                assert 0.9 * area / 0.5 < found.largest < 1.34 * area / 0.5


def test_chaos_has_no_estimate(tmp_path):
    path = write(tmp_path, certified.LORENZ)
    found = reasons(path, **{"scenario.stop": 15.0})
    assert list(found) == ["x.y", "y.y", "z.y"]


def test_a_relay_that_switches_at_every_step_has_no_estimate(tmp_path):
    assert list(reasons(write(tmp_path, certified.RELAY))) == ["relay.y", "mass.y"]


def test_an_estimate_of_a_loop_that_saturates_is_right_or_there_is_none(subtests):
    """A PID at its limits against a hundredth of the step."""
    for limit in [0.2, 0.5, 0.9, 1.3]:
        with subtests.test(limit=limit):
            limits = f"lower = -{limit}, upper = {limit}"
            document = f"""
                [components]
                reference = {{ kind = "sine", rate = 2.0 }}
                pid = {{ kind = "pid", gain = 3.0, integral_time = 0.7, {limits} }}
                plant = {{ kind = "lag", time_constant = 0.5, initial = 0.0 }}

                [connections]
                "pid.setpoint" = "reference.y"
                "pid.measurement" = "plant.y"
                "plant.u" = "pid.y"
                """
            scenario = certified.parsed(document)
            log = cosim.run(scenario, certify=True)
            limit_run = cosim.run(scenario, set={"scenario.step": 1e-4})
            found = cosim.certificate(log)["plant.y"]
            true = np.abs(log["plant.y"] - limit_run["plant.y"][::100]).max()
            if found.largest is not None:
                assert found.largest == pytest.approx(true, rel=1.0 / 3.0)


def test_an_exact_signal_has_no_estimate_but_rounding(tmp_path):
    found = reasons(write(tmp_path, certified.EXACT))
    assert "at the level of rounding" in found["lag.y"]


def test_a_coupling_that_is_unstable_at_every_step_is_named(tmp_path):
    """It multiplies by -1.02 a step: twice the steps are the square of that."""
    found = reasons(write(tmp_path, certified.ECHO))
    assert "the differences grow as the step is halved" in found["echo.y"]


def test_a_coupled_oscillator_is_estimated(tmp_path):
    """y'' = -4 y from 1 is cos 2t; the inputs of the loop are held, which is of first order."""
    log = cosim.run(write(tmp_path, certified.SPRING), certify=True)
    t = log.time("mass")
    found = cosim.certificate(log)["mass.y"]
    true = np.abs(log["mass.y"] - np.cos(2.0 * t)).max()
    assert found.largest == pytest.approx(true, rel=0.1)
    assert found.order == pytest.approx(1.0, abs=0.1)


def test_runs_that_a_condition_ends_are_compared_up_to_the_first_end():
    """They pass 0 at pi/4 = 0.7854 s, and end at the first of their own points behind that."""
    scenario = certified.parsed(certified.SPRING)
    log = cosim.run(scenario, set={"scenario.until": "mass.y < 0"}, certify=True)
    found = cosim.certificate(log)
    assert found.ends == (0.79, 0.79, 0.7875)
    t = log.time("mass")
    within = t <= min(found.ends)
    true = np.abs(log["mass.y"] - np.cos(2.0 * t))[within].max()
    assert found["mass.y"].largest == pytest.approx(true, rel=0.1)


# --- noise, and what cannot be certified ---


def test_an_fmu_that_takes_no_smaller_step_leaves_no_estimate(tmp_path):
    """The run is kept; the report names the FMU and its step."""
    lag.able(lag.build(tmp_path, "3"), tmp_path / "x.fmu", "3", "inner step of 30 ms")
    path = tmp_path / "x.toml"
    path.write_text(
        'scenario = { name = "x", stop = 0.3, step = 0.03 }\n'
        'components.x = { kind = "fmu", path = "x.fmu" }\n'
    )
    log = cosim.run(path, certify=True, out=tmp_path / "a.mcap")
    assert log.status == "complete"
    certificate = log.results["certificate"]
    assert certificate["signals"] == {}
    assert "0.015 s" in certificate["problem"]
    assert "inner steps of 0.03 s" in certificate["problem"]


def test_noise_of_every_step_is_refused_by_name():
    with pytest.raises(UsageError, match="step error: sensor draws random numbers at every") as e:
        cosim.run("academic-noisy", certify=True)
    assert "set={'sensor.period': '0.001'}" in str(e.value)


ACTION = """
    [components]
    sine = { kind = "sine", rate = 1.0 }
    gain = { kind = "gain", K = [[2.0]] }
    lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }

    [connections]
    "gain.u" = "sine.y"
    "lag.u" = "gain.y"

    [[actions]]
    at = 1.0
    signal = "gain.u"
    """


SLOWER = """
    [components]
    sine = { kind = "sine", rate = 1.0 }
    lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }
    slower = { kind = "lag", time_constant = 3.0, initial = 0.0 }

    [connections]
    "lag.u" = "sine.y"
    "slower.u" = "sine.y"
    """
FMU = 'kind = "fmu", path = "lag.fmu", interface_type = "me"'
CONDITIONAL_SWAP = """
    [[actions]]
    when = "sine.y > 0.5"
    swap = { lag = "slower.fmu" }
    """


def test_jumps_by_actions_at_their_instants_are_none_between_points():
    """The right limit begins the next step of every run: the lag errs by straight lines alone.

    By h^2/12 of -2 sin t, and the jump of its second derivative leaves nothing: order 2.
    """
    log = cosim.run(certified.parsed(ACTION + "offset = 0.5"), certify=True)
    found = cosim.certificate(log)
    assert found["gain.y"].largest == 0.0
    assert found["lag.y"].order == pytest.approx(2.0, abs=0.05)


ECHO = """
    [components]
    zero = { kind = "constant", value = 0.0 }
    echo = { kind = "python", class = "parts:Echo", gain = 1.0, initial = 0.0 }
    lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }

    [connections]
    "echo.u" = "zero.y"
    "lag.u" = "echo.y"

    [[actions]]
    at = 1.0
    signal = "echo.u"
    override = 1.0
    """


def test_a_jump_within_the_first_step_behind_an_action_is_expected(tmp_path):
    """What follows an input a step late rises from 0 to 1 over that step: half of it late, order 1.

    The lag is at 1 - (T/h)(1 - exp(-h/T)) behind it, the exact one at 1 - exp(-h/T).
    """
    found = cosim.certificate(cosim.run(write(tmp_path, ECHO), certify=True))
    rest = np.exp(-0.01 / 0.5)
    assert found["lag.y"].time == 1.01
    assert found["lag.y"].order == pytest.approx(1.0, abs=0.02)
    assert found["lag.y"].largest == pytest.approx((1.0 - rest) * 51.0 - 1.0, rel=0.02)


@pytest.mark.parametrize(
    ("effect", "changed"),
    [
        ('signal = "gain.u"\n    override = 0.3', ("gain.y", "lag.y")),
        ('set = { "lag.time_constant" = 0.7 }', ("lag.y",)),
    ],
)
def test_a_signal_changed_by_an_action_on_a_condition_has_no_estimate(effect, changed):
    """It comes true at the first point behind its instant: up to a step late, whatever the order.

    In the last quarter of a step all three runs would have it at the same point. One that never
    comes true changes nothing.
    """
    action = ACTION.replace("at = 1.0", 'when = "sine.y > LEVEL"')
    conditional = action.replace('signal = "gain.u"', effect)
    log = cosim.run(certified.parsed(conditional.replace("LEVEL", "0.5")), certify=True)
    found = cosim.certificate(log)
    assert found["sine.y"].largest == 0.0
    text = "the action when 'sine.y > 0.5' takes effect at a point that depends on the step"
    assert {name for name in found if found[name].reason == text} == set(changed)
    log = cosim.run(certified.parsed(conditional.replace("LEVEL", "5")), certify=True)
    assert cosim.certificate(log)["lag.y"].order == pytest.approx(2.0, abs=0.01)


@pytest.mark.slow
def test_a_signal_behind_a_swap_on_a_condition_has_no_estimate(tmp_path):
    """As behind any other action on one: the models differ from a point on that depends on it."""
    path = write(tmp_path, SLOWER)
    for name in ("lag", "slower"):
        export_component(str(path), name, tmp_path / f"{name}.fmu")
    swapped = SLOWER.replace('kind = "lag", time_constant = 0.5, initial = 0.0', FMU)
    path = write(tmp_path, swapped + CONDITIONAL_SWAP)
    found = cosim.certificate(cosim.run(path, certify=True))
    text = "the action when 'sine.y > 0.5' takes effect at a point that depends on the step"
    assert found["lag.y"].reason == text
    assert found["slower.y"].order == pytest.approx(2.0, abs=0.01)


def test_a_parameter_that_is_set_at_its_instant_keeps_the_order():
    setting = 'at = 1.0\n    set = { "lag.time_constant" = 0.7 }'
    text = ACTION.replace('at = 1.0\n    signal = "gain.u"', setting)
    log = cosim.run(certified.parsed(text), certify=True)
    assert cosim.certificate(log)["lag.y"].order == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("effect", ["noise = 0.1", "drop = 0.5"])
def test_noise_by_actions_is_refused(effect):
    with pytest.raises(UsageError, match=r"step error: the action at 1.0 s draws random numbers"):
        cosim.run(certified.parsed(ACTION + effect), certify=True)


def test_noise_with_a_period_stays(tmp_path):
    """A lag behind held noise is exact; one behind a sine has the error of its straight lines."""
    scenario = certified.parsed("""
        [components]
        noise = { kind = "noise", deviation = 1.0, seed = 1, period = 0.04 }
        sine = { kind = "sine", rate = 1.0 }
        a = { kind = "lag", time_constant = 0.5, initial = 0.0 }
        b = { kind = "lag", time_constant = 0.5, initial = 0.0 }

        [connections]
        "a.u" = "noise.y"
        "b.u" = "sine.y"
        """)
    log = cosim.run(scenario, certify=True)
    certificate = cosim.certificate(log)
    assert certificate["noise.y"].largest == 0.0
    assert "at the level of rounding" in certificate["a.y"].reason
    assert certificate["b.y"].order == pytest.approx(2.0, abs=0.01)
    assert len(np.unique(log["noise.y"])) == 101


@pytest.mark.parametrize("period", [0.01, 0.02])
def test_a_noisy_sensor_with_a_period_keeps_the_order(period):
    """Also with that of a step: y holds over it in all three runs, with the same noise.

    What it samples errs by the straight lines of the sine, and so does what follows.
    """
    scenario = certified.parsed(f"""
        [components]
        sine = {{ kind = "sine", rate = 1.0 }}
        plant = {{ kind = "lag", time_constant = 0.5, initial = 0.0 }}
        sensor = {{ kind = "sensor", noise = 1e-2, seed = 1, period = {period} }}
        lag = {{ kind = "lag", time_constant = 0.1 }}

        [connections]
        "plant.u" = "sine.y"
        "sensor.u" = "plant.y"
        "lag.u" = "sensor.y"
        """)
    certificate = cosim.certificate(cosim.run(scenario, certify=True))
    for signal in ("plant.y", "sensor.y", "lag.y"):
        assert certificate[signal].order == pytest.approx(2.0, abs=0.02), signal


def test_a_step_without_a_quarter_is_refused():
    scenario = certified.parsed(certified.SPRING)
    with pytest.raises(UsageError, match=r"a quarter of the step 2e-09 s is not a whole number"):
        cosim.run(scenario, set={"scenario.step": 2e-9, "scenario.stop": 1e-7}, certify=True)


@pytest.mark.usefixtures("without_verdicts")
def test_a_recorded_component_is_refused_by_its_log(tmp_path):
    """A recording has the rows of its own step alone."""
    cosim.run("academic", set={**STARTS, "scenario.stop": 1.0}, out=tmp_path / "a.mcap")
    swap = {"plant": tmp_path / "a.mcap"}
    with pytest.raises(
        (UsageError, ScenarioError), match=r"(?s)must also run with 0.0005 s.*a.mcap"
    ):
        cosim.run("academic", set={**STARTS, "scenario.stop": 1.0}, swap=swap, certify=True)


@pytest.mark.slow
def test_a_run_that_fails_has_no_figures(tmp_path):
    """Also where only the finer one does: values of 1e300 come with twice the steps."""
    path = write(tmp_path, certified.ECHO)
    unwatched = {"scenario.stop": 200.0, "scenario.coupling_check": "warn"}
    log = cosim.run(path, set=unwatched, certify=True)
    certificate = cosim.certificate(log)
    assert "no complete run with steps of 0.005 s" in certificate.problem
    assert certificate.signals == ()


def test_certify_is_true_or_false():
    with pytest.raises(UsageError, match=r"certify: .* 1$"):
        cosim.run("academic", certify=1)


# --- loops of first and second order ---


def random_loop(seed):
    """Return a scenario of linear components in a loop, its signals, and their exact values.

    2 to 4 components of 1 to 3 states, each driven by one or two others, one by sin 2t, too. The
    exact solution is that of one system of all states and of the sine: a matrix exponential.
    """
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 5))
    sizes = rng.integers(1, 4, count)
    ends = np.cumsum(sizes)
    parts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    n = ends[-1]
    M = np.zeros((n + 2, n + 2))
    M[n:, n:] = [[0.0, 2.0], [-2.0, 0.0]]
    outputs = np.zeros((count + 1, n + 2))
    outputs[count, n] = 1.0
    x = np.concatenate([rng.normal(size=n), [0.0, 1.0]])
    components = 'c%d = { kind = "controller", A = %s, B = %s, C = %s, D = [%s], x0 = %s }'
    lines = [f'[components]\nc{count} = {{ kind = "sine", rate = 2.0 }}']
    connections = ["[connections]"]
    drivers = [[(i - 1) % count, *([(i - 2) % count] if count > 2 else [])] for i in range(count)]
    drivers[0].append(count)
    for i, part in enumerate(parts):
        outputs[i, part] = rng.normal(size=sizes[i])
    for i, part in enumerate(parts):
        A = rng.normal(size=(sizes[i], sizes[i]))
        A -= (np.linalg.eigvals(A).real.max() + rng.uniform(0.2, 2.0)) * np.eye(sizes[i])
        B = rng.normal(size=(sizes[i], len(drivers[i])))
        M[part, part] += A
        M[part] += B @ outputs[drivers[i]]
        values = A.tolist(), B.tolist(), [outputs[i, part].tolist()], [0.0] * len(drivers[i])
        lines.append(components % (i, *values, x[part].tolist()))
        connections.append(f'"c{i}.u" = {json.dumps([f"c{j}.y" for j in drivers[i]])}')
    return "\n".join(lines + connections), M, outputs, x, parts


def check_random_loop(seed):
    """Check every certificate of a random loop; return how many have an estimate, and a bound."""
    text, M, outputs, x, parts = random_loop(seed)
    settings = {"scenario.step": 0.04, "scenario.coupling_check": "warn"}
    log = cosim.run(certified.parsed(text), set=settings, certify=True)
    certificate = cosim.certificate(log)
    t = log.time("c0.y")
    states = expm(M * t[1])
    rows = [x]
    for _ in t[1:]:
        rows.append(states @ rows[-1])
    exact = np.array(rows)
    counts = [0, 0]
    for i, part in enumerate(parts):
        errors = {f"c{i}.y": log[f"c{i}.y"] - exact @ outputs[i]}
        of_x = log[f"c{i}.x"].reshape(len(t), -1) - exact[:, part]
        for j, error in enumerate(of_x.T):
            errors[f"c{i}.x[{j}]" if len(of_x.T) > 1 else f"c{i}.x"] = error
        for signal, error in errors.items():
            found = certificate[signal]
            largest = np.abs(error).max()
            if found.largest is not None:
                assert found.largest == pytest.approx(largest, rel=0.2), signal
            else:  # 1.25 of one of first order, 1.31 of second
                assert largest <= found.bound <= 1.5 * largest, signal
            counts[found.largest is None] += 1
    return counts


def test_where_orders_mix_there_is_an_upper_bound():
    """Of the first order of inputs that are held, and the second of straight lines."""
    estimated, bounded = check_random_loop(0)
    assert estimated > 0
    assert bounded > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(14))
def test_every_output_of_a_random_loop_has_an_estimate_or_a_bound(seed):
    assert sum(check_random_loop(seed)) > 0
