"""What was compiled is kept by all that decides it; nothing done to the cache hurts."""

import ctypes
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from cosim.fmi import compiling
from cosim.fmi.cache import COMPILED, VARIABLE, cached_files
from cosim.native import build

pytestmark = pytest.mark.skipif(not build.compiler(), reason="no C compiler")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Return the folder of a cache that is empty."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def calls(monkeypatch):
    """Return the names of the files that a compiler was called for, and wrote."""
    made = []
    run_compiler = build.run_compiler

    def run(command, arguments):
        words = list(arguments)
        is_object = "-c" in words
        made.append(os.path.basename(words[words.index("-c") + 1]) if is_object else "library")
        run_compiler(command, words)

    monkeypatch.setattr(build, "run_compiler", run)
    return made


@pytest.fixture
def sources(tmp_path):
    """Write two sources, one of which includes a header that includes another one."""
    (tmp_path / "headers").mkdir()
    (tmp_path / "one.c").write_text("double two(void);\ndouble one(void) { return two(); }\n")
    (tmp_path / "two.c").write_text('#include "two.h"\ndouble two(void) { return TWO; }\n')
    (tmp_path / "two.h").write_text("#include <number.h>\n")
    (tmp_path / "headers" / "number.h").write_text("#define TWO 2.0\n")
    return [tmp_path / "one.c", tmp_path / "two.c"]


@pytest.fixture
def compiled(tmp_path, sources, calls):
    """Return a function that compiles them, and returns what they compute and who was called."""

    def make(*options, command=None, name="library.so"):
        calls.clear()
        library = tmp_path / name
        headers = f"-I{tmp_path / 'headers'}"
        compiling.compile_library(sources, library, [headers, *options], command=command)
        # another name each time: a library that is loaded stays loaded
        loaded = library.rename(tmp_path / f"{len(list(tmp_path.iterdir()))}.so")
        function = ctypes.CDLL(str(loaded)).one
        function.restype = ctypes.c_double
        return function(), sorted(calls)

    return make


ALL = ["library", "one.c", "two.c"]
NOTHING = []


def test_the_same_sources_are_compiled_once(tmp_path, compiled, sources):
    """No compiler is called again, and the library is bit for bit that of one call for all."""
    assert compiled() == (2.0, ALL)
    assert compiled() == (2.0, NOTHING)
    options = [f"-I{tmp_path / 'headers'}"]
    kept = tmp_path / "kept.so"
    compiling.compile_library(sources, kept, options)
    direct = tmp_path / "direct.so"
    build.compile_library(sources, direct, options)
    assert kept.read_bytes() == direct.read_bytes()
    assert len(list(cached_files())) == 3


def test_a_header_counts_by_its_content(compiled, tmp_path):
    """Where it is does not; only the source that includes it is compiled anew."""
    compiled()
    number = tmp_path / "headers" / "number.h"
    text = number.read_text()
    number.write_text(text.replace("2.0", "3.0"))
    assert compiled() == (3.0, ["library", "two.c"])
    number.write_text(text)
    assert compiled() == (2.0, NOTHING)
    number.rename(tmp_path / "number.h")
    assert compiled(f"-I{tmp_path}") == (2.0, NOTHING)


def test_a_header_that_comes_before_another_counts(compiled, tmp_path):
    """As the compiler looks for them, in the order of the options."""
    compiled()
    first = tmp_path / "first"
    first.mkdir()
    (first / "number.h").write_text("#define TWO 4.0\n")
    assert compiled(f"-I{first}") == (2.0, NOTHING)
    (tmp_path / "two.h").write_text('#include "number.h"\n')
    (tmp_path / "number.h").write_text("#define TWO 5.0\n")
    assert compiled() == (5.0, ["library", "two.c"])


def test_options_count(compiled):
    assert compiled("-DX=1") == (2.0, ALL)
    assert compiled("-DX=2") == (2.0, ALL)
    assert compiled("-DX=1", "-O0") == (2.0, ALL)
    assert compiled("-DX=1") == (2.0, NOTHING)


def test_the_compiler_counts(compiled, tmp_path):
    """Its path, its file, and what it says of its version."""
    script = tmp_path / "bin" / "cc"
    script.parent.mkdir()
    text = f'#!/bin/sh\nexec {" ".join(build.compiler())} "$@"\n'
    script.write_text(text)
    script.chmod(0o755)
    assert compiled() == (2.0, ALL)
    assert compiled(command=[str(script)]) == (2.0, ALL)
    assert compiled(command=[str(script)]) == (2.0, NOTHING)
    script.write_text(text + "# another\n")
    compiling._identity.cache_clear()  # as in another process
    assert compiled(command=[str(script)]) == (2.0, ALL)


