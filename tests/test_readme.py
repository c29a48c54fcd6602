"""README and its pages are true: their commands run and print what is shown, their Python runs."""

import contextlib
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cosim
from cosim.cli import main
from cosim.report.tables import console
from tests.log.recordings import layout, record

ROOT = Path(__file__).parent.parent
PAGES = {
    "README": (ROOT / "README.md").read_text(encoding="utf-8"),
    "coupling": (ROOT / ".readme" / "coupling.md").read_text(encoding="utf-8"),
    "fmus": (ROOT / ".readme" / "fmus.md").read_text(encoding="utf-8"),
    "identification": (ROOT / ".readme" / "identification.md").read_text(encoding="utf-8"),
    "logs": (ROOT / ".readme" / "logs.md").read_text(encoding="utf-8"),
    "plants": (ROOT / ".readme" / "plants.md").read_text(encoding="utf-8"),
    "recordings": (ROOT / ".readme" / "recordings.md").read_text(encoding="utf-8"),
    "studies": (ROOT / ".readme" / "studies.md").read_text(encoding="utf-8"),
}
EXIT_CODES = {
    "--atol": 1,
    "disturbance.tim=1.0": 2,
    "drag.d=1": 2,
    "scenario.step=0.1": 2,
    "scenario.coupling=jacobi": 2,
}  # of commands with this word; 0 of all others


def blocks(page, language):
    """Return the fenced blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], flags=re.DOTALL)


def commands(page):
    """Yield every command of the console blocks with the output shown below it."""
    for block in blocks(page, "console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, output


def run_command(command, capsys):
    """Run a command as a shell would; return its exit code and what it prints."""
    line, redirected = re.fullmatch(r"(.*?)(?: > ([\w./-]+))?", command).groups()
    words = shlex.split(line)
    assert words[0] == "cosim"
    with pytest.raises(SystemExit) as left:
        main(words[1:])
    output = capsys.readouterr()
    if redirected:
        Path(redirected).write_text(output.out)
    return left.value.code or 0, output.out + output.err


def expected_code(command):
    """Return the exit code that a command should have."""
    if command.startswith("cosim replay field.mcap --map"):
        return 2
    return next((code for word, code in EXIT_CODES.items() if word in command.split()), 0)


def comparable(text):
    """Return the lines without what differs between machines: wall time, trailing blanks."""
    lines = [line.rstrip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("wall time")]


def write_scenario(folder):
    """Save the scenarios and the module that the pages show, as they tell their reader to."""
    shown_in = {"pair": "README", "faults": "README", "fall": "README", "drive": "plants"}
    shown_in |= {"loop": "coupling", "tank": "recordings", "tolerances": "studies"}
    for name, page in shown_in.items():
        shown = [block for block in blocks(page, "toml") if f'name = "{name}"' in block]
        (folder / f"{name}.toml").write_text(shown[0], encoding="utf-8")
    (drag,) = [block for block in blocks("README", "python") if "class Drag" in block]
    (folder / "drag.py").write_text(drag, encoding="utf-8")
    (recording,) = blocks("recordings", "python")
    with contextlib.chdir(folder):
        exec(compile(recording, "recording", "exec"), {"__name__": "readme"})


@pytest.mark.parametrize("page", PAGES)
def test_commands_print_what_is_shown(page, tmp_path, monkeypatch, capsys):
    """Every shown command runs, in order, in one fresh folder; shown output is the real one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console, "terminal_width", lambda: 116)
    write_scenario(tmp_path)
    for command, shown in commands(page):
        code, output = run_command(command, capsys)
        assert code == expected_code(command), (command, output)
        if shown:
            assert comparable(output) == comparable(shown), command


def test_readme_shows_the_tasks():
    """Run, plot, replay, diff, export, swap and compare stand in it."""
    shown = {shlex.split(command)[1] for command, _ in commands("README")}
    assert {"run", "plot", "replay", "diff", "export", "compare"} <= shown


def test_the_pair_takes_15_lines():
    """Two FMUs are connected in 15 lines of TOML, blank lines apart."""
    shown = [block for block in blocks("README", "toml") if 'name = "pair"' in block]
    assert len([line for line in shown[0].splitlines() if line.strip()]) <= 15


