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
import importlib.metadata
import importlib.util
import pkgutil
import re
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
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


# of folders: the module of a folder and a name, with the hashes of all files that this took
_of_folders: Final[dict[tuple[Path, str], tuple[ModuleType, Mapping[Path, str]]]] = {}
_of_ordinary: Final[WeakKeyDictionary[type, str]] = WeakKeyDictionary()  # hashes at first sight


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
    module_name, _, class_name = name.partition(":")
    top = module_name.partition(".")[0]
    if top in sys.stdlib_module_names or top == "__main__":
        raise UsageError(
            f"{quoted(name)}: expected a module of your own, got {top!r}, a module of Python"
        )
    with _lock:
        importlib.invalidate_caches()  # a file may be younger than the listing of its folder
        finder = None if folder is None else _FolderFinder(folder, needed)
        if finder is None or not finder.has(module_name):
            if needed is not None and module_name not in sys.modules:
                _check_ordinary(module_name, needed)
            user_class = _ordinary_class(name, module_name, class_name, folder)
            package = distribution or _distribution_of(module_name)
            return replace(user_class, distribution=package)
        key = (finder.folder, module_name)
        if key not in _of_folders or not _are_current(_of_folders[key][1]):
            _of_folders[key] = finder.imported(module_name)
        module, hashes = _of_folders[key]
    sources = {}
    for path, digest in hashes.items():
        sources[path.relative_to(finder.folder).as_posix()] = digest
    return UserClass(name, _class_in(module, class_name), sources, tuple(hashes))


# --- modules of a folder ---


def _are_current(hashes: Mapping[Path, str]) -> bool:
    """Return whether files are those that were imported."""
    try:
        return all(_hash(path.read_bytes()) == digest for path, digest in hashes.items())
    except OSError:
        return False


class _HashingLoader(SourceFileLoader):
    """Compiles a file anew from the bytes that it hashes."""

    def __init__(self, name: str, path: str, finder: _FolderFinder) -> None:
        super().__init__(name, path)
        self._finder = finder

    def get_code(self, fullname: str) -> CodeType:
        """Return the code of the module; raise OtherSource if it is not the one that is needed."""
        source = self.get_data(self.path)
        path = Path(self.path)
        digest = _hash(source)
        file = path.relative_to(self._finder.folder).as_posix()
        needed = self._finder.needed
        if needed is not None and needed.get(file) != digest:
            raise OtherSource(file, digest)
        self._finder.hashes[path] = digest
        code: CodeType = self.source_to_code(source, self.path)
        return code


class _FolderFinder(MetaPathFinder):
    """Finds modules in a folder.

    Attributes
    ----------
    folder : Path
    needed : mapping of file name to str, or None
        The SHA-256 that these have to have; None: anything.
    hashes : dict of Path to str
        The SHA-256 of every file that was imported, the first one first.
    """

    def __init__(self, folder: Path, needed: Mapping[str, str] | None) -> None:
        self.folder = folder.resolve()
        self.needed = needed
        self.hashes: dict[Path, str] = {}
        self._own: dict[str, bool] = {}  # names without a dot, and whether the folder has them

    def has(self, name: str) -> bool:
        """Return whether the folder has the file of a module, whose packages are not imported."""
        *packages, last = name.split(".")
        if not self._owns(name):
            return False
        spec = PathFinder.find_spec(last, [str(self.folder.joinpath(*packages))])
        return spec is not None and spec.origin is not None

    def imported(self, name: str) -> tuple[ModuleType, Mapping[Path, str]]:
        """Import a module before all finders; return it and the hashes, and leave none behind."""
        aside = self._taken_out()
        sys.meta_path.insert(0, self)
        try:
            module = _imported(name, self.folder)
        finally:
            sys.meta_path.remove(self)
            self._taken_out()
            sys.modules.update(aside)
        path = Path(str(module.__file__))
        if path not in self.hashes:  # it was compiled before, such as a C extension
            self.hashes[path] = _hash(path.read_bytes())
        return module, self.hashes

    def _taken_out(self) -> dict[str, ModuleType]:
        """Take the modules with names of the folder out of ``sys.modules``."""
        return {name: sys.modules.pop(name) for name in list(sys.modules) if self._owns(name)}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module that the folder has; None: it is one of others."""
        if not self._owns(fullname):
            return None
        spec = PathFinder.find_spec(fullname, [str(self.folder)] if path is None else path)
        if spec is not None and spec.origin and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _HashingLoader(fullname, spec.origin, self)
        return spec

    def _owns(self, name: str) -> bool:
        """Return whether a module, or the package that it is in, is one of the folder's."""
        top = name.partition(".")[0]
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
        if ordinary is None or ordinary.origin is None:
            return True
        if spec.origin is None:  # a folder without __init__.py comes behind all others
            return False
        return Path(ordinary.origin).resolve() != Path(spec.origin).resolve()

    def _ordinary_spec(self, top: str) -> ModuleSpec | None:
        """Return what Python itself has or finds under a name."""
        if top in sys.modules:
            return getattr(sys.modules[top], "__spec__", None)
        others = [finder for finder in sys.meta_path if finder is not self]
        specs = (finder.find_spec(top, None) for finder in others)
        return next((spec for spec in specs if spec is not None), None)


# --- ordinary modules ---


def _source_name(module: str, path: Path) -> str:
    """Return how a log names the file of a module."""
    parts = Path(*module.split("."))
    source = parts / path.name if path.stem == "__init__" else parts.with_suffix(path.suffix)
    return source.as_posix()


def _check_ordinary(name: str, needed: Mapping[str, str]) -> None:
    """Raise OtherSource if a module that would be run is another one than was needed."""
    try:
        spec = importlib.util.find_spec(name)
        path = Path(str(None if spec is None else spec.origin))
        digest = _hash(path.read_bytes())
    except (ImportError, OSError):  # its import says what is wrong
        return
    source = _source_name(name, path)
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
    if digest != _of_ordinary.setdefault(loaded, digest):
        raise UsageError(
            f"{path} has changed since {quoted(name)} was imported; start a new process, or use "
            "importlib.reload"
        )
    source = _source_name(loaded.__module__, path)
    return UserClass(name, loaded, {source: digest}, (path.resolve(),))


def _distribution_of(module: str) -> str | None:
    """Return name and version of the installed package that has a module, if any says so.

    ``importlib.metadata.packages_distributions`` takes a second to parse the lists of all files.
    """
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
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        text = f"{name!r} cannot be imported: {in_words(error)}"
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{name}.".startswith(f"{missing}."):
            text = _no_module(name, folder)
        raise UsageError(text) from error


def _no_module(name: str, folder: Path | None) -> str:
    if folder is None:
        return f"no module {name!r} on sys.path; install its package"
    known = [module.name for module in pkgutil.iter_modules([str(folder)])]
    there = nearest(name, known) if known else "the folder has no modules"
    return f"no module {name!r} in {folder} or on sys.path; {there}"


def _class_in(module: ModuleType, name: str) -> type:
    candidate = getattr(module, name, None)
    if candidate is None:
        own = [value for value in vars(module).values() if isinstance(value, type)]
        classes = [value.__name__ for value in own if value.__module__ == module.__name__]
        raise UsageError(f"{module.__name__!r} has no class {name!r}; {nearest(name, classes)}")
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
