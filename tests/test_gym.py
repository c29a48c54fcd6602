"""Scenarios as environments of Gymnasium: its own check, seeds, episodes and their logs."""

import importlib
import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cosim
from cosim.core.contracts import Stopped
from cosim.errors import GraphError, UnknownSignalError, UsageError
from cosim.gym import Env
from cosim.report.verification import verify
from cosim.scenario.running.replay import replay
from cosim.scenario.session import Session

pytestmark = pytest.mark.usefixtures("without_verdicts")

ACT = {"plant.u": (-1.0, 1.0)}
OBSERVE = {"observer.x_a": (-10.0, 10.0), "plant.y": (-10.0, 10.0)}


def reward(rows):
    return -float(np.square(rows["plant.y"]).mean())


def environment(name="academic", *, act=ACT, observe=OBSERVE, reward=reward, **options):
    scenario = cosim.load(name).set({"scenario.stop": 0.2})
    return Env(scenario, act=act, observe=observe, reward=reward, **options)


@pytest.fixture
def env():
    with environment(steps=10) as made:
        yield made


def episode(env, seed=None):
    """Return observations, rewards and ends of an episode under random actions."""
    observation, info = env.reset(seed=seed)
    env.action_space.seed(5)
    rows = [observation]
    rewards = []
    ends = []
    while not (ends and any(ends[-1])):
        observation, value, terminated, truncated, info = env.step(env.action_space.sample())
        rows.append(observation)
        rewards.append(value)
        ends.append((terminated, truncated))
    return np.array(rows), rewards, ends, info


