"""How the class of a user is found: in the folder of the scenario, or on sys.path."""

import hashlib
import importlib
import os
import re
import sys

import pytest

import cosim
from cosim.core import Interface
from cosim.errors import UsageError
from cosim.scenario.kinds.user_code import load_class
from tests.scenario.refusals import check_refused
from tests.scenario.user_modules import write


@pytest.fixture(autouse=True)
def the_process_is_as_before(tmp_path):
    """Nothing of a folder is left in the lists that the whole process has.

    What a test itself imported from its folder is taken out.
    """
    path = list(sys.path)
    finders = list(sys.meta_path)
    yield
    assert sys.path == path
    assert sys.meta_path == finders
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and file.startswith(str(tmp_path)):
            del sys.modules[name]


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_class_is_found_in_the_folder_and_leaves_nothing_behind(tmp_path):
    """No module, no path, no cache file; the hash is that of the file."""
    write(tmp_path, relay="class Relay:\n    size = 1\n")
    found = load_class("relay:Relay", tmp_path)
    assert found.loaded.size == 1
    assert found.sources == {"relay.py": sha256(tmp_path / "relay.py")}
    assert found.distribution is None
    assert "relay" not in sys.modules
    assert [path.name for path in tmp_path.iterdir()] == ["relay.py"]


def test_modules_of_the_same_name_in_two_folders_are_two(tmp_path):
    """Neither scenario gets that of the other, nor what that imports, whichever comes first."""
    for name in ("a", "b"):
        write(
            tmp_path / name,
            relay="from beside import NAME\nclass Relay:\n    name = NAME\n",
            beside=f"NAME = {name!r}\n",
        )
    for name in ("a", "b", "a"):
        folder = tmp_path / name
        found = load_class("relay:Relay", folder)
        assert found.loaded.name == name
        assert found.sources == {
            "relay.py": sha256(folder / "relay.py"),
            "beside.py": sha256(folder / "beside.py"),
        }


def test_a_class_is_imported_once_as_long_as_its_files_are_the_same(tmp_path):
    """An edit counts at once, also one of a module beside it, of the same size and age."""
    write(tmp_path, relay="from beside import N\nclass Relay:\n    n = N\n", beside="N = 1\n")
    first = load_class("relay:Relay", tmp_path)
    assert load_class("relay:Relay", tmp_path).loaded is first.loaded
    age = (tmp_path / "beside.py").stat()
    write(tmp_path, beside="N = 2\n")
    os.utime(tmp_path / "beside.py", ns=(age.st_atime_ns, age.st_mtime_ns))
    second = load_class("relay:Relay", tmp_path)
    assert (first.loaded.n, second.loaded.n) == (1, 2)
    assert first.sources["relay.py"] == second.sources["relay.py"]
    assert first.sources["beside.py"] != second.sources["beside.py"]


def test_packages_are_found_with_and_without_an_init_file(tmp_path):
    """Relative imports inside of them, too."""
    (tmp_path / "loose" / "inner").mkdir(parents=True)
    write(tmp_path / "loose" / "inner", relay="class Relay:\n    pass\n")
    write(tmp_path / "strict", __init__="", relay="from .beside import Relay\n")
    write(tmp_path / "strict", beside="class Relay:\n    pass\n")
    assert set(load_class("loose.inner.relay:Relay", tmp_path).sources) == {"loose/inner/relay.py"}
    assert set(load_class("strict.relay:Relay", tmp_path).sources) == {
        "strict/__init__.py",
        "strict/relay.py",
        "strict/beside.py",
    }


def test_a_module_of_the_same_name_stays_imported(tmp_path, monkeypatch):
    """It steps aside while the folder's is imported, and comes back."""
    write(tmp_path / "path", relay="class Relay:\n    name = 'path'\n")
    write(tmp_path / "folder", relay="class Relay:\n    name = 'folder'\n")
    monkeypatch.syspath_prepend(tmp_path / "path")
    relay = importlib.import_module("relay")
    monkeypatch.setitem(sys.modules, "relay", relay)  # and out again after the test
    assert load_class("relay:Relay", tmp_path / "folder").loaded.name == "folder"
    assert sys.modules["relay"] is relay
    assert load_class("relay:Relay", tmp_path).loaded is relay.Relay


