"""README and its pages are true: their commands print what is shown, their Python runs."""

import json
import re
from pathlib import Path

import pytest

import cosim
from cosim.errors import LogError
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.recordings.recorded_scenario import check_rows
from tests import pages
from tests.log.recordings import layout, record

TEXTS = {name: path.read_text(encoding="utf-8") for name, path in pages.PATHS.items()}
README_BYTES = 12_000
PAGE_BYTES = 8_000


def python_block(page, text):
    """Return the one Python block of a page in which a text stands."""
    found = [block.text for block in pages.blocks(TEXTS[page]) if block.language == "python"]
    (block,) = [block for block in found if text in block]
    return block


@pytest.mark.fast("README")
@pytest.mark.parametrize("page", TEXTS)
def test_a_page_shows_what_its_commands_print(page, tmp_path, monkeypatch):
    """From top to bottom, in one fresh folder; the numbers of several lines are laws below.

    Each log that it leaves verifies, but for parts without the beginning of their run.
    """
    monkeypatch.chdir(tmp_path)
    wrong = [shown for shown, _ in pages.run_page(TEXTS[page]) if not shown.right]
    assert wrong == []
    for log in filter(is_replayed, sorted(tmp_path.rglob("*.mcap"))):
        code, printed = pages.run_command(f"cosim replay {log} --verify")
        assert code == 0, printed


def is_replayed(path):
    """Return whether a file is the log of a scenario, from the start of its run on."""
    if is_foreign(path):
        return False
    log = cosim.open_log(path)
    try:
        check_rows(log)
    except LogError:
        return False
    return "cosim.run" in log.metadata


def test_pages_are_short():
    sizes = {name: len(text.encode()) for name, text in TEXTS.items()}
    limits = {name: README_BYTES if name == "README" else PAGE_BYTES for name in sizes}
    assert {name: size for name, size in sizes.items() if size > limits[name]} == {}


def test_links_lead_somewhere():
    """To a file beside the page, or to a heading of that file."""
    broken = []
    for name, text in TEXTS.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            file, _, heading = target.partition("#")
            if target.startswith("https://"):
                continue
            path = pages.PATHS[name].parent / file if file else pages.PATHS[name]
            if not path.is_file() or (heading and heading not in headings(path)):
                broken.append(f"{name}: {target}")
    assert broken == []


def headings(path):
    """Return the anchors that a renderer makes of the headings of a page."""
    lines = path.read_text(encoding="utf-8").splitlines()
    titles = [line.lstrip("#").strip().lower() for line in lines if line.startswith("#")]
    return {re.sub(r"[^\w -]", "", title).replace(" ", "-") for title in titles}


def test_readme_links_every_page():
    for name in TEXTS:
        assert name == "README" or f"(.readme/{name}.md" in TEXTS["README"]


def test_two_fmus_take_15_lines_and_four_commands():
    """Coupled, swapped, replayed, compared; blank lines apart."""
    (scenario,) = [block for block in pages.blocks(TEXTS["README"]) if block.file == "drive.toml"]
    assert len([line for line in scenario.text.splitlines() if line.strip()]) <= 15
    for command in (
        "cosim run drive.toml",
        "cosim run drive.toml --swap",
        "cosim replay logs/heavy.mcap",
        "cosim diff",
    ):
        assert f"$ {command}" in TEXTS["README"]


def test_the_set_up_commands_stand_on_lines_of_their_own():
    """Two lines to paste."""
    lines = [line.strip() for line in TEXTS["README"].splitlines()]
    lines = [line for line in lines if line.startswith("python3 -m venv")]
    assert len(lines) == 2
    assert lines[0].endswith(".venv/bin/cosim run pair")
    assert lines[1].endswith(".venv/bin/python -m pytest -n auto")


def test_a_component_of_ones_own_is_short():
    """Ten lines for one of a scenario, import and comment apart; less than 25 with a state."""
    drag = python_block("component", "class Drag")
    relay = python_block("component", "class Relay")
    lines = [line for line in drag.splitlines() if line.strip() and '"""' not in line]
    assert len([line for line in lines if not line.startswith("from")]) == 10
    shown = relay.split("class Relay", 1)[1].split("components =")[0]
    assert len([line for line in shown.splitlines() if line.strip()]) < 25


def test_the_thermostat_switches_one_step_late():
    """At 19.5 and 20.5 degrees; a step of 0.1 s later, where the slope is at most 0.1 / s."""
    printed, _ = pages.run_python(python_block("component", "class Relay"))
    lowest, highest = map(float, printed.split())
    assert 19.48 <= lowest <= 19.5
    assert 20.5 <= highest <= 20.52


def test_members_have_the_rms_of_a_lag_behind_a_sine():
    """1/sqrt(2 (1 + (rate T)^2)), but for the transient."""
    printed, _ = pages.run_python(python_block("sessions", "run_members"))
    for value, T in zip(printed.strip("[]\n").split(), (0.1, 0.5, 2.5), strict=True):
        assert float(value) == pytest.approx((2.0 * (1.0 + (2.0 * T) ** 2)) ** -0.5, rel=0.05)


@pytest.mark.slow
def test_the_content_hash_is_what_the_page_computes(tmp_path, monkeypatch):
    """Also of NaNs of all bits, in more elements than a topic holds."""
    monkeypatch.chdir(tmp_path)
    cosim.run("pair", out="logs/academic.mcap")
    _, names = pages.run_python(python_block("logs", "def content_hash"))
    assert (
        names["content_hash"]("logs/academic.mcap")
        == cosim.open_log("logs/academic.mcap").recorded_hash
    )
    record(tmp_path / "wide.mcap", steps=20, lay=layout(wide=5000), compression="lz4")
    wide = cosim.open_log("wide.mcap")
    assert names["content_hash"]("wide.mcap") == wide.content_hash() == wide.recorded_hash


@pytest.mark.slow
def test_identification_of_the_page_finds_theta(tmp_path, monkeypatch):
    """From its log, within the intervals."""
    monkeypatch.chdir(tmp_path)
    (first, *_) = [
        block for block in pages.blocks(TEXTS["identification"]) if block.language == "console"
    ]
    command, _ = next(pages.commands(first))
    pages.run_command(command)
    _, names = pages.run_python(python_block("identification", "cosim.identify"))
    for true, parameter in zip((-0.1, -0.3), names["found"].assessment.parameters, strict=True):
        assert parameter.lower <= true <= parameter.upper
        assert parameter.verdict == "IDENTIFIABLE"
    smoothed = names["smoothed"]
    assert abs(smoothed.disturbance[0] - (1.35 + 1.3)) <= 1.5 * smoothed.disturbance_half_width[0]


@pytest.mark.slow
def test_the_page_on_field_data_finds_the_rate_of_its_disturbance(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in pages.blocks(TEXTS["field-data"]):
        if block.file is not None:
            Path(block.file).write_text(block.text, encoding="utf-8")
    pages.run_command("python measure.py")
    code, printed = pages.run_command("cosim run field.toml --json")
    assert code == 0
    (parameter,) = json.loads(printed)["identifications"][0]["parameters"]
    assert parameter["verdict"] == "IDENTIFIABLE"
    assert abs(parameter["value"] + 0.4) <= 1.5 * parameter["half_width"]