@pytest.mark.parametrize("name", ["academic", "academic-noisy"])
def test_an_environment_passes_the_check_of_gymnasium(name):
    """With components that have seeds, and without."""
    # steps of y are larger with noise: the filter of the observer amplifies it
    bounds = {"plant.y": (-1e3, 1e3)}
    with environment(name, observe=bounds, steps=10) as env:
        check_env(env, skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*Box (action|observation) space.*:UserWarning")
def test_signals_in_a_list_have_no_bounds():
    """It passes too, with warnings that there are none."""
    with environment(act=["plant.u"], observe=["plant.y"], steps=10) as env:
        check_env(env, skip_render_check=True)
        assert env.action_space.low.tolist() == [-np.inf]


def test_an_episode_is_a_session_with_overrides(env):
    """The same values, step by step; it is truncated at the stop of the scenario."""
    rows, rewards, ends, info = episode(env)
    assert rows.shape == (21, 3)
    assert ends == [(False, False)] * 19 + [(False, True)]
    assert info == {"t_ns": 200_000_000}
    env.action_space.seed(5)
    with cosim.load("academic").set({"scenario.stop": 0.2}).start() as sim:
        for k in range(20):
            sim["plant.u"] = env.action_space.sample()
            step = sim.step(10)
            assert rows[k + 1].tolist() == [*sim["observer.x_a"], *sim["plant.y"]]
            assert rewards[k] == reward(step)
    with pytest.raises(UsageError, match="the episode has ended"):
        env.step(np.zeros(1))


def test_a_seeded_reset_gives_the_same_episode_again():
    """Another seed, or none, gives other noise; the first actions of all are the same."""
    with environment("academic-noisy", observe=["observer.y"], steps=10) as env:
        first, *_ = episode(env, seed=1)
        unseeded, *_ = episode(env)
        other, *_ = episode(env, seed=2)
        again, *_ = episode(env, seed=1)
    assert again.tobytes() == first.tobytes()
    assert unseeded.tobytes() != first.tobytes()
    assert other.tobytes() != first.tobytes()


@pytest.mark.fast("academic")
@pytest.mark.parametrize("name", ["academic", "academic-noisy"])
def test_every_episode_has_a_log_of_its_own(name, tmp_path):
    """Its seeds are in it: a replay verifies it."""
    with environment(name, steps=10, out=tmp_path / "x.mcap") as env:
        for seed in (1, None):
            episode(env, seed=seed)
    logs = [cosim.open_log(tmp_path / file) for file in ("x.mcap", "x-2.mcap")]
    assert len(list(tmp_path.iterdir())) == 2
    for log in logs:
        assert log.steps == 200
        verification = verify(log, replay(log))
        assert verification.passed, verification.problems


def test_the_steps_of_an_action_may_be_a_number_of_numpy():
    """As those of a session."""
    with environment(steps=np.int64(100)) as env:
        env.reset()
        assert env.step(np.zeros(1))[-1] == {"t_ns": 100_000_000}


def test_an_episode_may_be_terminated_by_its_rows():
    """It is then not truncated."""
    with environment(steps=10, terminated=lambda rows: bool(rows.time_ns[-1] == 5e7)) as env:
        _, _, ends, _ = episode(env)
    assert ends == [(False, False)] * 4 + [(True, False)]


def test_a_component_that_asks_for_the_end_terminates_the_episode(env, monkeypatch):
    """The rows up to there count; a failure is raised."""
    env.reset()
    env.step(np.zeros(1))

    def ends(failed):
        def step(session, count):
            raise Stopped(np.empty((0, 1)), "enough", failed=failed)

        return step

    monkeypatch.setattr(Session, "step", ends(False))
    _, value, terminated, truncated, _ = env.step(np.zeros(1))
    assert (terminated, truncated) == (True, False)
    assert value < 0.0
    env.reset()
    monkeypatch.setattr(Session, "step", ends(True))
    with pytest.raises(Stopped, match="enough"):
        env.step(np.zeros(1))


def test_an_action_that_does_not_fit_is_refused(env):
    """It is not clipped."""
    with pytest.raises(UsageError, match=r"step: there is no episode yet; call reset\(\) first"):
        env.step(np.zeros(1))
    env.reset()
    with pytest.raises(UsageError, match=r"action: expected shape \(1,\) \(plant.u\), got \(2,\)"):
        env.step(np.zeros(2))
    with pytest.raises(UsageError, match=r"action\[0\]: expected -1.0 to 1.0, got 1.5"):
        env.step(np.array([1.5]))
    with pytest.raises(UsageError, match=r"action\[0\]: .*got nan"):
        env.step(np.array([np.nan]))
    with pytest.raises(UsageError, match=r"action: expected numbers, got an object of type dict"):
        env.step({"plant.u": 0.0})


@pytest.mark.parametrize("terminated", [None, lambda rows: True])
def test_an_episode_that_has_ended_takes_no_steps(terminated):
    """Terminated or truncated; the next one does."""
    with environment(steps=200, terminated=terminated) as env:
        for _ in range(2):
            env.reset()
            env.step(np.zeros(1))
            with pytest.raises(UsageError, match=r"step: the episode has ended; call reset\(\)"):
                env.step(np.zeros(1))


@pytest.mark.parametrize("name", ["academic", "academic-noisy"])
def test_a_closed_environment_has_no_further_episodes(name):
    """Whether a reset makes a session of its own or not."""
    env = environment(name, steps=10)
    env.reset()
    env.close()
    with pytest.raises(UsageError, match=r"reset: this environment is closed; make a new one"):
        env.reset()
    with pytest.raises(UsageError, match=r"closed"):
        env.step(np.zeros(1))


def test_options_that_do_not_fit_the_scenario_are_refused(subtests):
    for options, error, text in [
        ({"act": ["plant.w"]}, UnknownSignalError, "'plant' has no signal 'w'"),
        (
            {"act": ["plant.y"]},
            GraphError,
            "'plant.y': expected an input of 'plant', got an output",
        ),
        ({"observe": ["plant.w"]}, UnknownSignalError, "'plant' has no signal 'w'"),
        ({"act": []}, UsageError, r"act: expected a list of signal names, got \[\]"),
        ({"observe": "plant.y"}, UsageError, r"observe: expected a list .*, got 'plant.y'"),
        ({"act": {"plant.u": 3.0}}, UsageError, r"bounds of 'plant.u', got 3.0"),
        ({"act": {"plant.u": (1, 0)}}, UsageError, r"act: .*'plant.u', got 1.0 to 0.0"),
        ({"act": ["plant.u", "plant.u[0]"]}, UsageError, r"act: 'plant.u\[0\]' has elements"),
        ({"reward": 3}, UsageError, r"reward: expected a function, got 3"),
        ({"terminated": "x"}, UsageError, r"terminated: expected a function, got 'x'"),
        ({"steps": 7}, UsageError, r"steps: .*the 200 steps of the scenario, got 7"),
        ({"steps": 0}, UsageError, r"steps: expected a whole number .*, got 0"),
        ({"steps": 1.0}, UsageError, r"steps: expected a whole number .*, got 1.0"),
    ]:
        with subtests.test(options=options), pytest.raises(error, match=text):
            environment(**options)


def test_gymnasium_is_needed_for_this_module_only(monkeypatch):
    """Without it, the error says how to get it; the rest of cosim is there."""
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "cosim.gym")
    monkeypatch.delattr(cosim, "gym", raising=False)
    assert cosim.load
    with pytest.raises(ImportError, match=r"cosim\.gym needs gymnasium, .* pip install gymnasium"):
        importlib.import_module("cosim.gym")
