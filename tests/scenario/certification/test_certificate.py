"""The certificate of a run: right where it gives a number, and none where it cannot know one."""

import json
from functools import cache
from signal import SIGINT, raise_signal

import numpy as np
import pytest
from scipy.linalg import expm

import cosim
from cosim.errors import Interrupted, LogError, ScenarioError, UnknownSignalError, UsageError
from cosim.scenario.exporting import export_component
from cosim.scenario.running import certificate as certificate_module
from tests.fmi import lag
from tests.scenario import certified
from tests.scenario.certified import lag_behind, write
from tests.scenario.refusals import check_refused


def certify(scenario, **settings):
    """Run a scenario, or a text of one, with a certificate; return that."""
    if isinstance(scenario, str):
        scenario = certified.parsed(scenario)
    return cosim.certificate(cosim.run(scenario, certify=True, **settings))


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """Return the log of a run of the spring with its certificate."""
    path = tmp_path_factory.mktemp("spring") / "a.mcap"
    return cosim.run(certified.parsed(certified.SPRING), out=path, certify=True)


def test_an_estimate_is_the_difference_from_the_exact_solution(spring):
    """y'' = -4 y from 1 is cos 2t; the inputs of the loop are held, which is of first order."""
    error = spring["mass.y"] - np.cos(2.0 * spring.time("mass"))
    found = cosim.certificate(spring)["mass.y"]
    assert found.largest == pytest.approx(np.abs(error).max(), rel=0.1)
    assert found.time == pytest.approx(np.abs(error).argmax() * 0.01, abs=0.05)
    assert found.last == pytest.approx(error[-1], abs=0.01 * found.largest)
    assert found.order == pytest.approx(1.0, abs=0.1)


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


def test_rows_and_hash_are_those_of_the_run_without_a_certificate(spring, tmp_path):
    """And the certificate is one of the run, in whatever blocks."""
    plain = cosim.run(certified.parsed(certified.SPRING), out=tmp_path / "a.mcap")
    assert spring.recorded_hash == plain.recorded_hash
    assert cosim.certificate(spring) == certify(certified.SPRING, block=1)
    assert json.loads(spring.attachment("result.json"))["certificate"]["step"] == 0.01
    with pytest.raises(LogError, match=r"cosim\.run with certify=True"):
        cosim.certificate(plain)


def test_a_certificate_is_a_mapping():
    """Of the elements of outputs, as the run that it is of is one of signals."""
    log = cosim.run("academic", certify=True, stop=0.1, verdicts=False)
    certificate = cosim.certificate(log)
    assert len(certificate) == len(certificate.signals) == len(set(certificate))
    assert "plant.x_a[1]" in certificate
    assert "plant.u" not in certificate  # an input: what drives it is there
    for name, error in certificate.items():
        assert (certificate[name], error.signal) == (error, name)
    assert certificate.get("plant.z") is None
    text = r"'plant\.x_a'; available: plant\.x_a\[0\], plant\.x_a\[1\]$"
    with pytest.raises(UnknownSignalError, match=text):
        certificate["plant.x_a"]


def test_memory_is_bounded_and_the_estimate_nearly_the_same(spring, monkeypatch):
    """Of 401 points 81 are kept, the last among them: the error is one of 2 rad/s, seen to 1 %.

    A cosine is lower by (2 rad/s 0.025 s)^2 / 2 = 0.1 % half of 0.05 s from its top.
    """
    whole = cosim.certificate(spring)
    width = 6  # three inputs, three outputs
    monkeypatch.setattr(certificate_module, "MOST_VALUES", 401 * width / 5)
    thinned = certify(certified.SPRING)
    assert thinned.every == 5
    assert thinned["mass.y"].largest == pytest.approx(whole["mass.y"].largest, rel=0.01)
    assert thinned["mass.y"].last == pytest.approx(whole["mass.y"].last, rel=0.01)
    assert any("every 5th" in note for note in thinned.notes())


# --- runs that end early ---


def interrupt_in(number):
    """Return a progress that interrupts a run of some number, from 0 on, at its end."""
    ended = []

    def progress(time, end):
        if time >= end:
            ended.append(end)
            if len(ended) == number + 1:
                raise_signal(SIGINT)

    return progress


