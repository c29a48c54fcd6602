"""Kinds of installed packages, by the entry points ``cosim.components``."""

import json
import sys

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.log import open_log
from cosim.report.inspection import describe_scenario
from cosim.report.tables.catalog import show_catalog, show_kind
from cosim.report.tables.console import print_shown
from cosim.report.verification import verify
from tests.scenario.user_modules import RELAY, THERMOSTAT, write

SCENARIO = THERMOSTAT.replace('kind = "python"\nclass = "relay:Relay"\n', 'kind = "relay"\n')


def install(site, name, entries, version="1.0"):
    """Write the metadata of a distribution with entry points, as an installer does."""
    about = site / f"{name}-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (about / "entry_points.txt").write_text(f"[cosim.components]\n{entries}\n")
    (about / "top_level.txt").write_text("relay_parts\n")
    (about / "RECORD").write_text("")


@pytest.fixture
def site(tmp_path, monkeypatch):
    """Return a folder on sys.path where a package with a relay is installed."""
    site = tmp_path / "site"
    site.mkdir()
    write(site / "relay_parts", __init__="", thermostats=RELAY)
    install(site, "relay_package", "relay = relay_parts.thermostats:Relay")
    before = set(sys.modules)
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thermostat.toml").write_text(SCENARIO)
    yield site
    for name in set(sys.modules) - before:
        if name.startswith("relay_parts"):
            del sys.modules[name]


def test_an_entry_point_makes_a_kind(site):
    """The same run as by its class; the log names package and version."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    code = json.loads(log.metadata["cosim.component.relay"]["metadata"])["code"]
    assert code["class"] == "relay_parts.thermostats:Relay"
    assert set(code["sources"]) == {"relay_parts/thermostats.py"}
    assert code["distribution"] == "relay_package 1.0"
    by_class = cosim.run(
        "thermostat.toml",
        set={"relay.kind": "python", "relay.class": "relay_parts.thermostats:Relay"},
    )
    assert cosim.diff(log, by_class).equal


def test_nothing_is_imported_to_list_or_show_it(site, capsys):
    print_shown(show_catalog(), as_json=True)
    entry = {"kind": "relay", "class_name": "relay_parts.thermostats:Relay"}
    entry |= {"distribution": "relay_package 1.0", "refused": None}
    assert json.loads(capsys.readouterr().out)["installed"] == [entry]
    print_shown(show_kind("relay"), as_json=False)
    text = capsys.readouterr().out
    assert "relay: relay_parts.thermostats:Relay, of relay_package 1.0" in text
    assert "parameters: those of its constructor; nothing is imported here" in text
    metadata = describe_scenario("thermostat.toml")["metadata"]
    assert metadata["relay"]["class"] == "relay_parts.thermostats:Relay"
    assert not [name for name in sys.modules if name.startswith("relay_parts")]


def test_a_log_replays_where_the_package_is_not_installed(site, monkeypatch):
    """From the recording; with allowed code the package is needed."""
    cosim.run("thermostat.toml", out="a.mcap")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(site)])
    again = cosim.replay("a.mcap", out="b.mcap")
    assert verify(open_log("a.mcap"), again).passed
    assert verify(open_log("b.mcap"), cosim.replay("b.mcap")).passed
    message = r"thermostat\.toml:9: components\.relay: .*'relay'.*'cosim\.components'"
    with pytest.raises(ScenarioError, match=message):
        cosim.replay("a.mcap", allow_code=True)


def test_another_version_of_the_package_is_not_the_code_of_the_log(site):
    """Its other modules may be others, which the hash of the class's module does not tell."""
    cosim.run("thermostat.toml", out="a.mcap")
    assert verify(open_log("a.mcap"), cosim.replay("a.mcap", allow_code=True)).passed
    about = site / "relay_package-1.0.dist-info"
    for file in list(about.iterdir()):
        file.unlink()
    about.rmdir()
    install(site, "relay_package", "relay = relay_parts.thermostats:Relay", version="1.1")
    with pytest.raises(ScenarioError, match=r"got relay_package 1\.1; .*relay_package 1\.0"):
        cosim.replay("a.mcap", allow_code=True)


@pytest.mark.parametrize(
    ("package", "entry", "reason"),
    [
        ("gains", "gain = relay_parts.thermostats:Relay", "'gain' is a kind of cosim"),
        ("nameless", "nobody = relay_parts.thermostats", "expected 'package.module:Class', got"),
        ("other", "relay = relay_parts.thermostats:Relay", "'relay' is declared more than once"),
    ],
)
def test_an_entry_point_that_makes_no_kind_is_listed_with_the_reason(
    site, capsys, package, entry, reason
):
    """The name of a shipped kind stays with it: what is installed does not change a file."""
    install(site, package, entry)
    print_shown(show_catalog(), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if f"\t{package} 1.0" in line]
    assert f"refused: {reason}" in line
    print_shown(show_kind("gain"), as_json=False)
    assert "relay_parts" not in capsys.readouterr().out


def test_a_scenario_cannot_use_a_doubtful_entry_point(site):
    """One without a class, and one that two packages declare: with both, and the way out."""
    install(site, "nameless", "nobody = relay_parts.thermostats")
    with pytest.raises(ScenarioError, match=r"got 'relay_parts\.thermostats'"):
        cosim.run("thermostat.toml", set={"relay": {"kind": "nobody"}})
    install(site, "other", "relay = relay_parts.thermostats:Relay", version="2.0")
    with pytest.raises(ScenarioError, match=r"'relay' is declared 2 times.*kind = .pyt") as error:
        cosim.run("thermostat.toml")
    assert "other 2.0" in str(error.value)
    assert "relay_package 1.0" in str(error.value)