def test_a_run_with_faults_takes_15_lines():
    """A sensor fault, a parameter step, an override released and a stop condition."""
    shown = [block for block in blocks("README", "toml") if 'name = "faults"' in block]
    assert len([line for line in shown[0].splitlines() if line.strip()]) <= 15


def test_a_derived_signal_stands_for_its_expression(tmp_path):
    """In the condition of the scenario with faults, which ends at the same row then."""
    write_scenario(tmp_path)
    path = tmp_path / "faults.toml"
    (line,) = [block for block in blocks("README", "toml") if block.startswith("error = ")]
    path.write_text(path.read_text().replace("[components]\n", f"[components]\n{line}"))
    until = "error.y < 1e-3 for 15 s"
    run = cosim.run(path, set={"scenario.until": until})
    assert run.reason == f"until {until!r}: came true at t = 45.15 s"
    np.testing.assert_array_equal(run["error.y"], np.abs(run["setpoint.y"] - run["plant.y"]))


def block_with(text):
    """Return the one Python block of the README in which a text stands."""
    (found,) = [block for block in blocks("README", "python") if text in block]
    return found


def test_python_runs(tmp_path, monkeypatch, capsys):
    """Every Python block runs as it stands, after the commands above the first."""
    monkeypatch.chdir(tmp_path)
    write_scenario(tmp_path)
    exports = [command for command, _ in commands("README") if "closed-loop" in command]
    for command in exports:
        run_command(command, capsys)
    first, *_ = blocks("README", "python")
    relay = block_with("class Relay")
    for _ in range(2):  # as one does who reads and tries
        exec(compile(first, "README block 1", "exec"), {"__name__": "readme"})
        printed = capsys.readouterr().out.split()
        assert printed[0] == "10.0"
        assert 0.0 < float(printed[-1]) < 1e-2  # half the step, half the error of first order
    exec(compile(relay, "README relay", "exec"), {"__name__": "readme"})
    lowest, highest = map(float, capsys.readouterr().out.split())
    # The relay switches one step of 0.1 s late, where the slope is at most 0.1 / s.
    assert 19.48 <= lowest <= 19.5
    assert 20.5 <= highest <= 20.52


def test_a_session_prints_what_is_shown(tmp_path, monkeypatch, capsys):
    """Its log is verified by a replay."""
    monkeypatch.chdir(tmp_path)
    session = block_with(".start(")
    shown = blocks("README", "text")[0]
    exec(compile(session, "README session", "exec"), {"__name__": "readme"})
    assert capsys.readouterr().out == shown
    code, _ = run_command("cosim replay logs/session.mcap --verify", capsys)
    assert code == 0


def test_members_print_what_is_shown(capsys):
    """The rms of a lag behind a sine: 1/sqrt(2 (1 + (rate T)^2)), but for the transient."""
    exec(compile(block_with("run_members"), "README members", "exec"), {"__name__": "readme"})
    printed = capsys.readouterr().out
    assert printed == blocks("README", "text")[-1]
    for value, T in zip(printed.strip("[]\n").split(), (0.1, 0.5, 2.5), strict=True):
        assert float(value) == pytest.approx((2.0 * (1.0 + (2.0 * T) ** 2)) ** -0.5, rel=0.05)


def test_an_environment_takes_15_lines(tmp_path, monkeypatch):
    """Its episode ends at the stop of the scenario; imports apart."""
    monkeypatch.chdir(tmp_path)
    shown = block_with("cosim.gym")
    names = {}
    exec(compile(shown, "README environment", "exec"), names)
    assert names["info"] == {"t_ns": 10**9}
    assert names["truncated"]
    lines = [line for line in shown.splitlines() if line and not line.startswith("import")]
    assert len(lines) <= 15


def test_the_content_hash_is_what_the_page_computes(tmp_path, monkeypatch, capsys):
    """Of the shipped example, and of NaNs of all bits in more elements than a topic holds."""
    monkeypatch.chdir(tmp_path)
    run_command("cosim run academic --stop 8 --out logs/academic.mcap --quiet", capsys)
    (block,) = blocks("logs", "python")
    names = {}
    exec(compile(block, "logs block", "exec"), names)
    assert capsys.readouterr().out.strip() == cosim.open_log("logs/academic.mcap").recorded_hash
    record(tmp_path / "wide.mcap", steps=20, lay=layout(wide=5000), compression="lz4")
    wide = cosim.open_log("wide.mcap")
    assert names["content_hash"]("wide.mcap") == wide.content_hash() == wide.recorded_hash


