"""What the shell is told to complete, by the protocol that bash uses."""

import pytest

from cosim.cli import main
from cosim.scenario.kinds import KINDS


@pytest.fixture
def complete(tmp_path, monkeypatch, capsys):
    """Return what bash would offer for the last word of a line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "academic-mine.toml").write_text("no = 'scenario'")
    (tmp_path / "plants").mkdir()
    (tmp_path / "plants" / "a.fmu").touch()
    (tmp_path / "plants" / "a.pdf").touch()
    (tmp_path / "plants" / "a.mcap").touch()
    (tmp_path / "plants" / "a.csv").touch()
    (tmp_path / ".hidden.toml").touch()

    def offered(line):
        words = line.split(" ")
        monkeypatch.setenv("_COSIM_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
        with pytest.raises(SystemExit):
            main()
        output = capsys.readouterr()
        assert output.err == ""
        return output.out.split()

    return offered


def test_scenarios_and_files_are_completed(complete):
    """Shipped ones by name, files by suffix, folders to go on from; nothing hidden."""
    assert complete("cosim run acad") == [
        "academic",
        "academic-as-printed",
        "academic-noisy",
        "academic-mine.toml",
    ]
    assert complete("cosim run pl") == ["plants/"]
    assert complete("cosim info plants/") == ["plants/a.fmu", "plants/a.mcap", "plants/a.csv"]
    assert complete("cosim run plants/") == []
    assert complete("cosim run no-such-folder/x") == []


def test_components_parameters_and_ports_are_those_of_the_scenario(complete):
    """The scenario may stand before options that lack their value."""
    assert complete("cosim export academic --component o") == ["observer"]
    offered = complete("cosim run academic --quiet --set identifier.")
    assert {"identifier.P0=", "identifier.method=", "identifier.start.epsilon_filter="} <= {
        *offered
    }
    assert complete("cosim run academic --set scenario.sto") == ["scenario.stop="]
    assert complete("cosim run academic --map observer.") == [
        "observer.u=",
        "observer.y=",
        "observer.delta=",
    ]
    assert complete("cosim compare academic --swap pl") == ["plant="]
    assert complete("cosim run academic --swap plant=plants/") == [
        "plant=plants/a.fmu",
        "plant=plants/a.mcap",
        "plant=plants/a.csv",
    ]


def test_completing_imports_no_class_of_a_user(complete, tmp_path):
    """Not even where a scenario has problems, of which a run would tell all."""
    (tmp_path / "own.py").write_text("open('imported', 'w').close()\n")
    text = '[scenario]\nname = "x"\nstop = 1.0\nstep = 0.1\n[components.own]\nkind = "python"\n'
    (tmp_path / "x.toml").write_text(text + 'class = "own:Own"\n')
    assert complete("cosim run x.toml --set own.") == ["own.class=", "own.unit="]
    (tmp_path / "x.toml").write_text(text + 'class = "own:Own"\n[components.b]\nkind = "no"\n')
    assert complete("cosim run x.toml --set own.") == []
    assert not (tmp_path / "imported").exists()


def test_a_line_without_a_scenario_that_can_be_read_completes_nothing(complete):
    """Without a message, which would stand in the line."""
    for scenario in ("nonsense", "academic-mine.toml"):
        assert complete(f"cosim run {scenario} --set o") == []
        assert complete(f"cosim run {scenario} --swap o") == []
        assert complete(f"cosim run {scenario} --map o") == []
    assert complete("cosim run --set o") == []


def test_kinds_are_completed(complete):
    """All of them."""
    assert complete("cosim list ") == list(KINDS)


def test_what_a_command_may_fail_on_is_completed(complete):
    """After a comma too."""
    assert complete("cosim run academic --fail-on in") == ["inconsistent"]
    assert complete("cosim replay a.mcap --fail-on warning,no") == ["warning,no-estimate"]
