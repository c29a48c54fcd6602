"""All problems of an FMU are found at once; foreign code runs in a child process only."""

import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import fmpy
import pytest

from cosim.errors import FmuError
from cosim.fmi import child_process
from cosim.fmi.binary.headers import built_for
from cosim.fmi.checking.binaries import machine_of, required_functions
from cosim.fmi.checking.check import check
from cosim.fmi.child_process import TrialProblem, attempt, find_rollback_problems
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.fmi.platforms import SUFFIX, folders
from cosim.fmi.reading.model_description import read
from cosim.native import build
from tests.fmi.archives import Entry, write
from tests.fmi.compiled import HERE
from tests.fmi.descriptions import FMI1, FMI3
from tests.fmi.rogues import XML, compile_rogue


@pytest.fixture
def rogue(tmp_path) -> Callable[..., Path]:
    """Compile the FMU that does one thing wrong."""

    def make(what: str, xml: str = XML, *defines: str) -> Path:
        return compile_rogue(tmp_path / "rogue.fmu", what, xml, *defines)

    return make


@pytest.fixture(autouse=True)
def nothing_left(temporary):
    """No temporary folder, no other working directory."""
    home = os.getcwd()
    yield
    assert list(temporary.iterdir()) == []
    assert os.getcwd() == home


def problems_of(path, level="error", **options):
    """Return the findings of one level as texts."""
    return [
        f"{finding.where}: {finding.text}"
        for finding in check(path, **options)
        if finding.level == level
    ]


# --- good ones ---


def test_a_good_fmu_has_no_findings(rogue):
    """Its other variants are each wrong in one way."""
    assert check(rogue("GOOD")) == ()


@pytest.mark.slow
def test_an_exported_fmu_has_no_findings(exported):
    """With both interface types."""
    assert check(exported) == ()


@pytest.mark.slow
def test_foreign_fmus_have_no_errors(foreign2, foreign3):
    """pythonfmu lists no initial unknowns: a warning; that dependencies are not known is a note."""
    assert problems_of(foreign2) == problems_of(foreign3) == []
    assert problems_of(foreign2, "warning")[0].startswith("initial unknowns: not listed: late, ")
    assert problems_of(foreign3, "warning") == []
    assert (
        "structure: the file does not say on which inputs these depend directly: y"
        in problems_of(foreign3, "note")
    )
    assert "co-simulation: needs the tool that made it, or its libraries, to run" in problems_of(
        foreign3, "note"
    )


@pytest.mark.slow
def test_output_of_a_checked_fmu_is_discarded(rogue, capfd):
    """The probe prints a hundred thousand lines on stdout."""
    assert check(rogue("LOUD")) == ()
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_files_that_an_fmu_writes_are_removed(rogue, tmp_path):
    """A trial has a working directory of its own, which goes with it."""
    assert check(rogue("LITTERS")) == ()
    assert not list(tmp_path.rglob("litter"))


# --- trials ---

RUN = "trial run, co-simulation"
BACK = "trial save and restore, co-simulation"
ROGUES = {
    "CRASH": f"{RUN}: crashes: SIGSEGV at: steps of 0.001 s",
    "EXITS": f"{RUN}: ends the process with exit code 3 at: loading and instantiating",
    "REFUSES": f"{RUN}: the binary model{SUFFIX} cannot be used: ",
    "NAN_OUTPUT": f"{RUN}: output 'y' is nan after a step",
    "OTHER_START": f"{RUN}: 'y' starts at 2; the declared start is 1 (exact)",
    "FAILS_STEP": f"{RUN}: fmi2DoStep returned 3 (error)",
    "LIES": f"{BACK}: goes back wrongly: after steps the same steps give other outputs, "
    "'y' by 1 of its change",
    "FORGETS": f"{BACK}: goes back wrongly: after steps with other inputs the same steps give "
    "other outputs",
    "REPEATS": f"{BACK}: goes back wrongly: after steps the same steps give other outputs, 'y' by",
    "CRASHES_FREE": f"{BACK}: crashes: SIGSEGV at: terminate and free",
}


