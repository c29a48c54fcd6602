"""Swapped components with other port names: each form of a map, and every wrong one."""

import json
import re
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.summary import summarize
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import find
from cosim.scenario.recordings.recording import build_experiment
from cosim.scenario.recordings.swap_comparison import compare_swaps
from tests.scenario.refusals import check_refused
from tests.scenario.signals import COARSE
from tests.scenario.swapping.renamed import MAP, PACKED

pytestmark = pytest.mark.usefixtures("without_verdicts")

SHORT = {**COARSE, "scenario.stop": 0.1}
BY_HAND = (
    (
        r'kind = "descriptor"\nmodel = "academic"\nx_a0 = \[1.0, -1.0\]\n',
        'kind = "fmu"\npath = "PATH"\n',
    ),
    (r'"plant.u" = ', '"plant.force" = '),
    (r'"plant.delta" = ', '"plant.push" = '),
    (r'"observer.y" = "plant.y"', '"observer.y" = "plant.out1"'),
    (r'"observer.x_a" = "plant.x_a"', '"observer.x_a" = "plant.s"'),
)
SHOWN = {"plant.u": "force", "plant.delta": "push", "plant.y": "out1", "plant.x_a": "s"}


@pytest.fixture(scope="module")
def other(folder):
    return folder / "other.fmu"


@pytest.fixture(scope="module")
def by_hand(other):
    """Run the scenario that was edited by hand."""
    text = find("academic").text
    for before, after in BY_HAND:
        text, count = re.subn(before, after.replace("PATH", str(other)), text)
        assert count == 1
    return cosim.run(parse(replace(find("academic"), text=text).with_changes(COARSE)))


def test_a_table_of_two_units_takes_the_place_of_a_vector(tmp_path):
    """A plant gives position and speed in m and m/s; the table has them in mm and mm/s."""
    text = """
        scenario = { name = "a", stop = 0.2, step = 0.01 }
        [models.mass]
        A = [[0, 1], [-4, -2]]
        Bu = [[0], [1]]
        C = [[1, 0], [0, 1]]
        [components]
        force = { kind = "sine", rate = 9.0 }
        plant = { kind = "descriptor", model = "mass", x0 = [1, 0], unit = { y = ["m", "m/s"] } }
        control = { kind = "gain", K = [[5, 2]], unit = { u = ["m", "km/h"] } }
        [connections]
        "plant.u" = "force.y"
        "control.u" = "plant.y"
    """
    (tmp_path / "a.toml").write_text(text)
    log = cosim.run(tmp_path / "a.toml", out=tmp_path / "a.mcap")
    y = log["plant.y"]
    assert log["control.u"] == pytest.approx(y * [1.0, 3.6], rel=1e-12)
    table = np.column_stack([log.t, 1e3 * y]).tolist()
    rows = "\n".join(",".join(map(repr, row)) for row in table)
    (tmp_path / "y.csv").write_text(f"t [s],place [mm],speed [mm/s]\n{rows}\n")
    swap = {"plant": tmp_path / "y.csv"}
    for names in ({"plant.y": ["place", "speed"]}, {"plant.y[0]": "place", "plant.y[1]": "speed"}):
        swapped = cosim.run(tmp_path / "a.toml", swap=swap, map=names)
        assert swapped.signals["plant.y"].unit == ("m", "m/s")
        assert swapped["control.u"] == pytest.approx(log["control.u"], rel=1e-12)
    assert swapped.signals["plant.y_samples"].unit == ("mm", "mm/s")
    edited = cosim.load(tmp_path / "a.toml").edit(swap=swap, map=names)
    with ExitStack() as resources:  # a member of a study, of which the swap is compared once
        again = build_experiment(edited, resources, reports=compare_swaps(edited))
        assert again.graph.layout["plant"].by_name["y"].unit == ("m", "m/s")
    (tmp_path / "y.csv").write_text(f"t [s],place [mm],speed\n{rows}\n")
    with pytest.raises(ScenarioError, match=r"'place' has unit 'mm', 'speed' has none"):
        cosim.run(tmp_path / "a.toml", swap=swap, map={"plant.y": ["place", "speed"]})


def signals(run):
    """Return the bits of every signal by its name."""
    names = []
    for component, channel in run.channels.items():
        names += [f"{component}.{signal.name}" for signal in channel.signals]
    return {name: run[name].tobytes() for name in names}