def test_the_python_of_an_identification_runs(tmp_path, monkeypatch, capsys):
    """After the command that makes its log: theta and delta(0) are within their intervals."""
    monkeypatch.chdir(tmp_path)
    run_command(next(command for command, _ in commands("identification")), capsys)
    (block,) = blocks("identification", "python")
    exec(compile(block, "identification block", "exec"), {"__name__": "readme"})
    *parameters, smoothed = [line.split() for line in capsys.readouterr().out.splitlines()]
    for true, (_, _, lower, upper, verdict) in zip((-0.1, -0.3), parameters, strict=True):
        assert float(lower) <= true <= float(upper)
        assert verdict == "IDENTIFIABLE"
    delta, half_width = map(float, smoothed)
    assert abs(delta - (1.35 + 1.3)) <= 1.5 * half_width


def test_the_scenario_of_recorded_data_finds_theta(tmp_path, monkeypatch, capsys):
    """With samples of the plant that it is about, by a solver of its own, at uneven times."""

    def rate(t, x):
        forced = 2.0 * math.exp(-0.4 * t)
        return [-0.5 * x[0] + 0.25 * x[1] + forced, 0.4 * x[0] - x[1] + float(t >= 2.0)]

    rng = np.random.default_rng(1)
    times = 0.02 * np.arange(501) + rng.uniform(-0.004, 0.004, 501)
    times[0] = 0.0
    options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
    before = times < 2.0
    first = solve_ivp(rate, (0.0, 2.0 - 1e-9), [1.0, 0.5], t_eval=times[before], **options)
    start = solve_ivp(rate, (0.0, 2.0 - 1e-9), [1.0, 0.5], **options).y[:, -1]
    later = times[~before]
    second = solve_ivp(rate, (2.0, times[-1]), start, t_eval=later, **options)
    level = np.append(first.y[0], second.y[0]) + 1e-3 * rng.standard_normal(501)
    lines = [f"{1e3 * t:.6f};{y:.9f}" for t, y in zip(times, level, strict=True)]
    text = "\n".join(["time [ms];level", *lines])
    (tmp_path / "field.csv").write_text(text + "\n", encoding="utf-8")
    (scenario,) = blocks("identification", "toml")
    (tmp_path / "field.toml").write_text(scenario, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    code, output = run_command("cosim run field.toml --json", capsys)
    assert code == 0
    (parameter,) = json.loads(output)["identifications"][0]["parameters"]
    assert parameter["verdict"] == "IDENTIFIABLE"
    assert abs(parameter["value"] + 0.4) <= 1.5 * parameter["half_width"]


def test_a_component_of_ones_own_is_short():
    """Ten lines for one of a scenario, import and comment apart; less than 25 with a state."""
    drag = block_with("class Drag")
    relay = block_with("class Relay")
    lines = [line for line in drag.splitlines() if line.strip() and '"""' not in line]
    assert len([line for line in lines if not line.startswith("from")]) == 10
    shown = relay.split("class Relay", 1)[1].split("components =")[0]
    assert len([line for line in shown.splitlines() if line.strip()]) < 25


def test_the_set_up_commands_stand_on_lines_of_their_own():
    """Two lines to paste."""
    lines = [line.strip() for line in PAGES["README"].splitlines()]
    lines = [line for line in lines if line.startswith("python3 -m venv")]
    assert len(lines) == 2
    assert lines[0].endswith(".venv/bin/cosim run academic")
    assert lines[1].endswith(".venv/bin/python -m pytest -n auto")


def test_a_study_runs_from_python(tmp_path, monkeypatch, capsys):
    """Its table has a row for each member."""
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("studies", "python")[0], "studies block", "exec"), {"__name__": "readme"})
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed[-3:]] == ["0", "1", "2"]


def test_a_tuning_prints_what_is_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (block,) = [block for block in blocks("studies", "python") if "cosim.tune" in block]
    exec(compile(block, "tuning block", "exec"), {"__name__": "readme"})
    assert capsys.readouterr().out == blocks("studies", "text")[0]