@pytest.mark.parametrize("number", [1, 2])
def test_an_interrupt_behind_the_run_leaves_its_log_whole(tmp_path, number):
    """In the run with half the step, or a quarter: the certificate is missing, nothing else."""
    scenario = certified.parsed(certified.SMOOTH)
    plain = cosim.run(scenario)
    path = tmp_path / "a.mcap"
    cosim.run(scenario, stop=0.1, out=path)  # an older one of that name
    with pytest.raises(Interrupted, match="interrupted by the user") as raised:
        cosim.run(scenario, out=path, force=True, certify=True, progress=interrupt_in(number))
    assert raised.value.__notes__ == [
        "no error estimate: a run with a smaller step did not complete",
        f"{path} holds the run up to t = 4.0 s",
    ]
    log = cosim.open_log(path)
    assert (log.status, log.reason) == ("complete", "")
    assert log.content_hash() == log.recorded_hash
    assert cosim.diff(log, plain).equal
    certificate = cosim.certificate(log)
    reason = "a run with a smaller step did not complete: interrupted by the user"
    assert (certificate.problem, certificate.ends) == (reason, (4.0,))
    with pytest.raises(UnknownSignalError, match=f"no error estimate of 'lag.y': {reason}"):
        certificate["lag.y"]


def test_an_interrupt_in_the_run_itself_ends_it_there(tmp_path):
    """What there is of it is its log; nothing runs behind it."""
    path = tmp_path / "a.mcap"
    runs = []

    def interrupt(time, end):
        runs.append(time)
        raise_signal(SIGINT)

    scenario = certified.parsed(certified.SPRING)
    with pytest.raises(Interrupted):
        cosim.run(scenario, out=path, certify=True, progress=interrupt, block=100)
    assert len(runs) == 1
    log = cosim.open_log(path)
    assert log.status == "interrupted"
    assert cosim.certificate(log).problem == "the run ended early: interrupted by the user"


def test_an_interrupted_search_says_that_nothing_is_written(tmp_path):
    """An older log of that name is as it was."""
    path = tmp_path / "a.mcap"
    scenario = certified.parsed(certified.SMOOTH)
    old = cosim.run(scenario, out=path).recorded_hash
    find = {"lag.y": 1e-3}
    with pytest.raises(Interrupted) as raised:
        cosim.run(scenario, out=path, force=True, find_step=find, progress=interrupt_in(1))
    assert raised.value.__notes__ == ["no step was found yet, so nothing is recorded"]
    assert cosim.open_log(path).recorded_hash == old


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


@pytest.mark.slow
def test_a_run_that_fails_has_no_figures(tmp_path):
    """Also where only the finer one does: values of 1e300 come with twice the steps."""
    unwatched = {"scenario.stop": 200.0, "scenario.coupling_check": "warn"}
    certificate = certify(write(tmp_path, certified.ECHO), set=unwatched)
    assert "no complete run with steps of 0.005 s: " in certificate.problem
    assert certificate.signals == ()


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


# --- where the confident sentence would be false ---


@pytest.mark.parametrize("offset", [0.0, 1e-3, 2.4e-3, 9e-3])
def test_a_signal_behind_a_jump_between_points_has_no_estimate(tmp_path, offset):
    """A jump in the first quarter of a step looks like first order, with twice the true error.

    In the last quarter of a step all three runs have it at the same point, and do not differ; so is
    one that a discrete output tells of, at an instant that is not known.
    """
    found = certify(write(tmp_path, lag_behind(("Jump", 1.0 + offset))))
    assert found["lag.y"].largest is None
    assert "source.y jumps" in found["lag.y"].reason
    if offset:
        discrete = f'"expression", y = "step(t**2 - {(1.0 + offset) ** 2!r})", discrete = true'
        found = certify(lag_behind(("kind", discrete)))
        assert found["lag.y"].largest is None
        assert "source.y jumps" in found["lag.y"].reason


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
    certificate = certify(DELAYED.format(0.00275))
    for name in ("meter.y", "lag.y"):
        assert certificate[name].largest is None
        assert "0.00275 s of meter is not a whole number of steps" in certificate[name].reason
    assert certificate["sine.y"].largest == 0.0


def test_a_delay_that_leaves_the_same_part_over_has_its_order():
    """Nothing of it, or a third and two thirds: r (1 - r) h^2 4/2 of sin 2t.

    Of the largest, which is at a communication point near the top of the sine, 2 (0.03)^2 / 2.
    """
    found = certify(DELAYED.format(0.02))["meter.y"]
    assert found.largest == 0.0 or found.is_rounding
    grid = {"scenario.step": 0.03, "scenario.stop": 3.9}
    found = certify(DELAYED.format(0.01), set=grid)["meter.y"]
    assert found.order == pytest.approx(2.0, abs=0.02)
    assert found.largest == pytest.approx(2.0 / 9.0 * 0.03**2 * 2.0, rel=0.01)


