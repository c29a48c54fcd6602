"""The certificate of a run as it is shown."""

import json
import re

import pytest

from cosim.report.certificate import CouplingShare
from tests.scenario import certified
from tests.scenario.certified import write


def test_table_and_log_have_estimates_and_reasons(tmp_path, call):
    """cos 2t at 4 s is -0.1455; of the error of first order there, nearly all is the coupling."""
    jump = '    jump = { kind = "python", class = "parts:Jump", time = 1.003 }\n'
    lag = '    late = { kind = "lag", time_constant = 1.0 }\n'
    text = certified.SPRING.replace("[components]\n", f"[components]\n{jump}{lag}", 1)
    text = text.replace('"mass.u" = "speed.y"', '"mass.u" = "speed.y"\n    "late.u" = "jump.y"')
    text += '\n    [truth]\n    "mass.y" = -0.1455\n'
    code, output, _ = call("run", write(tmp_path, text), "--certify", "--out", "a.mcap")
    assert code == 0
    for pattern in (
        r"mass\.y\t0\.0337\t3\.3 s\t\S+\t1\.02",
        r"jump\.y\t0\t\S+ s\t\+0\t\tidentical in all three runs",
        r"late\.y\t\t\t\t\tno estimate: jump\.y jumps between .*quarter.* t = 1\.005 s.*",
        r"mass\.y\terror \S+ at the end, of which \S+ \([89]\d %\) is coupling error",
    ):
        assert re.search(f"^{pattern}$", output, re.M), pattern
    content = json.loads(call("info", "a.mcap", "--json")[1])
    signals = {row["signal"]: row for row in content["error of the step"]}
    assert signals["mass.y"]["largest"] == 0.0337
    assert signals["late.y"]["largest"] is None


@pytest.mark.parametrize(
    ("error", "coupling", "text"),
    [
        (-2e-3, -2e-3, "error -0.002 at the end, of which -0.002 (100 %) is coupling error"),
        (1e-2, 1.234e-3, "error +0.01 at the end, of which +0.00123 (12 %) is coupling error"),
        (1e-2, None, "error +0.01 at the end; the share of the coupling is not known"),
        (0.0, 0.0, "no error at the end"),
    ],
)
def test_the_share_of_the_coupling_has_two_digits(error, coupling, text):
    """Never as a power of ten."""
    assert str(CouplingShare("identifier.theta[0]", error, coupling)) == text