@pytest.mark.fast("LIES", "EXITS")
@pytest.mark.parametrize("what", ROGUES)
def test_rogues(rogue, what):
    """What crashes, ends the process, refuses or lies is named, and this process lives on."""
    problems = problems_of(rogue(what))
    assert len(problems) == 1 + (what == "NAN_OUTPUT")  # there both outputs are
    assert problems[0].startswith(ROGUES[what])


@pytest.mark.slow
def test_an_fmu_that_takes_one_step_only_is_tried_with_that(rogue):
    """It does not say which; found among 0.1, 0.01, ... s, and said."""
    (note,) = check(rogue("ONE_STEP"))
    assert (note.level, note.where) == ("note", RUN)
    assert note.text.startswith("tried with steps of 0.1 s, as those of 0.001 s are refused: ")


def test_the_state_of_an_fmu_is_tried_with_the_step_of_the_scenario(tmp_path):
    """No other one would do: it takes steps of 0.02 s only."""
    path = compile_rogue(tmp_path / "x.fmu", "ONE_STEP", XML, "ONLY=0.02")
    with load(path) as fmu:
        assert not fmu.component.interface.rollback
        assert "fmi2DoStep returned 3 (error)" in fmu.unsaved
    with load(path, FmuOptions(step=0.02)) as fmu:
        assert fmu.component.interface.rollback


@pytest.mark.slow
def test_a_trial_of_saved_states_moves_the_inputs(rogue):
    """At rest an FMU that repeats its last step shows nothing: x' = u - x from x = u = 1."""
    at_rest = XML.replace('<Real start="0" unit="m"/>', '<Real start="1" unit="m"/>')
    (problem,) = problems_of(rogue("REPEATS", at_rest))
    assert problem.startswith(f"{BACK}: goes back wrongly: after steps with other inputs")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("REFUSES_STATE", "is declared and then refused: fmi2GetFMUstate returned 3 (error)"),
        ("REFUSES_BACK", "is declared and then refused: fmi2SetFMUstate returned 3 (error)"),
        ("NEARLY", "goes back inexactly: after steps the same steps give other outputs, 'y' by"),
    ],
)
def test_a_state_that_is_not_saved_is_a_warning(rogue, what, text):
    """All else works; in a run the state is then not saved."""
    path = rogue(what)
    assert problems_of(path) == []
    (warning,) = problems_of(path, "warning")
    assert warning.startswith(f"{BACK}: {text}")
    with load(path) as fmu:
        assert not fmu.component.interface.rollback
        assert text in " ".join(fmu.notes)


@pytest.mark.slow
def test_a_failure_at_exit_is_not_blamed_on_the_fmu(rogue):
    """It leaves a handler for the end of the process, which aborts: the trial is over by then."""
    assert check(rogue("ABORTS_LATER")) == ()


@pytest.mark.fast("me")
def test_functions_that_nobody_calls(probe1):
    """An FMU of FMI 1 that runs all the same."""
    interface_type = next(iter(read(probe1).description.capabilities))
    assert all(": missing function model_fmi" in problem for problem in problems_of(probe1))
    assert attempt("run", str(probe1), interface_type) == ()


@pytest.mark.slow
def test_an_fmu_that_hangs_is_a_finding(rogue):
    """The child is ended after the time it has."""
    assert problems_of(rogue("HANG"), timeout=3.0) == [
        f"{RUN}: hangs: did not end within 3 s, at: steps of 0.001 s"
    ]
    path = rogue("HANGS_BACK")
    assert problems_of(path, timeout=3.0) == [
        f"{BACK}: hangs: did not end within 3 s, at: going back after steps"
    ]


