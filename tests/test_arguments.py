"""The arguments of public functions."""

from functools import partial

import pytest

import cosim
from cosim.errors import UsageError


def test_a_profile_is_filled_and_so_has_to_be_a_dict(tmp_path):
    """Of a run and of a replay."""
    log = cosim.run("closed-loop", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    for again in (cosim.run, cosim.replay):
        with pytest.raises(UsageError, match=r"profile: expected a dict .*\[\]"):
            again(log.path if again is cosim.replay else "closed-loop", profile=[])


def test_settings_are_arguments_of_a_run_and_of_its_replay(tmp_path):
    """The same run, to the bit, as with ``set``; a fraction too."""
    out = tmp_path / "a.mcap"
    log = cosim.run("academic", stop=0.1, step=2e-3, verdicts=False, out=out)
    same = {"scenario.stop": 0.1, "scenario.step": 2e-3, "scenario.verdicts": False}
    assert (log.steps, log.step_ns) == (50, 2_000_000)
    assert (
        log.content_hash()
        == cosim.run("academic", set=same, out=tmp_path / "b.mcap").content_hash()
    )
    again = cosim.replay(log, stop=0.05, verdicts=True, set={"observer.filter_rate": 500.0})
    assert again.steps == 25
    assert cosim.run("academic", stop=0.1, step="1/500").step_ns == 2_000_000


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("run", {"stop": -1.0, "step": "x", "verdicts": 3}),
        ("replay", {"stop": -1.0, "verdicts": 3}),
        ("study", {"stop": -1.0}),
        ("tune", {"stop": -1.0}),
    ],
)
def test_a_wrong_setting_is_named_by_its_argument(name, values, tmp_path):
    """And refused beside the same one in ``set``, which keeps its own name when it is alone."""
    options = {
        "tune": {
            "minimize": "last(plant.y)",
            "vary": {"observer.filter_rate": {"log": [10.0, 1e3]}},
        }
    }
    function = partial(getattr(cosim, name), **options.get(name, {}))
    subject = "academic"
    if name == "replay":
        subject = cosim.run("academic", stop=0.1, out=tmp_path / "a.mcap")
    for argument, value in values.items():
        key = f"scenario.{argument}"
        with pytest.raises(UsageError, match=rf"(^|\n| ){argument}: .*{value}"):
            function(subject, **{argument: value})
        with pytest.raises(UsageError, match=rf"set\['{key}'\]: .*{value}"):
            function(subject, set={key: value})
        with pytest.raises(UsageError, match=rf"^{argument} and set\['{key}'\]"):
            function(subject, **{argument: value}, set={key: value})


def test_a_true_setting_is_named_with_its_value():
    """``verdicts=False`` is what was written."""
    with pytest.raises(UsageError, match=r"^verdicts=False and set\['scenario.verdicts'\]"):
        cosim.run("academic", verdicts=False, set={"scenario.verdicts": False})