def test_jumps_at_known_instants_do_no_harm():
    """A step in a table, samples of a period, held noise: exact behind a lag."""
    log = cosim.run(
        certified.parsed("""
        [components]
        step = { kind = "step", time = 1.0 }
        sine = { kind = "sine", rate = 1.0 }
        sampled = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]], period = 0.5 }
        noise = { kind = "noise", deviation = 1.0, seed = 1, period = 0.04 }
        a = { kind = "lag", time_constant = 0.5, initial = 0.0 }
        b = { kind = "lag", time_constant = 0.5, initial = 0.0 }
        c = { kind = "lag", time_constant = 0.5, initial = 0.0 }

        [connections]
        "a.u" = "step.y"
        "sampled.u" = "sine.y"
        "b.u" = "sampled.y"
        "c.u" = "noise.y"
        """),
        certify=True,
    )
    certificate = cosim.certificate(log)
    for signal in ("a.y", "b.y", "c.y"):
        assert certificate[signal].largest == 0.0 or certificate[signal].is_rounding
    assert len(np.unique(log["noise.y"])) == 101


def test_samples_of_unknown_components_count_as_regular_where_they_are(tmp_path):
    """A class that holds its input for 0.1 s tells nobody of it; eight jumps at points are enough.

    Of three within the run, each may be anywhere in the last quarter of a step.
    """
    path = write(tmp_path, lag_behind(("Holder", 0.1)))
    found = certify(path)["lag.y"]
    assert found.largest == 0.0 or found.is_rounding
    found = certify(path, set={"source.time": 1.0})["lag.y"]
    assert "source.y jumps at an unknown instant" in found.reason


@pytest.mark.parametrize("offset", [2e-4, 2.4e-3, 2.6e-3, 5e-3, 7.5e-3, 9.8e-3])
def test_an_estimate_behind_a_bend_is_at_most_a_third_off(offset):
    """|t - s| and its straight line enclose the area s' (h - s'), which the lag takes over 0.5 s.

    At s' < h/4 the differences are s' h/2 and s' h/4, which look like first order of s' h: a third
    more than the area at s' = h/4. The lag's own decay over the step is 2 %.
    """
    found = certify(lag_behind(("kind", f'"expression", y = "abs(t - {1.0 + offset})"')))["lag.y"]
    area = offset * (1e-2 - offset)
    assert found.largest is None or 0.9 * area / 0.5 < found.largest < 1.34 * area / 0.5


@pytest.mark.parametrize(
    ("text", "settings", "components", "reason"),
    [
        (certified.LORENZ, {"scenario.stop": 15.0}, [*"xyz", "of_x", "of_y", "of_z"], ""),  # chaos
        (certified.RELAY, {}, ["relay", "mass"], ""),  # it switches at every step
        (certified.EXACT, {}, ["lag"], "at the level of rounding"),
        # twice the steps are the square of what they multiply by
        (certified.ECHO, {}, ["echo", "gain"], "the differences grow as the step is halved"),
    ],
)
def test_what_three_runs_do_not_show_has_no_estimate(tmp_path, text, settings, components, reason):
    certificate = certify(write(tmp_path, text), set=settings)
    found = {entry.signal: entry for entry in certificate.signals if entry.largest is None}
    assert list(found) == [f"{name}.y" for name in components]
    assert all(reason in error.reason for error in found.values())


# --- actions ---

ACTION = """
    [components]
    sine = {{ kind = "sine", rate = 1.0 }}
    gain = {{ kind = "gain", K = [[2.0]] }}
    lag = {{ kind = "lag", time_constant = 0.5, initial = 0.0 }}

    [connections]
    "gain.u" = "sine.y"
    "lag.u" = "gain.y"

    [[actions]]
    {}
    """
OFFSET = 'signal = "gain.u"\noffset = 0.5'
SETTING = 'set = { "lag.time_constant" = 0.7 }'


@pytest.mark.parametrize("effect", [OFFSET, SETTING])
def test_actions_at_their_instants_keep_the_order(effect):
    """The right limit begins the next step of every run: the lag errs by straight lines alone.

    By h^2/12 of -2 sin t, and the jump of its second derivative leaves nothing: order 2.
    """
    found = certify(ACTION.format(f"at = 1.0\n{effect}"))
    assert found["gain.y"].largest == 0.0
    assert found["lag.y"].order == pytest.approx(2.0, abs=0.05)


