"""Files that are read: regular ones, of a bounded size, also in the home folder."""

import json
import os
import socket

import pytest

import cosim
from cosim.cli import main
from cosim.errors import CosimError, ScenarioError
from cosim.files import file_type, read_bounded, read_type, regular
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document, find
from tests.log.foreign_files import write_json

SCENARIO = '[scenario]\nname = "a"\nstop = 1.0\nstep = 0.5\n[components.u]\n'


@pytest.mark.slow
def test_the_ending_of_a_name_counts_in_any_case(call, tmp_path):
    """Every command that reads or writes a log, an FMU or a scenario takes it for the same."""
    pytest.importorskip("matplotlib")
    (tmp_path / "S.TOML").write_text(find("academic").text)
    short = ("--stop", "0.01")
    export = ("export", "S.TOML", "--component", "plant", "--out")
    commands = [
        ("run", "S.TOML", *short, "--out", "A.Mcap"),
        ("info", "A.Mcap"),
        ("plot", "A.Mcap", "plant.y", "--out", "A.PNG"),
        (*export, "P.FMU"),
        ("info", "P.FMU"),
        ("run", "S.TOML", *short, "--swap", "plant=P.FMU#cs", "--out", "B.MCAP"),
    ]
    for command in commands:
        assert call(*command)[0] == 0, command
    swaps = ("--swap", "plant=P.FMU#cs", "--swap", "plant=A.Mcap")
    code, out, _ = call("compare", "S.TOML", *swaps, "--set", "scenario.stop=0.01", "--json")
    assert code == 0
    assert [plant["plant"] for plant in json.loads(out)["plants"]] == ["descriptor", "P#cs", "A"]
    for command, expected in [
        (("check", "A.Mcap"), "an FMU (.fmu)"),
        (("replay", "P.FMU"), "a log (.mcap)"),
        (("run", "P.FMU"), "P.FMU"),
        (("run", "no.Toml"), "cannot be read"),
        (("run", "academic", "--out", "a.log"), ".mcap"),
        ((*export, "P.so"), ".fmu"),
    ]:
        code, _, err = call(*command)
        assert (code, expected in err) == (2, True), err


@pytest.mark.parametrize("name", ["x.csv", "x.npz", "x.bag", "x.toml", "x.fmu", "x"])
def test_a_log_of_any_name_is_read(call, tmp_path, name):
    """By how it begins, also one of another tool; what is not there is what its ending says."""
    ending = read_type(tmp_path / name)
    call("run", "pair", "--stop", "0.01", "--out", "a.mcap")
    (tmp_path / name).write_bytes((tmp_path / "a.mcap").read_bytes())
    assert (read_type(tmp_path / name), ending) == ("log", file_type(name))
    assert cosim.diff(cosim.open_recording(name), cosim.open_log(name)).equal
    for command in ("hash {}", "info {}"):
        assert call(*command.format(name).split())[0] == 0
    for command in ("cat {}", "metrics {} last(t)"):
        found, known = (call(*command.format(given).split()) for given in (name, "a.mcap"))
        assert found == known
        assert found[0] == 0
    write_json(tmp_path / name, {"/r": [(0, {"y": 1.0}), (10**7, {"y": 2.0})]})
    assert call("cat", name)[1].splitlines() == ["t [s],/r.y", "0.0,1.0", "0.01,2.0"]


def read(path):
    """Read a file as what its suffix says."""
    match path.suffix:
        case ".toml":
            cosim.load(path)
        case ".csv":
            text = f'{SCENARIO}kind = "table"\nfile = {str(path)!r}\n'
            cosim.run(parse(Document(text, "a", path.parent)))
        case ".fmu":
            cosim.run("academic", swap={"plant": path})


@pytest.fixture
def special(tmp_path):
    """Return a function that makes a file of a type, with a suffix."""
    opened = []

    def make(kind, suffix):
        path = tmp_path / f"special{suffix}"
        if kind == "a pipe":
            os.mkfifo(path)
        elif kind == "a socket":
            opened.append(socket.socket(socket.AF_UNIX))
            opened[-1].bind(str(path))
        elif kind == "a device":
            path.symlink_to("/dev/zero")
        else:
            path.mkdir()
        return path

    yield make
    for one in opened:
        one.close()


@pytest.mark.parametrize("kind", ["a pipe", "a socket", "a device", "a folder"])
def test_only_regular_files_are_read(special, kind):
    """A device never ends and a pipe never begins: each is refused at once, by its name."""
    for suffix in (".toml", ".csv", ".fmu"):
        with pytest.raises(ScenarioError, match=rf"special{suffix}.*{kind}"):
            read(special(kind, suffix))