def test_the_version_of_the_package_counts_for_zig_alone(compiled, tmp_path, monkeypatch):
    """Its compiler is in that package; for cc it counts as little as where it is not installed."""
    script = tmp_path / "zig"
    script.write_text(f'#!/bin/sh\nshift\nexec {" ".join(build.compiler())} "$@"\n')
    script.chmod(0o755)
    installed = {"ziglang": "0.13.0"}
    monkeypatch.setattr(compiling.metadata, "version", installed.__getitem__)
    zig = [str(script), "ziglang"]
    assert compiled(command=zig) == (2.0, ALL)
    installed["ziglang"] = "0.14.0"
    compiling._identity.cache_clear()  # as in another process
    assert compiled(command=zig) == (2.0, ALL)
    assert compiled() == (2.0, ALL)
    installed.clear()
    compiling._identity.cache_clear()
    assert compiled() == (2.0, NOTHING)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[:40],
        lambda data: data[:-1],
        lambda data: data[:-1] + bytes([data[-1] ^ 1]),
        lambda data: bytes([data[0] ^ 1]) + data[1:],
    ],
    ids=["empty", "short", "truncated", "a bit", "the digest"],
)
def test_a_damaged_file_is_made_anew(compiled, damage):
    """Objects and libraries."""
    compiled()
    for file, _ in cached_files(COMPILED):
        file.write_bytes(damage(file.read_bytes()))
    assert compiled() == (2.0, ALL)
    assert compiled() == (2.0, NOTHING)


def test_a_cache_that_cannot_be_written_is_none(compiled, folder):
    """Here a file stands in its place."""
    folder.write_bytes(b"")
    assert compiled() == (2.0, ALL)
    assert compiled() == (2.0, ALL)
    assert folder.read_bytes() == b""


def test_without_a_cache_one_call_compiles_all(compiled, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    assert compiled() == (2.0, ["library"])


def test_a_full_disk_leaves_nothing(compiled, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert compiled() == (2.0, ALL)
    assert list(cached_files()) == []


@pytest.mark.parametrize(
    "text", ["const char *const file = __FILE__;", "#define NAME <math.h>\n#include NAME"]
)
def test_a_source_that_depends_on_more_is_not_kept(compiled, sources, text):
    """Its place, or a header whose name a macro makes."""
    sources[0].write_text(f"{text}\n{sources[0].read_text()}")
    assert compiled() == (2.0, ["library"])
    assert list(cached_files()) == []


def test_an_option_that_is_not_known_is_not_kept(compiled, tmp_path):
    """Such as a file that is included."""
    assert compiled("-include", str(tmp_path / "two.h")) == (2.0, ["library"])
    assert list(cached_files()) == []


def test_the_message_of_the_compiler_is_passed_on(compiled, sources):
    """As it is without a cache; nothing is kept of it."""
    sources[0].write_text('#error "this is wrong"\n')
    with pytest.raises(RuntimeError, match=r"(?s)cc.* failed:.*one\.c:1.*this is wrong"):
        compiled()
    assert len(list(cached_files())) <= 1  # of the other source


def test_the_files_that_were_not_used_for_longest_go_first(compiled, monkeypatch):
    compiled("-DX=1")
    for file, _ in cached_files():
        os.utime(file, (0, 0))
    compiled("-DX=2")
    of_both = {file for file, _ in cached_files()}
    assert len(of_both) == 6
    assert compiled("-DX=1") == (
        2.0,
        NOTHING,
    )  # its library was used just now, its objects were not
    monkeypatch.setattr(compiling, "LARGEST_FOLDER", sum(s.st_size for _, s in cached_files()) - 1)
    compiling._remove_oldest()
    (gone,) = of_both - {file for file, _ in cached_files()}
    assert compiled("-DX=1") == (2.0, NOTHING)
    assert compiled("-DX=2") == (2.0, NOTHING)
    assert not gone.exists()


def test_many_at_once(tmp_path, sources):
    """Every one has the whole library."""

    def make(number):
        library = tmp_path / f"{number}.so"
        compiling.compile_library(sources, library, [f"-I{tmp_path / 'headers'}"])
        return library.read_bytes()

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(make, range(4)))) == 1
    assert len(list(cached_files())) == 3