def test_a_jump_within_the_first_step_behind_an_action_is_expected(tmp_path):
    """What follows an input a step late rises from 0 to 1 over that step: half of it late, order 1.

    The lag is at 1 - (T/h)(1 - exp(-h/T)) behind it, the exact one at 1 - exp(-h/T).
    """
    text = """
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
    found = certify(write(tmp_path, text))["lag.y"]
    rest = np.exp(-0.01 / 0.5)
    assert found.time == 1.01
    assert found.order == pytest.approx(1.0, abs=0.02)
    assert found.largest == pytest.approx((1.0 - rest) * 51.0 - 1.0, rel=0.02)


@pytest.mark.parametrize(
    ("effect", "changed"), [(OFFSET, {"gain.y", "lag.y"}), (SETTING, {"lag.y"})]
)
def test_a_signal_changed_by_an_action_on_a_condition_has_no_estimate(effect, changed):
    """It comes true at the first point behind its instant: up to a step late, whatever the order.

    In the last quarter of a step all three runs would have it at the same point. One that never
    comes true changes nothing.
    """
    found = certify(ACTION.format(f'when = "sine.y > 0.5"\n{effect}'))
    assert found["sine.y"].largest == 0.0
    text = "the action when 'sine.y > 0.5' takes effect at a point that depends on the step"
    assert {name for name in found if found[name].reason == text} == changed
    found = certify(ACTION.format(f'when = "sine.y > 5"\n{effect}'))
    assert found["lag.y"].order == pytest.approx(2.0, abs=0.01)


@pytest.mark.slow
def test_a_signal_behind_a_swap_on_a_condition_has_no_estimate(tmp_path):
    """As behind any other action on one: the models differ from a point on that depends on it."""
    lag = certified.parsed(certified.SMOOTH)
    for name, time in (("lag", 0.5), ("slower", 3.0)):
        changed = lag.set({"lag.time_constant": time})
        export_component(changed, "lag", tmp_path / f"{name}.fmu")
    action = '\n[[actions]]\nwhen = "sine.y > 0.5"\nswap = { lag = "slower.fmu" }\n'
    path = write(tmp_path, certified.SMOOTH + action)
    found = certify(path, swap={"lag": f"{tmp_path}/lag.fmu#me"})
    assert found["lag.y"].reason.startswith("the action when 'sine.y > 0.5' takes effect")


# --- noise, and what cannot be certified ---


@pytest.mark.parametrize("period", [0.01, 0.02])
def test_a_noisy_sensor_with_a_period_keeps_the_order(period):
    """Also with that of a step: y holds over it in all three runs, with the same noise.

    What it samples errs by the straight lines of the sine, and so does what follows.
    """
    certificate = certify(f"""
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
    for signal in ("plant.y", "sensor.y", "lag.y"):
        assert certificate[signal].order == pytest.approx(2.0, abs=0.02), signal


REFUSED = [
    (ACTION.format('at = 1.0\nsignal = "gain.u"\nnoise = 0.1'), {}, "action at 1.0 s draws random"),
    (ACTION.format('at = 1.0\nsignal = "gain.u"\ndrop = 0.5'), {}, "action at 1.0 s draws random"),
    # the error of steps that a loop chooses is that of its tolerance
    (certified.SPRING, {"scenario.substeps.rtol": 1e-3}, "step error: loops choose their .*rtol"),
    (certified.SPRING, {"scenario.step": 2e-9, "scenario.stop": 1e-7}, "a quarter of .* 2e-09 s"),
]


def test_what_has_no_certificate_is_refused():
    """Before its run; and certify is true or false."""
    check_refused(REFUSED, lambda text, changes: certify(text, set=changes))
    with pytest.raises(UsageError, match=r"certify: .* 1$"):
        cosim.run("academic", certify=1)


def test_noise_of_every_step_is_refused_by_name():
    for options in ({"certify": True}, {"find_step": {"observer.x_a": 1.0}}):
        with pytest.raises(UsageError, match="step error: sensor draws random numbers") as caught:
            cosim.run("academic-noisy", **options)
        assert "set={'sensor.period': '" in str(caught.value)


def test_a_recorded_component_is_refused_by_its_log(tmp_path):
    """A recording has the rows of its own step alone."""
    scenario = write(tmp_path, certified.SPRING)
    path = tmp_path / "a.mcap"
    cosim.run(scenario, out=path)
    with pytest.raises(
        (UsageError, ScenarioError), match=r"(?s)must also run with 0.005 s.*a.mcap"
    ):
        certify(scenario, swap={"force": path})


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


@cache
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
    assert min(check_random_loop(0)) > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 8))
def test_every_output_of_a_random_loop_has_an_estimate_or_a_bound(seed):
    assert sum(check_random_loop(seed)) > 0
