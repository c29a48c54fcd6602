"""``cosim diff`` with tolerances of signals, and its picture."""

import json
import re

import numpy as np
import pytest

from tests.log.recordings import layout, record, table


@pytest.fixture
def pair(tmp_path):
    """Write two logs whose plant.u and plant.x_a are apart by 1 and 1e-3."""
    rows = np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)
    record(tmp_path / "a.mcap", rows=rows)
    rows[50, 0] += 1.0
    rows[60, 2] += 1e-3
    record(tmp_path / "b.mcap", rows=rows)


@pytest.mark.usefixtures("pair")
def test_a_tolerance_of_a_signal_decides_the_exit_code(call):
    """The table shows the tolerances then."""
    names = ("diff", "a.mcap", "b.mcap")
    assert call(*names, "--atol", "0.1")[0] == 1
    code, out, err = call(*names, "--atol", "0.01", "--tol", "plant.u=1.5")
    assert (code, err) == (0, "")
    lines = [line.split("\t") for line in out.splitlines()]
    assert lines[0][:3] == ["signal", "", "tolerance"]
    assert lines[1][:4] == ["plant.u", "within", "1.5", "1"]
    assert call(*names, "--tol", "*=1e-2", "--tol", "plant.u=1.5")[0] == 0
    shown = json.loads(call(*names, "--tol", "plant.*=1.5", "--json")[1])
    assert shown["tol"] == {"plant.*": 1.5}
    assert shown["within"]


@pytest.mark.slow
@pytest.mark.usefixtures("pair")
def test_the_worst_signal_is_drawn(call, tmp_path):
    """Its picture is named on stdout; the exit code is that of the comparison."""
    code, out, err = call("diff", "a.mcap", "b.mcap", "--plot", "d.png")
    assert (code, err) == (1, "")
    assert out.splitlines()[-1] == "d.png"
    assert (tmp_path / "d.png").stat().st_size > 1000
    code, out, err = call("diff", "a.mcap", "b.mcap", "plant.u", "--json", "--plot", "e.png")
    assert json.loads(out)["signals"][0]["signal"] == "plant.u"
    assert (tmp_path / "e.png").is_file()


@pytest.mark.usefixtures("pair")
def test_equal_logs_have_no_picture(call, tmp_path):
    """Which is said."""
    code, _, err = call("diff", "a.mcap", "a.mcap", "--plot", "d.png")
    assert (code, err) == (0, "d.png: not drawn, as the largest difference of two values is 0\n")
    assert not (tmp_path / "d.png").exists()


@pytest.mark.usefixtures("pair")
def test_wrong_tolerances_exit_with_2(call):
    """Each by the option as it was given."""
    for options, text in [
        (("--tol", "plant.u"), r"--tol 'plant\.u': .*no '='"),
        (("--tol", "plant.u=a"), r"--tol plant\.u: .*'a'"),
        (("--tol", "plant.u=-1"), r"--tol plant\.u: .*-1\.0"),
        (("--tol", "plant.w=1"), r"--tol plant\.w: .*Available: plant\.u, plant\.x_a"),
        (("--tol", "plant.u=1", "--tol", "plant.u=2"), r"--tol plant\.u: .*given 2 times"),
        (("--plot", "d.doc"), r"'\.doc'"),
    ]:
        code, out, err = call("diff", "a.mcap", "b.mcap", *options)
        assert (code, out) == (2, ""), options
        assert re.search(text, err)
