"""The options of ``cosim check``: start values for the trials, and what is an error."""

import pytest

from tests.fmi.rogues import XML, compile_rogue

FAULT = "error: trial run, co-simulation: fmi2DoStep returned 3 (error)"


@pytest.mark.slow
def test_a_fault_behind_a_parameter(probe2, call):
    """With a start value of its own the trial comes to it; a wrong one is refused."""
    assert FAULT not in call("check", probe2)[1]
    code, out, _ = call("check", probe2, "--set", "answer=3")
    assert code == 1
    assert FAULT in out
    code, _, err = call("check", probe2, "--set", "answer=none")
    assert code == 2
    assert "start value of 'answer': expected a number, got 'none'" in err


@pytest.mark.slow
def test_strict_exits_with_1_for_a_warning(tmp_path, call):
    """Without it, only for an error."""
    good = compile_rogue(tmp_path / "good.fmu", "GOOD")
    assert call("check", good, "--strict")[0] == 0
    xml = XML.replace('<Unknown index="2" dependencies=""/>', "")
    unlisted = compile_rogue(tmp_path / "x.fmu", "GOOD", xml)
    assert call("check", unlisted)[0] == 0
    assert call("check", unlisted, "--strict")[0] == 1
