"""What the summary says of a run, and what is said where a log's records are damaged."""

import json
import re
from html import unescape

import pytest

import cosim
from cosim.core.gain.loop_gain import LoopGain
from cosim.documents import plain
from cosim.errors import LogError
from cosim.report.tables.run import print_summary
from tests.report.forging import forged

WINDOW = {"half_width_steps": 1, "order": 2, "noise": [], "amplitude": 1.0, "bandwidth": 1.0}
STEPS = {"step": 0.1, "finer_steps": [0.05]}
LATE = {"factor": 1.0, "blocks": 1, "late": 0, "largest": 0.0, "time": 0.0}
FINE = {"identifier": {"parameters": [{"name": "theta", "verdict": "FINE"}]}}
DEEP = '{"x":' * 500 + "1" + "}" * 500


def gains(**changes):
    """Return the gain of a loop, with changes, as a log has it."""
    gain = LoopGain(("a",), "jacobi", h=0.1, steps=1)
    return json.dumps([{**plain(gain), **changes}])


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a short run."""
    path = tmp_path_factory.mktemp("valid") / "a.mcap"
    return cosim.run("academic-as-printed", out=path, set={"scenario.stop": 0.1})


def lines_of_page(page):
    """Return caption, header and rows of every table of a page as a pipe has them."""
    lines = []
    for caption, table in re.findall("<caption>(.*?)</caption>(.*?)</table>", page):
        rows = [
            re.findall("<t[hd]>(.*?)</t[hd]>", row) for row in re.findall("<tr>(.*?)</tr>", table)
        ]
        lines += [caption, *("\t".join(row).rstrip("\t") for row in rows)]
    return [unescape(line) for line in lines if line]


@pytest.mark.parametrize(
    ("scenario", "step", "named"),
    [
        ("academic-as-printed", 1e-3, {"observer.delta", "identifier.theta[0]"}),
        ("pair", 0.01, {"motor.y", "signal"}),
        pytest.param(
            *("compensation", 0.02, {"observer.x_a", "identifier.theta", "phase[0]"}),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_notebook_shows_what_the_table_after_a_run_shows(capsys, scenario, step, named):
    """Behind the signals every number and line, with a certificate too, but for the wall time."""
    changes = {"scenario.step": step, "scenario.stop": 60 * step}
    run = cosim.run(scenario, set=changes, certify=scenario == "pair")
    print_summary(run, wall={"run": 1.0}, as_json=False, quiet=False)
    printed = capsys.readouterr().out.splitlines()
    shown = lines_of_page(run._repr_html_())[2 + len(run) :]
    assert shown == [line for line in printed if not line.startswith("wall time\t")]
    assert shown[0].startswith(f"{scenario}: ")
    assert named <= {line.partition("\t")[0] for line in shown}


@pytest.mark.parametrize(
    ("record", "key", "value", "named"),
    [
        ("cosim.run", "start_time", "NaN", ["start_time", "got nan"]),
        ("cosim.run", "first_order_loops", "[", ["first_order_loops", "JSON"]),
        ("cosim.run", "first_order_loops", "3", ["first_order_loops", "got 3"]),
        ("cosim.run", "loop_gains", gains(newer=1), ["loop_gains", "0.newer", "'newer'"]),
        ("cosim.run", "loop_gains", gains(rho=-1.0), ["loop_gains", "-1.0"]),
        ("cosim.run", "loop_gains", gains(steps=10**400), ["0.steps"]),
        ("cosim.run", "replay", '{"log": "a"}', ["replay", "content_hash", "got none"]),
        ("cosim.run", "truth", '{"plant.y": [1, 2]}', ["truth", "plant.y", "1 values", "[1"]),
        ("cosim.run", "truth", '{"plant.z": 1}', ["truth", "plant.z"]),
        ("identifier", "start_time", ..., ["'identifier'", "start_time and P0"]),
        ("identifier", "T_f", ..., ["'identifier'", "T_obs, T_f, D_max, T_id, or none"]),
        ("identifier", "P0", -1.0, ["'identifier'", "P0", "greater than 0", "got -1.0"]),
        ("identifier", "notes", [1], ["'identifier'", "notes.0", "got 1"]),
        ("identifier", "newer", json.loads(DEEP), ["'identifier'", "recursion"]),
        ("observer", "choice", {"request": {}, "result": WINDOW}, ["choice.result.", "got none"]),
        ("observer", "reconstruction", {"newer": 1}, ["reconstruction.", "expected"]),
        ("observer", "noise_gain", [1.0, 2.0], ["metadata of 'observer'", "noise gains", "got 2"]),
        ("observer", "noise_gain", [True], ["noise_gain.0", "got True"]),
        ("results", "real_time", {**LATE, "factor": 10**400}, ["real_time", "factor", "finite"]),
        ("results", "until", "yes", ["until", "got 'yes'"]),
        ("results", "substeps", None, ["substeps", "got None"]),
        ("results", "substeps", [{"components": []}], ["substeps", "got none"]),
        ("results", "identification", None, ["identification", "got None"]),
        ("results", "substeps", json.loads(DEEP), ["substeps", "recursion"]),
        ("results", "certificate", {"step": 0.1}, ["certificate", "finer_steps", "got none"]),
        ("results", "certificate", {**STEPS, "signals": {"a.y": 3}}, ["signals.a.y", "got 3"]),
        ("results", "identification", {"identifier": {"noise_model": 3}}, ["noise_model", "got 3"]),
        ("results", "identification", FINE, [".parameters.0.verdict", "'IDENT", "got 'FINE'"]),
    ],
)
def test_a_damaged_record_is_one_error_and_all_else_is_read(
    valid, call, tmp_path, record, key, value, named
):
    """The error names the log, the record and the key, what is expected there and what is there."""

    def change(found):
        found.pop(key) if value is ... else found.update({key: value})

    def change_text(text):
        found = json.loads(text)
        change(found)
        return json.dumps(found)

    said = {f"cosim.component.{record}": {"metadata": change_text}}
    if record == "cosim.run":
        said = {record: {key: value}}
    results = change if record == "results" else None
    damaged = forged(valid.path, tmp_path / "a.mcap", metadata=said, results=results)
    log = cosim.open_log(damaged)
    with pytest.raises(LogError, match=r"expected|available") as error:
        cosim.certificate(log) if key == "certificate" else log.summary()
    message = str(error.value)
    assert message in unescape(log._repr_html_())
    for text in (str(damaged), *named):
        assert text in message
    assert cosim.diff(log, valid).equal
    code, output, err = call("info", damaged, "--json")
    problems = json.loads(output).get("problems", [])
    assert (code, problems, message in err) in ((2, [message], True), (0, [], False))


def test_a_record_of_a_newer_version_says_so(valid, tmp_path):
    said = {"cosim.env": {"cosim": "99.1"}, "cosim.run": {"loop_gains": gains(newer=1)}}
    damaged = forged(valid.path, tmp_path / "a.mcap", metadata=said)
    with pytest.raises(LogError, match=r"a\.mcap \(written by cosim 99\.1\): loop_gains .*newer"):
        cosim.open_log(damaged).summary()
