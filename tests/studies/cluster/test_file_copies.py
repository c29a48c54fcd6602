"""Files of a study on a worker that does not have them."""

import hashlib
from pathlib import Path

from cosim.studies.cluster.environment import binary_folders, without_binary
from cosim.studies.cluster.file_copies import (
    has_all,
    missing_content,
    moved,
    name_copies,
    named_files,
    place_copies,
    remove_copies,
    store_content,
    with_copies,
)


def write(path, content):
    """Write a file; return its path and hash."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return str(path), hashlib.sha256(content).hexdigest()


def test_files_are_there_only_with_the_same_content(tmp_path):
    """A file of that name may be another one."""
    files = dict([write(tmp_path / "a.toml", b"a"), write(tmp_path / "b.fmu", b"b")])
    assert has_all(files)
    (tmp_path / "b.fmu").write_bytes(b"c")
    assert not has_all(files)
    (tmp_path / "b.fmu").unlink()
    assert not has_all(files)


def test_each_content_is_sent_once(tmp_path):
    """Also where two files have it, and for every study after the first."""
    worker = tmp_path / "worker"
    digest = hashlib.sha256(b"same").hexdigest()
    files = dict.fromkeys((str(tmp_path / "a.fmu"), str(tmp_path / "b.fmu")), digest)
    assert missing_content(worker, files) == [digest]
    store_content(worker, b"same")
    assert missing_content(worker, files) == []


def test_content_that_is_there_is_not_sent(tmp_path):
    """A worker copies what it has under another path of the study, or under the same."""
    worker = tmp_path / "worker"
    files = dict([write(tmp_path / "a.fmu", b"same")])
    (digest,) = files.values()
    files[str(tmp_path / "b.fmu")] = digest
    assert missing_content(worker, files) == []
    root = place_copies(worker, "study", files)
    for path in files:
        assert Path(moved(path, str(root))).read_bytes() == b"same"


def test_relative_references_hold_among_copies(tmp_path):
    """A copy stands to another as the files do."""
    worker = tmp_path / "worker"
    scenario, table = tmp_path / "x" / "s.toml", tmp_path / "y" / "t.csv"
    files = dict([write(scenario, b"../y/t.csv"), write(table, b"1,2")])
    for content in (b"../y/t.csv", b"1,2"):
        store_content(worker, content)
    root = place_copies(worker, "study", files)
    copy = Path(moved(str(scenario), str(root)))
    assert (copy.parent / copy.read_text()).read_bytes() == b"1,2"
    remove_copies(worker, "study")
    assert not root.exists()
    assert missing_content(worker, files) == []


def test_paths_in_values_become_those_of_the_copies():
    """Whole paths of known files only, with what follows them; other values stay."""
    files = {"/x/a.fmu": "", "/x/t.csv": ""}
    value = {"p": "/x/a.fmu#cs", "q": ["/x/t.csv", "/x/other.csv", "see /x/t.csv", 1.5], "n": None}
    assert with_copies(value, files, "/w/r") == {
        "p": "/w/r/x/a.fmu#cs",
        "q": ["/w/r/x/t.csv", "/x/other.csv", "see /x/t.csv", 1.5],
        "n": None,
    }


def test_a_scenario_names_the_copies_of_what_it_names(tmp_path):
    """Whole absolute paths of known files, also under a link; what follows them stays."""
    path, digest = write(tmp_path / "a.fmu", b"a")
    link = tmp_path / "link.fmu"
    link.symlink_to(path)
    files = {path: digest}
    tree = {"x": [{"path": f"{path}#cs"}, {"path": str(link)}], "y": f"{path}.csv", "z": "a.fmu"}
    named = named_files(tree, files)
    assert named == {path: path, str(link): path}
    scenario = tmp_path / "s.toml"
    scenario.write_text(f"""p = "{path}#cs"\nq = '{link}'\nr = "{path}.csv" # {path}\n""")
    name_copies(scenario, named, "/w")
    copy = moved(path, "/w")
    assert scenario.read_text() == f"""p = "{copy}#cs"\nq = '{copy}'\nr = "{path}.csv" # {path}\n"""


def test_an_fmu_needs_a_binary_for_the_platform_of_the_worker():
    """By the names of FMI 2 and those of FMI 3."""
    folders = {"a.fmu": ["linux64", "win64"], "b.fmu": ["x86_64-linux"], "c.fmu": ["x86_64-darwin"]}
    assert without_binary(folders, "linux", "x86_64") == {"c.fmu": ["x86_64-darwin"]}
    assert without_binary(folders, "linux", "aarch64") == folders
    assert list(without_binary(folders, "darwin", "x86_64")) == ["a.fmu", "b.fmu"]


def test_a_file_that_is_no_fmu_has_no_platforms(tmp_path):
    """Nor has an archive without binaries."""
    path, _ = write(tmp_path / "a.fmu", b"no archive")
    assert binary_folders([path, str(tmp_path / "b.fmu"), "x.toml"]) == {}