@pytest.mark.usefixtures("trials_in_children")
def test_whether_an_fmu_can_go_back(rogue, exported, monkeypatch):
    """Tried once for each file; inside a trial the result is yes, or it would never end."""
    good = read(exported)
    bad = read(rogue("LIES"))
    assert find_rollback_problems(good, "me") == find_rollback_problems(good, "cs") == ()
    assert find_rollback_problems(bad, "cs")[0].startswith(
        "goes back wrongly: after steps the same steps give other outputs"
    )
    monkeypatch.setattr(child_process, "attempt", lambda *_, **__: pytest.fail("tried again"))
    assert find_rollback_problems(good, "cs") == ()
    assert find_rollback_problems(bad, "cs")
    monkeypatch.setenv(child_process.CHILD_VARIABLE, "1")
    assert find_rollback_problems(bad, "cs") == ()


# --- binaries ---


def test_missing_functions_are_named(rogue):
    """All of those that the version, the interface type and the capabilities need."""
    state = 'canGetAndSetFMUstate="true"'
    more = f'{state} canSerializeFMUstate="true" providesDirectionalDerivative="true"'
    path = rogue("GOOD", XML.replace(state, more), "WITHOUT_STEP")
    names = (
        "DoStep",
        "SerializedFMUstateSize",
        "SerializeFMUstate",
        "DeSerializeFMUstate",
        "GetDirectionalDerivative",
    )
    problems = problems_of(path)
    assert problems[:-1] == [
        f"binary, co-simulation: missing function fmi2{name}" for name in names
    ]
    assert problems[-1].startswith(f"{RUN}: the binary model{SUFFIX} cannot be used: ")


def test_functions_of_every_version():
    """The names that the headers of the standard have."""
    headers = Path(fmpy.__file__).parent / "c-code"
    known = "".join((headers / f"fmi{n}Functions.h").read_text() for n in (1, 2, 3)).replace(
        "fmi1", "one_fmi"
    )
    for xml in (
        FMI1.replace("{implementation}", ""),
        FMI1.replace("{implementation}", "<Implementation/>"),
        XML,
        FMI3,
    ):
        description = _described(xml)
        for interface_type in description.capabilities:
            names = required_functions(description, interface_type)
            assert [name for name in names if name not in known] == []


def _described(xml):
    from xml.etree.ElementTree import fromstring

    from cosim.fmi.reading.archive import ArchiveContents
    from cosim.fmi.reading.markup import Attributes
    from cosim.fmi.reading.model_description import describe_root

    contents = ArchiveContents("", frozenset(), {})
    description, _ = describe_root(fromstring(xml), contents, "x", Attributes())
    return description


def test_a_library_that_is_missing_is_named(rogue, tmp_path):
    """A binary that needs another one, which is not there."""
    needed = tmp_path / "needed"
    needed.mkdir()
    (tmp_path / "needed.c").write_text("int needed(void) { return 1; }")
    build.compile_library([tmp_path / "needed.c"], needed / "libneeded.so")
    path = rogue("GOOD")
    library = tmp_path / f"rogue{SUFFIX}"
    options = [
        f"-I{HERE.parents[0]}",
        f"-I{Path(fmpy.__file__).parent / 'c-code'}",
        "-DROGUE=GOOD",
        "-Wl,--no-as-needed",
    ]
    build.compile_library([HERE / "rogue2.c"], library, [*options, f"-L{needed}", "-lneeded"])
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", XML)
        archive.write(library, f"binaries/{folders('2.0')[0]}/model{SUFFIX}")
    shutil.rmtree(needed)
    problems = problems_of(path)
    assert len(problems) == 1
    assert problems[0].startswith(
        "binary, co-simulation: cannot be loaded: libneeded.so: cannot open shared object file"
    )


def head(file_format, machine):
    """Return the first bytes of a shared library."""
    if file_format == "elf":
        object_type = (3).to_bytes(2, "little")
        return b"\x7fELF\2\1\1" + bytes(9) + object_type + machine.to_bytes(2, "little")
    if file_format == "pe":
        start = (64).to_bytes(4, "little")
        return b"MZ" + bytes(58) + start + b"PE\0\0" + machine.to_bytes(2, "little")
    return b"\xcf\xfa\xed\xfe" + machine.to_bytes(4, "little")


