"""The classes of users, imported by name: from a folder first, then as Python finds modules.

Two scenarios in different folders may each have a module ``relay``, and neither must get that of
the other. So a module in a scenario's folder, and what it imports from there, is no module of the
whole process:

* While it is imported, and only then, a finder of our own stands before those of Python; modules
  of the same names that are imported already step aside for as long. ``sys.path`` is never changed.
* Afterwards the modules of the folder are taken out of ``sys.modules``, and what stood there comes
  back. They live on in their classes. So they have to import what they need at their top: an
  import inside of a function comes too late, and finds what Python finds. Nor can their objects be
  pickled.
* They are kept by folder and name, and imported again once one of their files has changed.

A module that Python itself finds in the same file (a script in the folder, a folder on
``PYTHONPATH``, an installed package) is an ordinary module, and imported as such. Python's own
modules cannot be replaced by files of their names.

The log of a run names the source of a class by its hash. The modules of a folder are compiled from
the very bytes that are hashed, without a cache file; of an ordinary module it is its one file, read
when the class is first asked for.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import pkgutil
import re
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final
from weakref import WeakKeyDictionary

from cosim.errors import UsageError, nearest, quoted

_lock = threading.RLock()  # sys.modules and sys.meta_path are of the whole process


@dataclass(frozen=True, slots=True)
class UserClass:
    """A class and what its source is.

    Parameters
    ----------
    name : str
        ``package.module:Class``.
    loaded : type
    sources : mapping of file name to str
        The SHA-256 of its module; of a module in the folder, of everything too that it imported
        from there.
    files : tuple of Path
        Where these are.
    distribution : str or None
        Name and version of the installed package that it is part of.
    """

    name: str
    loaded: type
    sources: Mapping[str, str]
    files: tuple[Path, ...]
    distribution: str | None = None


@dataclass(frozen=True, slots=True)
class _FolderModule:
    """A module that was imported from a folder, and the hashes of all files that this took."""

    module: ModuleType
    hashes: Mapping[Path, str]

    def is_current(self) -> bool:
        """Return whether its files are those that were imported."""
        try:
            return all(_hash(path.read_bytes()) == text for path, text in self.hashes.items())
        except OSError:
            return False


_of_folders: Final[dict[tuple[Path, str], _FolderModule]] = {}
_of_ordinary: Final[WeakKeyDictionary[type, str]] = WeakKeyDictionary()  # hashes at first sight


def class_name_parts(name: str) -> tuple[str, str]:
    """Return module and class of ``package.module:Class``.

    Raises
    ------
    UsageError
        If it is something else.
    """
    module, colon, class_name = name.partition(":")
    names = [*module.split("."), class_name]
    if not colon or not all(map(str.isidentifier, names)):
        raise UsageError(f"expected 'package.module:Class', got {quoted(name)}{_meant(name)}")
    return module, class_name


def _meant(name: str) -> str:
    """Return what may be meant by ``package.module.Class``; empty: nobody knows."""
    module, dot, class_name = name.rpartition(".")
    if not dot or ":" in name:
        return ""
    corrected = f"{module}:{class_name}"
    return f"; did you mean {corrected!r}?"


class OtherSource(UsageError):
    """A file is not the expected one, and so it was not run.

    Parameters
    ----------
    file : str
    found : str
        Its SHA-256.
    """

    def __init__(self, file: str, found: str) -> None:
        super().__init__(f"{file} has the SHA-256 {found}")
        self.file = file
        self.found = found


def load_class(
    name: str,
    folder: Path | None = None,
    *,
    distribution: str | None = None,
    needed: Mapping[str, str] | None = None,
) -> UserClass:
    """Import a class.

    Parameters
    ----------
    name : str
        ``package.module:Class``.
    folder : Path, optional
        Where its module is looked for first.
    distribution : str, optional
        Name and version of the installed package that it is part of, where that is known.
    needed : mapping of file name to str, optional
        The SHA-256 of the sources; another file is not run. Of an ordinary module this is known
        where the class is defined in it.

    Raises
    ------
    OtherSource
        If a file is none of those needed.
    UsageError
        If there is no such module, it cannot be imported or has no such class, or its file changed
        since it was imported; what was raised is the cause.
    """
    module_name, class_name = class_name_parts(name)
    top = module_name.partition(".")[0]
    if top in sys.stdlib_module_names or top == "__main__":
        raise UsageError(
            f"{quoted(name)}: expected a module of your own, got {top!r}, a module of Python"
        )
    with _lock:
        importlib.invalidate_caches()  # a file may be younger than the listing of its folder
        inside = None if folder is None else _FolderFinder(folder)
        if inside is None or not inside.has(module_name):
            if needed is not None and module_name not in sys.modules:
                _check_ordinary(module_name, needed)
            user_class = _ordinary_class(name, module_name, class_name, folder)
            package = distribution or _distribution_of(module_name)
            return replace(user_class, distribution=package)
        key = (inside.folder, module_name)
        imported = _of_folders.get(key)
        if imported is None or not imported.is_current():
            inside.needed = needed
            imported = _of_folders[key] = _import_from(inside, module_name)
    sources = {}
    for path, text in imported.hashes.items():
        sources[path.relative_to(inside.folder).as_posix()] = text
    return UserClass(name, _class_in(imported.module, class_name), sources, tuple(imported.hashes))


# --- modules of a folder ---


class _HashingLoader(SourceFileLoader):
    """Compiles a file anew from the bytes that it hashes."""

    def __init__(self, name: str, path: str, finder: _FolderFinder) -> None:
        super().__init__(name, path)
        self._finder = finder

    def get_code(self, fullname: str) -> CodeType:
        """Return the code of the module.

        Raises
        ------
        OtherSource
            If it is not the one that is needed.
        """
        source = self.get_data(self.path)
        self._finder.take(Path(self.path), _hash(source))
        code: CodeType = self.source_to_code(source, self.path)
        return code


class _FolderFinder(MetaPathFinder):
    """Finds modules in a folder.

    Attributes
    ----------
    folder : Path
    hashes : dict of Path to str
        The SHA-256 of every file that was imported, the first one first.
    needed : mapping of file name to str, or None
        What these have to be; None: anything.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.hashes: dict[Path, str] = {}
        self.needed: Mapping[str, str] | None = None
        self._own: dict[str, bool] = {}  # names without a dot, and whether the folder has them

    def has(self, name: str) -> bool:
        """Return whether the folder has the file of a module, whose packages are not imported."""
        *packages, last = name.split(".")
        if not self.owns(name.partition(".")[0]):
            return False
        spec = PathFinder.find_spec(last, [str(self.folder.joinpath(*packages))])
        return spec is not None and spec.origin is not None

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module that the folder has; None: it is one of others."""
        if not self.owns(fullname.partition(".")[0]):
            return None
        spec = PathFinder.find_spec(fullname, [str(self.folder)] if path is None else path)
        if spec is None or spec.origin is None:
            return spec
        if isinstance(spec.loader, SourceFileLoader):
            spec.loader = _HashingLoader(fullname, spec.origin, self)
        return spec

    def take(self, path: Path, digest: str) -> None:
        """Note the hash of a file that is about to be run.

        Raises
        ------
        OtherSource
            If it is not the one that is needed.
        """
        file = path.relative_to(self.folder).as_posix()
        if self.needed is not None and self.needed.get(file) != digest:
            raise OtherSource(file, digest)
        self.hashes[path] = digest

    def owns(self, top: str) -> bool:
        """Return whether a module without a package is one of the folder's."""
        if top not in self._own:
            self._own[top] = self._is_own(top)
        return self._own[top]

    def _is_own(self, top: str) -> bool:
        if top in sys.stdlib_module_names or top == "__main__":
            return False
        spec = PathFinder.find_spec(top, [str(self.folder)])
        if spec is None:
            return False
        ordinary = self._ordinary_spec(top)
        if ordinary is None:
            return True
        if spec.origin is None:  # a folder without __init__.py, behind which all others come
            return ordinary.origin is None
        if ordinary.origin is None:
            return True
        return Path(ordinary.origin).resolve() != Path(spec.origin).resolve()

    def _ordinary_spec(self, top: str) -> ModuleSpec | None:
        """Return what Python itself has or finds under a name."""
        if top in sys.modules:
            return getattr(sys.modules[top], "__spec__", None)
        for finder in sys.meta_path:
            if finder is not self:
                spec = finder.find_spec(top, None)
                if spec is not None:
                    return spec
        return None


