"""What is no FMU, or cannot run here, is refused in one sentence and leaves nothing behind."""

import os
import zipfile

import pytest

from cosim.errors import FmuError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions

CS = "CoSimulation"


def refused(path, text, **options):
    with pytest.raises(FmuError, match=text) as error:
        load(path, FmuOptions(**options))
    assert error.value.exit_code == 2
    assert str(path) in str(error.value) or "academic" in str(error.value)


@pytest.fixture(autouse=True)
def nothing_left(temporary, capfd):
    """No temporary folder, no other working directory, nothing printed."""
    home = os.getcwd()
    yield
    assert list(temporary.iterdir()) == []
    assert os.getcwd() == home
    assert capfd.readouterr() == ("", "")


def archive(path, content):
    with zipfile.ZipFile(path, "w") as target:
        for name, text in content.items():
            target.writestr(name, text)
    return path


def test_missing_file(tmp_path):
    refused(tmp_path / "no.fmu", "there is no such file")


def test_folder(tmp_path):
    refused(tmp_path, "expected an .fmu file, got a folder")


def test_no_zip(tmp_path):
    path = tmp_path / "text.fmu"
    path.write_text("hello")
    refused(path, "not an FMU, as it is no zip archive")


def test_no_description(tmp_path):
    refused(
        archive(tmp_path / "x.fmu", {"readme.txt": ""}),
        "not an FMU, as the archive has no modelDescription.xml",
    )


def test_broken_xml(tmp_path):
    refused(
        archive(tmp_path / "x.fmu", {"modelDescription.xml": "<fmi"}),
        "modelDescription.xml is not well-formed",
    )


@pytest.mark.parametrize("encoding", ["klingon", "utf-7"])
def test_xml_in_an_unknown_encoding(tmp_path, encoding):
    path = archive(
        tmp_path / "x.fmu",
        {"modelDescription.xml": f'<?xml version="1.0" encoding="{encoding}"?><fmi/>'},
    )
    refused(path, "modelDescription.xml is not well-formed: ")


def overwritten(path, where, content):
    """Change bytes of a file."""
    data = bytearray(path.read_bytes())
    data[where : where + len(content)] = content
    path.write_bytes(data)
    return path


def test_encrypted_entry(tmp_path):
    """Bit 0 of the flags, in the local header and in the central directory."""
    path = archive(tmp_path / "x.fmu", {"modelDescription.xml": "<fmi/>"})
    central = path.read_bytes().index(b"PK\x01\x02")
    refused(
        overwritten(overwritten(path, 6, b"\x01"), central + 8, b"\x01"),
        r"x\.fmu: the archive has an encrypted entry: 'modelDescription.xml'",
    )


@pytest.mark.parametrize(
    ("method", "reason"),
    [(zipfile.ZIP_STORED, "BadZipFile: Bad CRC-32"), (zipfile.ZIP_DEFLATED, "error: Error -3")],
)
def test_damaged_description(tmp_path, method, reason):
    """A stored entry fails by its sum, a compressed one by its code."""
    path = tmp_path / "x.fmu"
    with zipfile.ZipFile(path, "w") as target:
        target.writestr("modelDescription.xml", "<fmi/>" * 100, method)
    refused(
        overwritten(path, 30 + len("modelDescription.xml"), b"\xff" * 4),
        f"the archive cannot be unpacked: {reason}",
    )


def test_damaged_binary(edited, exported):
    """Found when it is unpacked; nothing is left behind."""
    path = edited()
    with zipfile.ZipFile(path) as source:
        binary = next(
            entry for entry in source.infolist() if entry.filename.startswith("binaries/")
        )
    refused(
        overwritten(path, binary.header_offset + 100, b"\xff" * 4),
        "the archive cannot be unpacked: BadZipFile: Bad CRC-32",
    )


def test_entries_that_lead_out_of_the_archive(edited, tmp_path, subtests):
    for name, text in [
        ("/etc/evil", "an entry with an absolute path: '/etc/evil'"),
        ("\\\\evil", "an entry with an absolute path: "),
        ("C:/evil", "an entry with an absolute path: 'C:/evil'"),
        ("resources/../../evil", r"an entry that leads out of it: 'resources/\.\./\.\./evil'"),
        ("..\\evil", "an entry that leads out of it: "),
    ]:
        with subtests.test(name=name):
            refused(edited(extra={name: b"x"}), f"the archive has {text}")
            assert not [file for file in tmp_path.rglob("*") if "evil" in file.name]


def test_links(tmp_path, edited):
    with zipfile.ZipFile(path := edited(), "a") as target:
        link = zipfile.ZipInfo("resources/link")
        link.create_system = 3
        link.external_attr = 0o120777 << 16
        target.writestr(link, "/etc/passwd")
    refused(
        path, "the archive has a link, where it may have files and folders only: 'resources/link'"
    )


def test_too_many_entries(edited):
    refused(
        edited(extra={f"resources/{i}": b"" for i in range(10_000)}),
        r"the archive has 100\d\d entries; expected at most 10000",
    )


