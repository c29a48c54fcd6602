"""Kinds of installed packages, by the entry points ``cosim.components``."""

import json
import re
import sys

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.log import open_log
from cosim.report.inspection import describe_scenario
from cosim.report.tables.catalog import print_catalog, print_kind
from cosim.report.verification import verify
from cosim.scenario.kinds.user_component import installed_class
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
    print_catalog(as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert "relay\trelay_parts.thermostats:Relay\trelay_package 1.0" in [
        line.rstrip("\t") for line in lines
    ]
    print_catalog(as_json=True)
    assert json.loads(capsys.readouterr().out)["installed"] == [
        {
            "kind": "relay",
            "class_name": "relay_parts.thermostats:Relay",
            "distribution": "relay_package 1.0",
            "refused": None,
        }
    ]
    print_kind("relay", as_json=False)
    text = capsys.readouterr().out
    assert "relay: relay_parts.thermostats:Relay, of relay_package 1.0" in text
    assert "parameters: those of its constructor; nothing is imported here" in text
    metadata = describe_scenario("thermostat.toml")["metadata"]
    assert metadata["relay"]["class"] == "relay_parts.thermostats:Relay"
    assert not [name for name in sys.modules if name.startswith("relay_parts")]


def test_parameters_are_those_of_the_constructor(site):
    with pytest.raises(ScenarioError) as error:
        cosim.run("thermostat.toml", set={"relay.widht": 1.0})
    assert "unknown key 'widht'; did you mean 'width'? Available: width" in str(error.value)


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


def test_the_name_of_a_shipped_kind_stays_with_it(site, capsys):
    """What is installed cannot change what a file means; the list says so."""
    install(site, "gains", "gain = relay_parts.thermostats:Relay")
    print_catalog(as_json=False)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "\tgains 1.0" in line]
    assert "refused: 'gain' is a kind of cosim" in line
    print_kind("gain", as_json=False)
    assert "relay_parts" not in capsys.readouterr().out


def test_an_entry_point_that_names_no_class_is_refused(site, capsys):
    """In the list, and where a scenario has its kind."""
    install(site, "nameless", "nobody = relay_parts.thermostats")
    print_catalog(as_json=False)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "nameless 1.0" in line]
    text = "expected 'package.module:Class', got 'relay_parts.thermostats'"
    assert f"refused: {text}" in line
    with pytest.raises(ScenarioError, match=re.escape(text)):
        cosim.run("thermostat.toml", set={"relay": {"kind": "nobody"}})


def test_a_kind_that_two_packages_declare_is_refused(site, capsys):
    """With both, and the way out."""
    install(site, "other", "relay = relay_parts.thermostats:Relay", version="2.0")
    with pytest.raises(UsageError, match=r"'relay' is declared 2 times.*kind = .python") as error:
        installed_class("relay")
    assert "other 2.0" in str(error.value)
    assert "relay_package 1.0" in str(error.value)
    with pytest.raises(ScenarioError, match="the kind 'relay' is declared 2 times"):
        cosim.run("thermostat.toml")
    print_catalog(as_json=False)
    assert "refused: 'relay' is declared more than once" in capsys.readouterr().out


def test_an_unknown_kind_names_the_installed_ones_too(site):
    (site.parent / "thermostat.toml").write_text(SCENARIO.replace('"relay"\n', '"rellay"\n'))
    with pytest.raises(ScenarioError) as error:
        cosim.load("thermostat.toml")
    assert "unknown kind 'rellay'; did you mean 'relay'?" in str(error.value)


def test_without_packages_there_is_no_table_of_them(capsys):
    print_catalog(as_json=False)
    assert "installed packages" not in capsys.readouterr().out