def _import_from(finder: _FolderFinder, name: str) -> _FolderModule:
    with _in_front(finder):
        module = _imported(name, finder.folder)
    for path in _files_without_source(finder, module):
        finder.hashes[path] = _hash(path.read_bytes())
    return _FolderModule(module, dict(finder.hashes))


@contextmanager
def _in_front(finder: _FolderFinder) -> Iterator[None]:
    """Import with a finder before all others; leave none of its modules behind."""
    aside = {}
    for name in list(sys.modules):
        if finder.owns(name.partition(".")[0]):
            aside[name] = sys.modules.pop(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in list(sys.modules):
            if finder.owns(name.partition(".")[0]):
                del sys.modules[name]
        sys.modules.update(aside)


def _files_without_source(finder: _FolderFinder, module: ModuleType) -> list[Path]:
    """Return the file of a module that was compiled before, such as a C extension."""
    path = Path(str(module.__file__))
    return [] if path in finder.hashes else [path]


# --- ordinary modules ---


def _check_ordinary(name: str, needed: Mapping[str, str]) -> None:
    """Refuse a module that would be run, and is another one than was needed.

    Raises
    ------
    OtherSource
        If it is.
    """
    try:
        spec = importlib.util.find_spec(name)
        path = Path(str(None if spec is None else spec.origin))
        digest = _hash(path.read_bytes())
    except (ImportError, OSError):  # its import says what is wrong
        return
    source = Path(*name.split(".")).with_suffix(path.suffix).as_posix()
    if path.stem == "__init__":
        source = Path(*name.split("."), path.name).as_posix()
    if needed.get(source, digest) != digest:
        raise OtherSource(source, digest)


def _ordinary_class(name: str, module_name: str, class_name: str, folder: Path | None) -> UserClass:
    module = _imported(module_name, folder)
    loaded = _class_in(module, class_name)
    home = sys.modules.get(loaded.__module__, module)  # the class may be defined elsewhere
    file = getattr(home, "__file__", None)
    if file is None:
        raise UsageError(
            f"{quoted(name)}: expected a module in a file, which the log of a run can name, got "
            "one without a file"
        )
    path = Path(file)
    try:
        digest = _hash(path.read_bytes())
    except OSError as error:
        raise UsageError(
            f"{path}, the source of {quoted(name)}, cannot be read ({error.strerror}); the log "
            "of a run records its hash"
        ) from error
    known = _of_ordinary.setdefault(loaded, digest)
    if digest != known:
        raise UsageError(
            f"{path} has changed since {quoted(name)} was imported; start a new process, or use "
            "importlib.reload"
        )
    source = Path(*loaded.__module__.split(".")).with_suffix(path.suffix).as_posix()
    if path.stem == "__init__":
        source = Path(*loaded.__module__.split("."), path.name).as_posix()
    return UserClass(name, loaded, {source: digest}, (path.resolve(),))


def _distribution_of(module: str) -> str | None:
    """Return name and version of the installed package that has a module, if any says so.

    ``importlib.metadata.packages_distributions`` takes a second to parse the lists of all files.
    """
    import importlib.metadata

    top = module.partition(".")[0]
    files = re.compile(rf"^{top}(/|\.[^/]*,)", re.MULTILINE)
    for distribution in importlib.metadata.distributions():
        names = (distribution.read_text("top_level.txt") or "").split()
        if top in names or files.search(distribution.read_text("RECORD") or ""):
            return f"{distribution.name} {distribution.version}"
    return None


# --- both ---


def _imported(name: str, folder: Path | None) -> ModuleType:
    try:
        return importlib.import_module(name)
    except OtherSource:
        raise
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise _not_importable(name, error) from error
        raise UsageError(_no_module(name, folder)) from error
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        raise _not_importable(name, error) from error


def _not_importable(name: str, error: BaseException) -> UsageError:
    return UsageError(f"{name!r} cannot be imported: {in_words(error)}")


def _no_module(name: str, folder: Path | None) -> str:
    if folder is None:
        return f"no module {name!r} on sys.path; install its package"
    known = [module.name for module in pkgutil.iter_modules([str(folder)])]
    there = nearest(name, known) if known else "the folder has no modules"
    return f"no module {name!r} in {folder} or on sys.path; {there}"


def _class_in(module: ModuleType, name: str) -> type:
    try:
        candidate = getattr(module, name)
    except AttributeError as error:
        classes = []
        for key, value in vars(module).items():
            if isinstance(value, type) and value.__module__ == module.__name__:
                classes.append(key)
        text = f"{module.__name__!r} has no class {name!r}; {nearest(name, classes)}"
        raise UsageError(text) from error
    if not isinstance(candidate, type):
        raise UsageError(
            f"{f'{module.__name__}:{name}'!r}: expected a class, got a {type(candidate).__name__}"
        )
    return candidate


def in_words(error: BaseException) -> str:
    """Return what an error of a user's code says, and where it was raised."""
    name = type(error).__name__
    # What is compiled from a string has no file; whoever compiled it has one.
    if isinstance(error, SyntaxError) and not str(error.filename).startswith("<"):
        return f"{name}: {error.msg} ({error.filename}, line {error.lineno})"
    text = f"{name}: {error}" if str(error) else name
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{text} ({last.filename}, line {last.lineno})"


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
