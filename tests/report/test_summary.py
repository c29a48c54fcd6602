"""What the summary says of a run."""

import json

import pytest

import cosim
from cosim.errors import LogError
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


@pytest.mark.parametrize(
    ("missing", "needed"), [("T_f", "T_obs, T_f, D_max, T_id, or none"), ("P0", "start_time and")]
)
def test_metadata_of_an_identifier_is_complete_or_refused(missing, needed):
    """The table after a run shows all of its times in one sum."""
    run = cosim.run("academic-as-printed", set={"scenario.stop": 0.1})
    assert summarize(run).identifications[0].times.keys() == {"T_obs", "T_f", "D_max", "T_id"}
    record = run.metadata["cosim.component.identifier"]
    metadata = json.loads(record["metadata"])
    del metadata[missing]
    record["metadata"] = json.dumps(metadata)
    with pytest.raises(LogError, match=f"metadata of 'identifier': .*{needed}"):
        summarize(run)
