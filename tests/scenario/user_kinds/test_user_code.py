"""How the class of a user is found, and what its constructor gets from the table."""

import hashlib
import importlib
import os
import re
import sys
from dataclasses import dataclass

import pytest

import cosim
from cosim.core import Interface
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.kinds.user_code import UserClass, load_class
from cosim.scenario.kinds.user_component import construct
from tests.scenario.refusals import check_refused
from tests.scenario.user_modules import one, own_module, write


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


# --- the parameters of a class: from the table, by name and annotation, and nothing else ---

TAKEN = """
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core import Interface, Signal

class Own:
    def __init__(self, *args, {parameter} = {default}, **kwargs):
        {name} = {name}
        self.value = {name}
        self.interface = Interface((Signal("u"),), (Signal("y"),))
        text = repr(self.value) if not isinstance(self.value, np.ndarray) else (
            f"{{self.value.dtype}} {{self.value.shape}} {{self.value.tolist()}}"
        )
        raise ValueError(text)
"""


def taken(folder, parameter, value, default="None"):
    """Return what a constructor gets, or what is said of the table."""
    name = parameter.partition(":")[0]
    write(folder, own=TAKEN.format(parameter=parameter, name=name, default=default))
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(folder, f"{name} = {value}"))
    text = str(error.value)
    _, _, raised = text.partition("raised ValueError: ")
    return raised.partition(" (")[0] if raised else text


TAKEN_AS = [
    ("float", "1", "1.0"),
    ("float", "2.5", "2.5"),
    ("int", "3", "3"),
    ("bool", "true", "True"),
    ("str", '"a"', "'a'"),
    ('Literal["a", "b"]', '"b"', "'b'"),
    ("float | None", "1", "1.0"),
    ("list[float]", "[1, 2.5]", "[1.0, 2.5]"),
    ("tuple[int, ...]", "[1, 2]", "(1, 2)"),
    ("list[list[float]] | None", "[[1], [2, 3]]", "[[1.0], [2.0, 3.0]]"),
    ('"list[float]"', "[1]", "[1.0]"),
]


def test_a_parameter_gets_what_its_annotation_says(tmp_path):
    """Whole numbers are numbers; nothing else is converted."""
    results = [(a, v, taken(tmp_path, f"a: {a}", v)) for a, v, _ in TAKEN_AS]
    assert results == TAKEN_AS


def test_an_array_is_one_of_float64(tmp_path):
    """Of one axis, or of two."""
    for annotation in ("np.ndarray", "NDArray[np.float64]", "Vector", "Matrix"):
        for value in ("[1, 2]", "[[1, 2], [3, 4]]"):
            text = taken(tmp_path, f"a: {annotation} | None", value)
            assert text.startswith("float64"), annotation


def test_the_names_that_pydantic_has_may_be_parameters(tmp_path):
    """Also those with an underscore in front."""
    for name in ("model_config", "json", "copy", "build", "ports", "_x", "field_0", "name"):
        assert taken(tmp_path, f"{name}: float", "1") == "1.0"


OF_ANOTHER_TYPE = [
    ("float", '"1"', r"expected a number, got '1'"),
    ("float", "true", r"expected a number, got True"),
    ("float", "nan", r"expected a finite number, got nan"),
    ("int", "1.0", r"expected a whole number, got 1\.0"),
    ("int", "true", r"expected a whole number, got True"),
    ("bool", "1", r"expected true or false, got 1"),
    ("str", "1", r"expected a string, got 1"),
    ('Literal["on", "off"]', '"of"', r"'of'; did you mean 'off'\? Available: on, off"),
    ("list[float]", "1.0", r"expected a list, got 1\.0"),
    ("np.ndarray", '"a"', r"expected a list, got 'a'"),
    ("np.ndarray", "[[1, 2], [3]]", r"rows: .*\[2, 1\]"),
]


def test_a_value_of_another_type_is_refused_at_its_line(tmp_path):
    """With what is expected there."""
    for annotation, value, pattern in OF_ANOTHER_TYPE:
        text = taken(tmp_path, f"a: {annotation}", value)
        assert re.fullmatch(rf"one\.toml:13: components\.own\.a: .*{pattern}.*", text)


CONSTRUCTORS = [
    (", a", r"the parameter 'a' of 'own:Own' has no annotation"),
    (", a: float, /", r"the parameter 'a' of 'own:Own' is positional-only"),
    (", unit: str = ''", r"the parameter 'unit' of 'own:Own' has a reserved name"),
    (", a: dict[str, float]", r"'a' of 'own:Own' .*dict\[str, float\]; expected float, int,"),
    (", a: np.ndarray[tuple[int], np.dtype[np.int64]]", r"'own:Own' .*int64\]\]; expected float"),
    (", a: tuple[float, float]", r"'a' of 'own:Own' .*tuple\[float, float\]; expected float"),
    (", a: 'Flaot'", r"'own:Own' .*NameError: name 'Flaot' is not defined"),
]


def test_a_constructor_that_cannot_be_served_is_refused(tmp_path):
    """At the line of the class."""

    def run(parameters):
        own_module(tmp_path, parameters)
        cosim.run(one(tmp_path))

    place = r"one\.toml:12: components\.own\.class: .*"
    check_refused([(case, place + text) for case, text in CONSTRUCTORS], run, ScenarioError)


def test_unknown_and_missing_parameters_are_told_together(tmp_path):
    """With what is available, and what is expected."""
    own_module(tmp_path, ", width: float, rows: list[list[float]], size: int = 1")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path, "size = 1.5\nnoise = 1"))
    assert sorted(str(error.value).splitlines()) == [
        "one.toml:10: components.own: 'rows' is missing (list[list[float]])",
        "one.toml:10: components.own: 'width' is missing (float)",
        "one.toml:13: components.own.size: expected a whole number, got 1.5",
        "one.toml:14: components.own.noise: unknown key 'noise'; available: rows, size, width",
    ]


@dataclass
class Kept:
    gain: "float"
    offset: "float" = 1.0

    def __post_init__(self):
        raise ValueError(f"{self.gain} and {self.offset}")


def test_a_dataclass_with_deferred_annotations_takes_its_fields():
    with pytest.raises(UsageError, match=r"the constructor of 'own:Kept' .*: 3\.0 and 1\.0 "):
        construct("own", UserClass("own:Kept", Kept, {}, ()), {"gain": 3})


def test_an_edit_of_a_parameter_is_named_as_the_place(tmp_path):
    own_module(tmp_path, ", width: float")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path), set={"own.width": "x"})
    assert str(error.value) == ("set['own.width']: expected a number, got 'x'")