def test_binaries_of_other_machines_are_recognized(subtests):
    """The first bytes of ELF, PE and Mach-O."""
    for content, machine in [
        (head("elf", 62), ("x86_64", "linux")),
        (head("elf", 183), ("aarch64", "linux")),
        (head("elf", 3), ("x86", "linux")),
        (head("elf", 999), ("machine 999", "linux")),
        (head("pe", 0x8664), ("x86_64", "windows")),
        (head("pe", 0xAA64), ("aarch64", "windows")),
        (head("mach", 0x1000007), ("x86_64", "darwin")),
        (head("mach", 0x100000C), ("aarch64", "darwin")),
        (b"\xca\xfe\xba\xbe" + bytes(8), ("any", "darwin")),
        (b"MZ" + bytes(100), None),
        (b"\x7fELF\2\1\1" + bytes(30), None),  # no shared library
        (b"#!/bin/sh", None),
        (b"", None),
    ]:
        with subtests.test(content=content):
            assert built_for(content) == machine


def test_folders_of_binaries():
    assert machine_of("linux64") == machine_of("x86_64-linux") == ("x86_64", "linux")
    assert machine_of("aarch64-darwin") == ("aarch64", "darwin")
    assert machine_of("x86-windows") == machine_of("win32") == ("x86", "windows")
    assert machine_of("c-code") is None


def test_binaries_in_the_wrong_place(tmp_path):
    """Each is compared with its folder; an error only where it concerns this machine."""
    mine = folders("2.0")[0]
    members = {
        f"{mine}/model{SUFFIX}": head("elf", 183 if "64" in mine else 62),
        "win64/model.dll": head("elf", 62),
        "darwin64/model.dylib": b"#!/bin/sh",
        "win32/other.dll": head("pe", 0x14C),
        "plan9/model.so": b"",
    }
    path = write(
        tmp_path / "x.fmu",
        [Entry(f"binaries/{k}", v) for k, v in members.items()],
        xml=XML.encode(),
    )
    assert problems_of(path) == [
        f"binary: binaries/{mine}/model{SUFFIX} is for aarch64-linux; expected x86_64-linux"
    ]
    assert problems_of(path, "warning") == [
        "binary: binaries/darwin64/model.dylib is no shared library",
        "binary: binaries/plan9 is no platform of the standard",
        "binary: binaries/win32/model.dll is missing",
        "binary: binaries/win64/model.dll is for x86_64-linux; expected x86_64-windows",
    ]


def test_no_binary_for_this_machine(tmp_path):
    path = write(
        tmp_path / "x.fmu",
        [Entry("binaries/win64/model.dll", head("pe", 0x8664))],
        xml=XML.encode(),
    )
    (problem,) = problems_of(path)
    assert problem.startswith("binary: none for this machine (x86_64-linux); available: win64; it")


def test_a_trial_that_cannot_be(tmp_path):
    """What Python raises in the child is a problem."""
    assert attempt("run", str(tmp_path / "no.fmu"), "cs") == (
        TrialProblem(f"{tmp_path / 'no.fmu'}: there is no such file"),
    )
    assert attempt("run")[0].text.startswith("TypeError: ")


# --- the description ---