@pytest.mark.parametrize("suffix", [".toml", ".csv", ".fmu"])
def test_a_file_beyond_all_size_is_refused_before_it_is_read(tmp_path, suffix):
    """A sparse file of 1 TiB takes no room on the disk, and would take hours to read."""
    path = tmp_path / f"large{suffix}"
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(ScenarioError, match=r"too large: more than \d+ bytes"):
        read(path)


def test_a_file_that_hides_its_size_is_bounded_all_the_same(tmp_path):
    """What counts is what comes out: files of the kernel say that they are empty."""
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5) == b"12345"
    with pytest.raises(OSError, match="too large: more than 4 bytes"):
        read_bounded(path, 4)
    if os.path.exists("/proc/self/status"):
        with pytest.raises(OSError, match="too large: more than 10 bytes"):
            read_bounded("/proc/self/status", 10)


def test_a_file_that_is_refused_is_not_left_open(tmp_path, monkeypatch):
    """Also one that became a pipe after it was looked at."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    status = os.stat(__file__)
    closed = []
    close = os.close
    monkeypatch.setattr(os, "stat", lambda path: status)
    monkeypatch.setattr(os, "close", lambda descriptor: [closed.append(1), close(descriptor)])
    with pytest.raises(OSError, match="it is a pipe, not a regular file"):
        regular(str(path), os.O_RDONLY)
    assert closed == [1]


def test_a_name_with_the_character_0_is_no_name(tmp_path):
    """TOML can write it; the system cannot open it."""
    with pytest.raises(OSError, match="its name has the character 0"):
        read_bounded(tmp_path / "a\0b", 5)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Return a home folder with a scenario, a table and a log; the working folder is another."""
    home = tmp_path / "home"
    work = tmp_path / "work"
    home.mkdir()
    work.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("SOMEWHERE", str(home))
    monkeypatch.chdir(work)
    (home / "x.toml").write_text(HOMELY)
    (home / "x.csv").write_text("t,y\n0,3.0\n1,3.0\n")
    cosim.run("~/x.toml", out="~/x.mcap")
    yield home
    assert list(work.iterdir()) == []  # no folder named ~ among them


HOMELY = """
[scenario]
name = "x"
stop = 0.2
step = 0.1
[components]
a = { kind = "field-data", path = "~/x.csv" }
b = { kind = "constant", value = 1.0 }
"""


def test_home_is_found_in_every_path_of_python(home):
    """Of what is read, what is written, and what takes the place of a component."""
    assert cosim.open_log("~/x.mcap")["a.y"].tolist() == [3.0, 3.0, 3.0]
    assert cosim.read_field_data("~/x.csv")["y"].ravel().tolist() == [3.0, 3.0]
    swapped = cosim.run("~/x.toml", swap={"b": "~/x.mcap"}, out="~/made/b.mcap")
    assert swapped["b.y"].tolist() == [1.0, 1.0, 1.0]
    assert swapped.path == home / "made" / "b.mcap"
    cosim.replay("~/x.mcap", out="~/made/c.mcap")
    with pytest.raises(CosimError, match="SOMEWHERE"):  # environment variables are none
        cosim.open_log("$SOMEWHERE/x.mcap")


@pytest.mark.slow
def test_home_is_found_in_every_path_of_a_study(home):
    """Of its scenario, what it swaps, and its dataset."""
    varied = {"b": ["~/x.mcap"]}
    cosim.study("~/x.toml", vary=varied, metrics={"b": "last(b.y)"}, out="~/study", workers=1)
    assert (home / "study").is_dir()


@pytest.mark.parametrize(
    ("command", "made"),
    [
        ("run ~/x.toml --out=~/y.mcap --swap b=~/x.mcap", "y.mcap"),
        ("replay ~/x.mcap --out=~/y.mcap", "y.mcap"),
        ("cut ~/x.mcap --from 0.1 --out=~/y.mcap", "y.mcap"),
        ("convert ~/x.mcap ~/y.csv", "y.csv"),
        ("export pair --component motor --out=~/y.fmu", "y.fmu"),
        ("plot ~/x.mcap b.y --out=~/y.svg", "y.svg"),
        ("diff ~/x.mcap ~/x.mcap", "x.mcap"),
        ("info ~/x.mcap", "x.mcap"),
        ("hash ~/x.mcap", "x.mcap"),
        ("show ~/x.toml", "x.toml"),
    ],
)
@pytest.mark.fast("info ~/x.mcap-x.mcap", "run ~/x.toml --out=~/y.mcap --swap b=~/x.mcap-y.mcap")
def test_home_is_found_in_every_path_on_the_command_line(home, capsys, command, made):
    """Also where a shell leaves the sign, as in ``--out=~/y.mcap``."""
    with pytest.raises(SystemExit) as end:
        main(command.split())
    assert end.value.code == 0, capsys.readouterr().err
    assert (home / made).is_file()