def text_with(swap):
    return replace(find("academic"), text=f"{find('academic').text}\n[swap]\n{swap}\n")


def test_a_map_means_what_was_edited_by_hand(other, by_hand):
    """Python and file give the same bits, under the scenario's names, truth too."""
    entries = ", ".join(f'"{port}" = "{name}"' for port, name in MAP.items())
    table = f'plant = {{ path = "{other}", map = {{ {entries} }} }}'
    nested = f'plant.path = "{other}"\n[swap.plant.map]\n' + "\n".join(
        f'{port} = "{name}"' for port, name in MAP.items()
    )
    runs = [
        cosim.run("academic", swap={"plant": other}, map=MAP, set=COARSE),
        cosim.run(cosim.load("academic").swap(plant=other, map=MAP).set(COARSE)),
        cosim.run(parse(text_with(table).with_changes(COARSE))),
        cosim.run(parse(text_with(nested).with_changes(COARSE))),
    ]
    expected = signals(by_hand)
    for port, name in SHOWN.items():
        expected[port] = expected.pop(f"plant.{name}")
    for run in runs:
        assert signals(run) == expected
        assert json.loads(run.metadata["cosim.run"]["truth"])["observer.x_a"] == "plant.x_a"


def test_an_element_may_take_a_ports_place(by_hand, folder):
    """out[2] is y, for the observer and in the truth; the vector is recorded too."""
    text = find("academic").text
    text = text.replace('"observer.delta" = "delta.y"', '"observer.y" = "plant.y"')
    document = replace(find("academic"), text=text).with_swaps(
        {"plant": str(folder / "packed.fmu")}, PACKED
    )
    run = cosim.run(parse(document.with_changes(COARSE)))
    assert (run["observer.delta"] == by_hand["observer.delta"]).all()
    assert (run["plant.out"][:, 2] == run["plant.y"]).all()
    largest = {signal.estimate: signal.largest for signal in summarize(run).signals}
    assert largest["observer.y"] == 0.0


def test_a_mapped_run_replays_bit_for_bit(other, tmp_path):
    """The map is in the log with the swap; the FMU's signals come from the log."""
    copy = tmp_path / "copy.fmu"
    copy.write_bytes(other.read_bytes())
    maps = {**MAP, "plant.x_a": ["s[0]", "s[1]"]}
    log = cosim.run("academic", swap={"plant": copy}, map=maps, set=COARSE, out=tmp_path / "a.mcap")
    copy.unlink()
    assert json.loads(log.metadata["cosim.run"]["edits"])["maps"] == maps
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal
    assert "plant/modelDescription.xml" in log.attachments
    assert json.loads(log.metadata["cosim.component.plant"]["metadata"])["sha256"]


def test_a_vector_may_be_made_of_elements(by_hand, other):
    """A list, or text as on the command line, give the same bits."""
    for names in (["s[0]", "s[1]"], ["s[0:2]"], """["s[0]",'s[1]']"""):
        maps = {**MAP, "plant.x_a": names}
        run = cosim.run("academic", swap={"plant": other}, map=maps, set=SHORT)
        assert run["plant.x_a"].tolist() == by_hand["plant.s"][:11].tolist()


def test_a_swap_of_the_file_may_choose_the_interface_type_and_give_way_to_an_option(
    other, tmp_path
):
    """x.fmu#cs in the file is co-simulation; a path is taken from the file's folder."""
    document = replace(text_with('plant = "other.fmu#cs"'), folder=other.parent)
    assert parse(replace(document, maps=MAP)).specs["plant"].interface_type == "cs"
    with pytest.raises(ScenarioError, match="must_not_be"):
        cosim.run(parse(document.with_swaps({"plant": str(tmp_path / "must_not_be.fmu")})))
    assert not parse(replace(document, swapped=False)).file.swap