FINDINGS = [
    ('start="2" min="0"', 'start="nan" min="0"', "error",
     "XML: variable 'k': start: expected a number, got nan"),
    ('start="2" min="0"', 'start="7" min="0"', "error",
     "variable 'k': start value: expected 0 to 5, got 7"),
    ('start="2" min="0" max="5"', 'start="2" min="4" max="1"', "error",
     "variable 'k': min 4 is above max 1"),
    ('<Real start="2" ', "<Real ", "error",
     "variable 'k': has no start value, which causality parameter with initial exact needs"),
    ('<Real start="0" ', "<Real ", "error",
     "variable 'u': has no start value, which causality input with initial exact needs"),
    ('declaredType="Mode"', 'declaredType="None"', "error",
     "variable 'mode': declaredType 'None' is not defined"),
    ('declaredType="Mode" start="3"', 'declaredType="Mode" start="2"', "error",
     "variable 'mode': start value: expected one of 1, 3, got 2"),
    ('initial="exact"', 'initial="calculated"', "warning",
     "variable 'y': has a start value, which nothing uses: it is calculated"),
    ('causality="parameter" variability="fixed"><Real',
     'causality="parameter" variability="discrete"><Real', "error",
     "variable 'k': causality parameter, variability discrete and initial exact do not go "
     "together"),
    ('causality="input">', 'causality="input" variability="fixed">', "error",
     "variable 'u': causality input, variability fixed and initial exact do not go together"),
    ('causality="input">', 'causality="input" initial="approx">', "warning",
     "variable 'u': has the attribute initial, which causality input must not have"),
    ('variability="fixed">\n', 'variability="continuous">\n', "warning",
     "variable 'mode': variability continuous, which a variable of type Enumeration cannot have"),
    ('nominal="2"', 'nominal="0"', "warning",
     "variable 'z': nominal: expected a finite number > 0, got 0"),
    ('nominal="2"', 'nominal="-2"', "warning",
     "variable 'z': nominal: expected a finite number > 0, got -2"),
    ('unit="m"', 'unit="km"', "warning",
     "variable 'u': unit 'km' is not defined in UnitDefinitions; it is understood by its name"),
    ('unit="m"', 'unit="m" displayUnit="mm"', "warning",
     "variable 'u': displayUnit 'mm' is not defined in unit 'm'"),
    ('<Unknown index="2" dependencies=""/>', "", "warning",
     "outputs: not listed: y"),
    ('<Unknown index="2" dependencies=""/>', '<Unknown index="2"/><Unknown index="3"/>', "warning",
     "outputs: listed, and no output: k"),
    ('<Unknown index="2" dependencies=""/>', '<Unknown index="2"/><Unknown index="2"/>', "warning",
     "outputs: listed twice: y"),
    ('dependencies="1" ', "", "warning",
     "outputs: dependenciesKind needs as many entries as dependencies"),
    ('dependenciesKind="dependent"', 'dependenciesKind="dependent fixed"', "warning",
     "outputs: dependenciesKind needs as many entries"),
    ('dependencies="1" ', 'dependencies="2" ', "warning",
     "variable 'z': depends on y: neither an input, a parameter, a state nor the time"),
    ('<Unknown index="4" dependencies="1 2"/>', '<Unknown index="3"/>', "warning",
     "initial unknowns: not listed: z"),
    ('<Unknown index="4" dependencies="1 2"/>',
     '<Unknown index="4"/><Unknown index="3"/>', "warning",
     "initial unknowns: listed, although known initially: k"),
    ('guid="rogue"', 'guid="rogue" variableNamingConvention="none"', "error",
     "schema: line 2: Element 'fmiModelDescription', attribute"),
    ('name="k"', 'name="a b"', "warning",
     "variable 'a b': is no name of the structured naming convention that the file announces"),
    ('name="k"', 'name="a&#9;b"', "warning",
     "variable 'a\\tb': has a control character in its name"),
    ("<CoSimulation", "<ModelExchange modelIdentifier='../x'/><CoSimulation", "error",
     "XML: ModelExchange: modelIdentifier '../x' is no"),
    ('canGet', 'needsExecutionTool="true" canGet', "note",
     "co-simulation: needs the tool that made it, or its libraries, to run"),
    ('canGet', 'canBeInstantiatedOnlyOncePerProcess="1" canGet', "note",
     "co-simulation: can be instantiated only once in a process"),
    ('dependencies="1" dependenciesKind="dependent"', "", "note",
     "structure: the file does not say on which inputs these depend directly: z"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("before", "after", "level", "text"), FINDINGS, ids=[text[:50] for *_, text in FINDINGS]
)
def test_findings_in_a_description(tmp_path, monkeypatch, before, after, level, text):
    """Each rule of the standard on its own."""
    monkeypatch.setattr("cosim.fmi.checking.check._run_trials", lambda *_: [])
    assert before in XML
    xml = XML.replace(before, after, 1)
    xml = (
        xml.replace('guid="rogue"', 'guid="rogue" variableNamingConvention="structured"')
        if "'a b'" in text
        else xml
    )
    problems = problems_of(write(tmp_path / "x.fmu", [], xml=xml.encode()), level)
    assert [problem for problem in problems if problem.startswith(text)], problems


def test_the_pattern_for_findings_has_none(tmp_path, monkeypatch):
    """What the rules above are changed from has only no binary."""
    monkeypatch.setattr("cosim.fmi.checking.check._run_trials", lambda *_: [])
    (finding,) = check(write(tmp_path / "x.fmu", [], xml=XML.encode()))
    assert finding.text.startswith("none for this machine (x86_64-linux); available: none; it")


def test_findings_of_fmi_3(tmp_path):
    """One independent variable, own references, a start value an element, clocks in events."""
    xml = FMI3.replace('causality="independent"', 'causality="local"').replace(
        'start="1 2 3"', 'start="1 2"'
    )
    xml = xml.replace('name="small" valueReference="7"', 'name="small" valueReference="8"')
    xml = xml.replace('hasEventMode="true"', "")
    path = write(tmp_path / "x.fmu", [], xml=xml.encode())
    errors = problems_of(path)
    warnings = problems_of(path, "warning")
    assert "XML: variable 'x': has 2 start values for 3 elements" in errors
    assert (
        "variable 'large': has the value reference 8 of 'small'; FMI 3 needs one for each" in errors
    )
    assert "structure: 0 independent variables; FMI 3 needs exactly one, the time" in warnings
    assert (
        "co-simulation: clocks, which are not activated without event mode (hasEventMode): tick"
        in warnings
    )


def test_neither_interface_type(tmp_path):
    xml = XML.replace("CoSimulation ", "Neither ")
    errors = problems_of(write(tmp_path / "x.fmu", [], xml=xml.encode()))
    assert "XML: neither model exchange nor co-simulation; expected one of them" in errors


def test_all_problems_at_once(rogue):
    """Schema, structure and binary in one report, errors first."""
    xml = XML.replace('start="2" min="0"', 'start="7" min="0"').replace(
        '<Unknown index="2" dependencies=""/>', ""
    )
    xml = xml.replace('unit="m"', 'unit="km"').replace('guid="rogue"', 'guid="rogue" color="red"')
    findings = check(rogue("CRASH", xml))
    assert {finding.where for finding in findings if finding.level == "error"} == {
        "schema", "variable 'k'", RUN,
    }  # fmt: skip
    levels = [("error", "warning", "note").index(finding.level) for finding in findings]
    assert levels == sorted(levels)
    assert 1 in levels


@pytest.mark.parametrize(
    ("xml", "text"),
    [
        ("<fmi", "XML: modelDescription.xml is not well-formed: unclosed token"),
        (
            "<!DOCTYPE x><x/>",
            "XML: modelDescription.xml is not well-formed: it has a document type",
        ),
        (
            '<x fmiVersion="4"/>',
            "XML: unknown FMI version '4'; FMI 1.0, 2.0 and 3.0 are supported",
        ),
    ],
)
def test_an_unreadable_file_is_one_finding(tmp_path, xml, text):
    assert problems_of(write(tmp_path / "x.fmu", [], xml=xml.encode()))[0].startswith(text)


@pytest.mark.parametrize("name", ["x.fmu", "modelDescription.xml"])
def test_no_archive(tmp_path, name):
    """Whatever its name is, and where it holds no description."""
    (tmp_path / name).write_text("hello")
    assert problems_of(tmp_path / name)[0].startswith(
        "archive: not an FMU, as it is no zip archive"
    )
    assert problems_of(write(tmp_path / name, [], xml=None)) == [
        "archive: not an FMU, as the archive has no modelDescription.xml"
    ]
    with pytest.raises(FmuError, match=r"no\.fmu: there is no such file"):
        check(tmp_path / "no.fmu")
