"""What the summary says of a run."""

import cosim
from cosim.report.summary import summarize

LOOP = """
[scenario]
name = "loop"
stop = 0.1
step = 0.01
[components]
a = { kind = "lag", time_constant = 0.3 }
b = { kind = "gain", K = 0.5 }
cascade = { kind = "delay", delay = 0.01 }
late = { kind = "gain", K = 0.5 }
[connections]
"a.u" = "b.y"
"b.u" = "a.y"
"cascade.u" = "late.y"
"late.u" = "cascade.y"
"""


def test_loops_of_first_order_are_in_the_summary(tmp_path):
    """The first extrapolates an input; the second needs none at the end of a step."""
    path = tmp_path / "loop.toml"
    path.write_text(LOOP, encoding="utf-8")
    (loop,) = summarize(cosim.run(path)).loops
    assert set(loop.split()) >= {"gauss-seidel", "a", "b"}