MAP_OF_Y = {port: name for port, name in MAP.items() if port != "plant.x_a"}
WRONG = [
    # no such port, or none that is meant
    ({"y": "out1"}, r"map\['y'\]: expected COMPONENT\.PORT"),
    ({"plnt.u": "force"}, r"map\['plnt\.u'\]: .*'plant'.*; did you mean 'plant\.u'\?"),
    ({"plant.uu": "force"}, r"map\['plant\.uu'\]: .*; did you mean 'plant\.u'\?"),
    ({"regressor.delta": "out1"}, r"map\['regressor\.delta'\]: .*'plant'.*: .*observer\.y"),
    # no such port in the new component, or of another causality
    (MAP | {"observer.y": "out2"}, r"map\['observer\.y'\]: .*no output 'out2'.* 'out1'\?"),
    (MAP | {"observer.y": "force"}, r"observer\.y'\]: .*an input; available: aux, s, out1\n"),
    # no such elements, or another number of them
    (MAP | {"observer.y": "s[2]"}, r"'plant\.s\[2\]': 'plant\.s' has 2 elements"),
    (MAP | {"observer.y": "s[1:1]"}, r"map\['observer\.y'\]: 'plant\.s\[1:1\]' has no elements"),
    (MAP | {"observer.y": "s"}, r"plant\.y -> observer\.y: size 2 cannot drive size 1"),
    # twice
    (MAP | {"plant.delta": "force"}, r"delta'\]: 'plant\.force' .*'plant\.u' and 'plant\.delta'"),
    (MAP | {"plant.y": "aux"}, r"map\['plant\.y'\]: .* twice, as 'out1' .* and as 'aux'"),
    (MAP | {"plant.x_a[0]": "s[1]"}, r"'plant\.x_a\[0\]' \(as s\[1\]\) overlaps 'plant\.x_a'"),
    # not all of a port
    (MAP_OF_Y | {"plant.x_a[1]": "s[1]"}, r"x_a\[1\]'\]: .*has 2 elements; .*: plant\.x_a\[0\], "),
    # no name
    (MAP | {"observer.y": ["out1", ""]}, r"map\['observer\.y'\]: expected the name .* none\n"),
    (MAP | {"plant.x_a": "[s[0], s[1]"}, r"map\['plant\.x_a'\]: .* got '\[s\[0\], s\[1\]'"),
]


def test_a_wrong_map_is_reported(other):
    """The option, what was found, the nearest; and a map needs a swap."""
    swap = {"plant": other}
    run = partial(cosim.run, "academic", set=COARSE)
    check_refused(WRONG, lambda names: run(swap=swap, map=names), ScenarioError)
    with pytest.raises(ScenarioError, match=r"^map\['observer\.y'\]: .*\[swap\]$"):
        run(map={"observer.y": "out1"})


def test_all_that_is_wrong_is_reported_at_once(other):
    """Swap, map, set and file in one report."""
    with pytest.raises(ScenarioError) as caught:
        cosim.load("academic").edit(
            swap={"plant": other, "plnt": other},
            map={"plant.uu": "x"},
            set={"observer.filter_rat": 1.0},
        )
    for text in ("swap['plnt']: ", "map['plant.uu']: ", "set['observer.filter_rat']: "):
        assert text in str(caught.value)


ENTRIES = [
    ("plant = 3", r"academic:\d+: swap\.plant: expected a table, got 3"),
    ('plant = { map = { "plant.u" = "x" } }', r"academic:\d+: swap\.plant: 'path' is missing"),
    ('plant = "x.xyz"', r"academic:\d+: swap\.plant: .* \.fmu"),
    ('plant = "x.fmu#xx"', r"academic:\d+: swap\.plant: .*'#me' .*'#cs' .*, got '#xx'$"),
    ('plant = { path = "x.fmu", map = { "regressor.z" = "x" } }', r"map\.regressor\.z: .*plant\.u"),
    ('plant = { path = "x.fmu", map = { plant.u = 1 } }', r"swap\.plant\.map\.plant\.u: .*got 1\n"),
    ('plant = { path = "x.fmu", mode = "cs" }', r"swap\.plant\.mode: unknown key 'mode'"),
]


def test_a_wrong_entry_of_the_file_is_reported_with_its_line():
    """As everything else in a file."""
    check_refused(ENTRIES, lambda swap: parse(text_with(swap)), ScenarioError)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--swap", "plant=a.fmu", "--swap", "plant=b.fmu"], "--swap plant: expected once"),
        (["--map", "plant.u=a", "--map", "plant.u=b"], "--map plant.u: expected once"),
    ],
)
def test_a_name_is_given_once(options, text, call):
    """The last one does not win in silence."""
    code, _, err = call("run", "academic", *options)
    assert (code, text in err) == (2, True)