def test_a_module_that_python_finds_in_the_same_file_is_the_ordinary_one(tmp_path, monkeypatch):
    """As in a script that stands in the folder: there is one class, not two."""
    write(tmp_path, ordinary_relay="class Relay:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    relay = importlib.import_module("ordinary_relay")
    monkeypatch.setitem(sys.modules, "ordinary_relay", relay)
    found = load_class("ordinary_relay:Relay", tmp_path)
    assert found.loaded is relay.Relay
    assert found.sources == {"ordinary_relay.py": sha256(tmp_path / "ordinary_relay.py")}


def test_an_ordinary_module_that_changed_since_is_refused(tmp_path, monkeypatch):
    """Its hash would be that of code that does not run."""
    write(tmp_path, stale_relay="class Relay:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    load_class("stale_relay:Relay", None)
    monkeypatch.setitem(sys.modules, "stale_relay", sys.modules["stale_relay"])
    write(tmp_path, stale_relay="class Relay:\n    other = 1\n")
    message = r"stale_relay\.py has changed since 'stale_relay:Relay' .*importlib\.reload"
    with pytest.raises(UsageError, match=message):
        load_class("stale_relay:Relay", None)
    importlib.reload(sys.modules["stale_relay"])
    assert load_class("stale_relay:Relay", None).loaded.other == 1


def test_a_class_of_an_installed_package_names_its_distribution():
    """With the version; here that of numpy, which is one."""
    found = load_class("numpy.polynomial:Polynomial", None)
    assert found.distribution == f"numpy {importlib.import_module('numpy').__version__}"
    assert set(found.sources) == {"numpy/polynomial/polynomial.py"}


def test_a_folder_that_has_the_package_itself_does_not_get_a_second_one(tmp_path):
    """A scenario at the root of a checkout: ``import cosim`` there is what runs."""
    (tmp_path / "cosim").symlink_to(next(iter(cosim.__path__)))
    write(tmp_path, relay="from cosim.core import Interface\nclass Relay:\n    i = Interface\n")
    assert load_class("relay:Relay", tmp_path).loaded.i is Interface


def test_folders_without_modules_do_not_hide_packages(tmp_path):
    """A folder ``scipy`` with data comes behind the package, as for Python itself."""
    (tmp_path / "scipy").mkdir()
    write(tmp_path, relay="import scipy.linalg\nclass Relay:\n    f = scipy.linalg.expm\n")
    assert callable(load_class("relay:Relay", tmp_path).loaded.f)


NOT_IMPORTABLE = [
    ("signal:Relay", r"'signal:Relay': .*'signal', a module of Python"),
    ("relai:Relay", r"'relai' in {folder} .*did you mean 'relay'\? Available: breaks, exits, "),
    ("relay:Rely", r"'relay' .*'Rely'; did you mean 'Relay'\? Available: Relay$"),
    ("relay:make", r"'relay:make': expected a class, got a function$"),
    ("breaks:Relay", r"'breaks' .*ZeroDivisionError: .*\({folder}/breaks.py, line 2"),
    ("wrong:Relay", r"'wrong' .*SyntaxError: expected ':' \({folder}/wrong.py, line 1"),
    ("exits:Relay", r"'exits' .*SystemExit: 3 \({folder}/exits.py, line 3"),
    ("outside:Relay", r"'outside' .*ModuleNotFoundError: .*_thing' \({folder}/outside.py, line 1"),
]


def test_a_class_that_cannot_be_imported_is_one_clear_error(tmp_path):
    """With what was found, what was expected, and the line of the user's file."""
    write(
        tmp_path,
        relay="class Relay:\n    pass\ndef make():\n    pass\n",
        breaks="def ratio():\n    return 1 / 0\nratio()\n",
        wrong="class Relay\n    pass\n",
        exits="import sys\n\nsys.exit(3)\n",
        outside="import no_such_thing\n",
    )
    folder = re.escape(str(tmp_path))
    cases = [(name, pattern.replace("{folder}", folder)) for name, pattern in NOT_IMPORTABLE]
    check_refused(cases, lambda name: load_class(name, tmp_path))


def test_a_module_without_a_file_is_refused(monkeypatch):
    """As nothing would tell the log what ran; nor is one found that is not on sys.path."""
    module = type(sys)("made_here")
    module.Relay = type("Relay", (), {"__module__": "made_here"})
    monkeypatch.setitem(sys.modules, "made_here", module)
    cases = [
        ("made_here:Relay", r"'made_here:Relay': .*without a file"),
        ("no_such_module:Relay", r"'no_such_module' on sys\.path;"),
    ]
    check_refused(cases, load_class)