def test_too_large(edited):
    """The size that an entry declares is enough."""
    path = edited(extra={"resources/bomb": b"x"})
    data = path.read_bytes()
    central = data.rindex(b"PK\x01\x02")  # the last entry
    refused(
        overwritten(path, central + 24, (2**30).to_bytes(4, "little")),
        r"unpacked, the archive would have 107\d{7} bytes; expected at most 1073741824",
    )


@pytest.mark.parametrize("version", ['fmiVersion="4.0"', ""])
def test_unknown_version(tmp_path, version):
    path = archive(
        tmp_path / "x.fmu", {"modelDescription.xml": f"<fmiModelDescription {version}/>"}
    )
    refused(path, "unknown FMI version ('4.0'|None); FMI 1.0, 2.0 and 3.0 are supported")


def test_description_that_makes_no_sense(tmp_path):
    path = archive(
        tmp_path / "x.fmu", {"modelDescription.xml": '<fmiModelDescription fmiVersion="2.0"/>'}
    )
    refused(path, "modelDescription.xml: fmiModelDescription: the attribute guid is missing")


def test_no_binary_for_this_platform(edited):
    path = edited(without="binaries/", extra={"binaries/riscv64-plan9/academic.so": b""})
    refused(
        path,
        r"no binary for this platform; found binaries for: riscv64-plan9; "
        r"expected binaries/\S+/academic\.",
    )


def test_an_interface_type_that_is_not_there(edited):
    path = edited(("<ModelExchange ", "<Unknown "), ("</ModelExchange>", "</Unknown>"))
    refused(
        path,
        r'not for model exchange \(interface_type = "me"\); '
        'it is for co-simulation: interface_type = "cs"',
        interface_type="me",
    )
    refused(path, 'interface_type: expected "me" or "cs", got \'both\'', interface_type="both")
    with load(path) as fmu:
        assert fmu.interface_type == "cs"


def test_wrong_identifier(edited):
    refused(
        edited(('modelIdentifier="academic"', 'modelIdentifier="../x"')),
        r"modelIdentifier '\.\./x' is no name of a file \(no path, at most 200 bytes\)",
    )


def test_binary_that_is_none(edited, exported):
    with zipfile.ZipFile(exported) as source:
        binary = next(name for name in source.namelist() if name.startswith("binaries/"))
    refused(
        edited(without="binaries/", extra={binary: b"not a library"}),
        r"the binary academic\S+ cannot be used: .*file too short",
    )


def test_binary_of_another_model(edited):
    refused(
        edited(('guid="{', 'guid="{0')),
        "cannot be used: it refuses to instantiate; "
        "its last message: error: fmi2Instantiate: the GUID",
    )


@pytest.mark.parametrize(
    ("start", "text"),
    [
        ({"x_a[9]": 1.0}, r"no variable 'x_a\[9\]'; did you mean 'x_a\[\d\]'"),
        (
            {"y": 1.0},
            "'y' has no start value that can be set .causality output, variability continuous, "
            "initial calculated.",
        ),
        ({"x_a[0]": float("nan")}, r"start value of 'x_a\[0\]': expected a finite number, got nan"),
    ],
)
def test_start_values(exported, start, text):
    refused(exported, text, start=start)


def test_start_value_outside_its_range(edited):
    path = edited(('<Real start="1.0" />', '<Real start="1.0" min="0" max="2.5" />'))
    refused(path, r"start value of 'x_a\[0\]': expected 0.0 to 2.5, got 3.0", start={"x_a[0]": 3.0})
    load(path, FmuOptions(start={"x_a[0]": 2.0})).close()


def test_all_wrong_start_values_are_reported_together(exported):
    with pytest.raises(FmuError, match=r"(?s)'nothing'.*'y' has no start value"):
        load(exported, FmuOptions(start={"nothing": 1.0, "y": 1.0}))


TAKEN = "euler, rk4, RK23, RK45, DOP853, Radau, BDF, LSODA, CVode"  # by an FMU


def test_solvers(exported):
    """Offered is only what an FMU takes."""
    refused(exported, f"no solver 'heun'; available: {TAKEN}$", solver="heun")
    refused(
        exported,
        "solver 'exact' needs the matrices of a linear model, an FMU does not show them; "
        f"use one of: {TAKEN}$",
        solver="exact",
    )
    refused(exported, "a co-simulation FMU brings its own", solver="rk4", interface_type="cs")
    refused(
        exported,
        "relative tolerance 1e-06: a co-simulation FMU brings its own solver",
        tolerance=1e-6,
        interface_type="cs",
    )


def test_a_unit_that_cannot_be_converted(edited, subtests):
    """A definition by a factor of 0, or by no number, says nothing."""
    for attribute, expected in [
        ('factor="0.0"', "finite number that is not 0"),
        ('factor="INF"', "finite number that is not 0"),
        ('offset="NaN"', "finite number"),
    ]:
        with subtests.test(attribute=attribute):
            base = f'<BaseUnit m="1" {attribute}/>'
            definition = f'<UnitDefinitions><Unit name="odd">{base}</Unit></UnitDefinitions>'
            path = edited(("</CoSimulation>", f"</CoSimulation>{definition}"))
            refused(path, rf"unit 'odd': {attribute.partition('=')[0]}: expected a {expected}, got")
