"""What a trial found is kept by the content of the file; nothing done to the cache hurts."""

import os
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cosim.fmi import cache, child_process, trial_cache
from cosim.fmi.cache import cache_folder, cached_files
from cosim.fmi.child_process import TrialProblem, find_rollback_problems
from cosim.fmi.reading.model_description import read
from cosim.fmi.trial_cache import KeptTrial
from tests.fmi.compiled import with_description
from tests.fmi.rogues import XML, compile_rogue

pytestmark = pytest.mark.usefixtures("trials_in_children")

KEPT = KeptTrial("rollback", "0" * 64, "cs")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """Return the folder of a cache that is empty."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(cache.VARIABLE, str(folder))
    child_process._try_rollback.cache_clear()
    yield folder
    child_process._try_rollback.cache_clear()


@pytest.fixture
def trials(monkeypatch) -> list[str]:
    """Return the trials that were really made."""
    made: list[str] = []

    def attempt(task, *arguments, timeout):
        made.append(task)
        kind = "wrong" if "lies" in arguments[0] else "other"
        return tuple(TrialProblem(text, kind) for text in made_problems(arguments[0]))

    monkeypatch.setattr(child_process, "attempt", attempt)
    return made


def made_problems(path):
    """Return what the path says that is wrong."""
    return {"lies": ("goes back wrongly: y",), "hangs": ("hangs: here",)}.get(Path(path).stem, ())


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    return compile_rogue(tmp_path_factory.mktemp("good") / "good.fmu", "GOOD")


@pytest.fixture
def archive(good):
    """Return a function that reads a copy of the FMU, of another content for each name."""

    def make(folder, name):
        folder.mkdir(exist_ok=True)
        xml = XML.replace("rogue", name)
        return read(with_description(good, folder / f"{name}.fmu", xml))

    return make


def find(found):
    """Look it up as another process would."""
    child_process._try_rollback.cache_clear()
    return find_rollback_problems(found, "cs")


@pytest.mark.parametrize(("name", "count"), [("good", 1), ("lies", 1), ("hangs", 2)])
def test_a_trial_is_made_once_for_a_content(tmp_path, trials, archive, name, count):
    """Under another path too; but what may belong to the moment, a hang, is tried again."""
    first = archive(tmp_path / "one", name)
    expected = made_problems(first.path)
    assert find(first) == expected
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(first.path, other / f"{name}.fmu")
    assert find(read(other / f"{name}.fmu")) == expected
    assert len(trials) == count


def test_another_content_is_another_trial(tmp_path, trials, archive):
    find(archive(tmp_path / "one", "good"))
    find(archive(tmp_path / "two", "better"))
    assert len(trials) == 2


def test_a_damaged_file_is_none(folder, subtests):
    for number, damage in enumerate(
        [
            lambda data: b"",
            lambda data: data[: len(data) // 2],
            lambda data: data.replace(b"0000", b"1111"),  # another file's
            lambda data: b'{"key": 1}',
            lambda data: b"[" * 60_000,
            lambda data: b"\xff\xfe" + data,
            lambda data: data.replace(b'["goes back wrongly"]', b'"goes"'),
            lambda data: data.replace(b'["goes back wrongly"]', b"[1]"),
        ]
    ):
        with subtests.test(number=number):
            KEPT.keep(["goes back wrongly"])
            assert KEPT.problems() == ("goes back wrongly",)
            ((file, _),) = cached_files()
            file.write_bytes(damage(file.read_bytes()))
            assert KEPT.problems() is None
            KEPT.keep([])
            assert KEPT.problems() == ()


def test_the_version_of_the_trial_and_the_platform_count(folder, monkeypatch):
    KEPT.keep([])
    for name, value in (("TRIAL_VERSION", 99), ("SYSTEM", "other"), ("__version__", "99")):
        with monkeypatch.context() as patch:
            patch.setattr(trial_cache, name, value)
            assert KEPT.problems() is None
    assert KEPT.problems() == ()


def test_a_folder_that_cannot_be_written_is_no_cache(tmp_path, monkeypatch, folder):
    """Here a file stands in its place, which no user can write into."""
    folder.write_bytes(b"")
    KEPT.keep([])
    assert KEPT.problems() is None
    assert list(cached_files()) == []
    assert cache.clear() == 0


def test_an_empty_variable_is_no_cache(monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, "")
    KEPT.keep([])
    assert cache_folder() is None
    assert KEPT.problems() is None


def test_a_write_that_fails_leaves_nothing(folder, monkeypatch):
    """The disk is full when the file gets its name."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    KEPT.keep([])
    assert list(cached_files()) == []


def test_many_writers_and_readers_at_once(folder):
    """Every reader finds nothing or all of it."""

    def write_and_read(number):
        KEPT.keep(["goes back wrongly" * 100] * 10)
        return KEPT.problems()

    with ThreadPoolExecutor(8) as pool:
        results = set(pool.map(write_and_read, range(200)))
    assert results <= {None, ("goes back wrongly" * 100,) * 10}
    assert len(list(cached_files())) == 1


def test_clear_removes_what_is_kept_and_nothing_else(folder):
    KEPT.keep([])
    foreign = [folder / "trials" / name for name in ("notes.txt", "subject-01.json", "a.part")]
    for file in foreign:
        file.write_text("mine")
    (folder / "trials" / f"{'0' * 64}.x_1.part").write_text("unfinished")
    assert len(list(cached_files())) == 2
    assert cache.clear() == 2
    assert all(file.read_text() == "mine" for file in foreign)
    assert KEPT.problems() is None


def test_the_folder_of_each_system(monkeypatch, subtests):
    """As the XDG Base Directory Specification, Apple and Microsoft say."""
    for platform, variables, expected in [
        ("linux", {cache.VARIABLE: "~/c"}, "/home/me/c"),
        ("linux", {"XDG_CACHE_HOME": "/x"}, "/x/cosim"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "/home/me/.cache/cosim"),
        ("linux", {}, "/home/me/.cache/cosim"),
        ("darwin", {}, "/home/me/Library/Caches/cosim"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/cosim"),
    ]:
        with subtests.test(platform=platform, variables=variables):
            monkeypatch.delenv(cache.VARIABLE, raising=False)
            monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
            monkeypatch.setenv("HOME", "/home/me")
            monkeypatch.setattr(sys, "platform", platform)
            for name, value in variables.items():
                monkeypatch.setenv(name, value)
            assert cache_folder() == Path(expected)


def test_the_command(call, folder):
    KEPT.keep([])
    code, out, _ = call("cache")
    assert code == 0
    assert out.startswith(f"{folder}: 1 trial results, 0 compiled files, ")
    assert call("cache", "--clear") == (0, f"{folder}: 1 removed\n", "")
    assert '"files": 0' in call("cache", "--json")[1]
