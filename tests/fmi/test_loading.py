"""Libraries are loaded, fail to load, and are unloaded, without a trace."""

import gc
import os
import resource
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from cosim.errors import FmuError, RunError
from cosim.fmi.binary.headers import ELF
from cosim.fmi.checking.check import check
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, folders
from cosim.native import build
from tests.fmi import small
from tests.fmi.compiled import HEADERS, HERE, compile_fmu, write_archive
from tests.fmi.probes import got, opened, put, xml1, xml2, xml3


def mapped():
    """Return the libraries of FMUs that are in memory.

    Those of pythonfmu stay there for good, as they pin themselves.
    """
    maps = Path("/proc/self/maps")
    if not maps.exists():
        return set()
    lines = maps.read_text().splitlines()
    return {line.split()[5] for line in lines if "cosim.fmu-" in line}


@pytest.fixture(autouse=True)
def nothing_left(temporary, capfd):
    """No temporary folder, no other working directory, no library in memory, nothing printed."""
    home = os.getcwd()
    before = mapped()
    yield
    assert list(temporary.iterdir()) == []
    assert os.getcwd() == home
    assert mapped() <= before
    assert capfd.readouterr() == ("", "")


def refused(path, text, **options):
    with pytest.raises(FmuError, match=text):
        load(path, FmuOptions(**options)).close()


def with_binary(path, change):
    """Write a copy of an FMU with another binary."""
    changed = path.with_name(f"changed-{path.name}")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(name, change(content) if name.startswith("binaries/") else content)
    return changed


def test_a_missing_dependency_is_named(tmp_path):
    """The binary needs libaid.so, which is not there when it is loaded."""
    (tmp_path / "aid.c").write_text("int aid(void) { return 1; }")
    aid = tmp_path / f"libaid{SUFFIX}"
    build.compile_library([tmp_path / "aid.c"], aid)
    (tmp_path / "more.c").write_text("int aid(void); int more(void) { return aid(); }")
    path = compile_fmu(tmp_path / "x.fmu", xml2(), "probe2.c", tmp_path / "more.c", aid)
    aid.unlink()
    refused(
        path,
        rf"x.fmu: the binary model\S+ cannot be used: .*libaid\{SUFFIX}: "
        "cannot open shared object file: No such file",
    )


def test_a_binary_may_open_its_neighbour_while_it_is_loaded(tmp_path):
    """By ``dlopen("./aid.so")``: the folder of the binary is the working directory meanwhile."""
    (tmp_path / "aid.c").write_text("int aid(void) { return 1; }")
    aid = tmp_path / "aid.so"
    build.compile_library([tmp_path / "aid.c"], aid)
    (tmp_path / "more.c").write_text(
        "#include <dlfcn.h>\n"
        "static void *aid;\n"
        "__attribute__((constructor)) static void load(void)\n"
        '{ aid = dlopen("./aid.so", RTLD_NOW); }\n'
        "__attribute__((destructor)) static void unload(void) { dlclose(aid); }\n"
        "int has_aid(void) { return aid != 0; }"
    )
    neighbour = {f"binaries/{folders('2.0')[0]}/aid.so": aid.read_bytes()}
    path = compile_fmu(tmp_path / "x.fmu", xml2(), "probe2.c", tmp_path / "more.c", extra=neighbour)
    before = Path.cwd()
    with opened(path) as (_, instance):
        assert instance._library._dll.has_aid() == 1
    assert Path.cwd() == before


def test_a_missing_symbol_is_named(tmp_path):
    """One that the binary itself needs, and one that the standard requires of it."""
    (tmp_path / "more.c").write_text("int nowhere(void); int more(void) { return nowhere(); }")
    refused(
        compile_fmu(tmp_path / "x.fmu", xml2(), "probe2.c", tmp_path / "more.c"),
        "cannot be used: .*undefined symbol: nowhere",
    )
    path = compile_fmu(tmp_path / "y.fmu", xml2(), "probe2.c", defines=("LACKS_RESET",))
    refused(
        path,
        r"the binary model\S+ cannot be used: it has no function fmi2Reset, "
        "which the standard requires",
    )
    path = compile_fmu(tmp_path / "z.fmu", xml2(), "probe2.c", defines=("LACKS_STATES",))
    refused(
        path,
        r"cannot be used: it has no function fmi2SetContinuousStates, which the standard requires",
        interface_type="me",
    )


def test_a_state_that_cannot_be_freed_leaves_nothing_behind(probe2, monkeypatch):
    """The instance is freed all the same, the library unloaded, the folder removed."""

    def refuse(_):
        raise RunError("fmi2FreeFMUstate returned 3 (error)")

    with opened(probe2, interface_type="cs") as (_, instance):
        instance.get_fmu_state()
        monkeypatch.setattr(instance._calls, "free_state", refuse)


def test_a_binary_for_another_machine(probe2, tmp_path):
    """The loader would call it a missing file. Byte 18 of an ELF header is the machine."""
    number, other = next((number, name) for number, name in ELF.items() if name != ARCHITECTURE)
    path = with_binary(probe2, lambda content: content[:18] + bytes([number]) + content[19:])
    refused(
        path,
        rf"the binary \S+/model\S+ is for {other}, found in the folder for {ARCHITECTURE}; "
        f"expected one for {ARCHITECTURE}",
    )


def test_an_instance_that_is_refused(tmp_path):
    """A wrong GUID or token; what the FMU logs about it is the reason."""
    for xml, source, text in [
        (
            xml2().replace('guid="probe"', 'guid="other"'),
            "probe2.c",
            "its last message: error: wrong guid other",
        ),
        (xml3(token="other"), "probe3.c", "its last message: error: wrong token %s"),
        (
            xml1().replace('guid="probe"', 'guid="other"'),
            "probe1.c",
            "its last message: info: hello world",
        ),
    ]:
        refused(
            compile_fmu(tmp_path / "x.fmu", xml, source),
            f"cannot be used: it refuses to instantiate; {text}",
        )


def test_after_the_end_no_call_reaches_the_library(probe2):
    """A bound function is gone with the library; freeing and ending twice does no harm."""
    with opened(probe2, interface_type="me") as (fmu, instance):
        state = instance.get_fmu_state()
        set_time = instance.set_time
    with pytest.raises(RunError, match="fmi2SetTime cannot be called: the instance was freed"):
        set_time(1.0)
    with pytest.raises(RunError, match="fmi2SetReal cannot be called: the instance was freed"):
        put(instance, u=1.0)
    instance.free_fmu_state(state)
    instance.terminate()
    fmu.close()


@pytest.mark.parametrize("number", [1, 2, 3])
def test_two_instances_of_one_fmu(request, slave1, number):
    """Each has its own memory, whatever the order of their ends."""
    path = slave1 if number == 1 else request.getfixturevalue(f"probe{number}")
    first = load(path, FmuOptions(interface_type="cs"))
    second = load(path, FmuOptions(interface_type="cs"))
    instances = [fmu._instance for fmu in (first, second)]
    for value, instance in enumerate(instances):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        put(instance, u=float(value))
        instance.exit_initialization_mode()
        instance.do_step(0.0, 1.0)
    first.close()
    instances[1].do_step(1.0, 1.0)
    assert got(instances[1], "u") == [1.0]
    second.close()


@pytest.mark.parametrize(
    ("xml", "source"),
    [
        (xml1(once=True), "probe1.c"),
        (
            xml2().replace(
                "<CoSimulation ", '<CoSimulation canBeInstantiatedOnlyOncePerProcess="true" '
            ),
            "probe2.c",
        ),
    ],
)
def test_an_fmu_that_can_be_here_only_once(tmp_path, xml, source):
    """Two instances at once: each has a copy of the binary, in a folder of its own."""
    path = compile_fmu(tmp_path / "x.fmu", xml, source)
    before = mapped()
    options = {"interface_type": "cs"}
    with opened(path, **options) as (first, _), opened(path, **options) as (second, _):
        assert not first.notes
        assert not second.notes
        assert len(mapped() - before) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="the linker's options are those of Linux")
def test_what_the_copies_of_a_binary_share_is_named(tmp_path):
    """The loader finds a library that a binary needs by its name, where it is in memory already."""
    (tmp_path / "needed.c").write_text("int needed;")
    needed = tmp_path / "libneeded.so"
    build.compile_library([tmp_path / "needed.c"], needed, ["-Wl,-soname,libneeded.so"])
    binary = tmp_path / "model.so"
    needs = ["-Wl,--no-as-needed", str(needed), "-Wl,-rpath,$ORIGIN"]
    sources = [HERE / "small2.c", HERE / "unused.c"]
    build.compile_library(sources, binary, [f"-I{HEADERS}", "-DFMI=2", *needs])
    folder = f"binaries/{folders('2.0')[0]}"
    members = {"modelDescription.xml": small.xml("once")}
    members |= {f"{folder}/{file.name}": file.read_bytes() for file in (needed, binary)}
    path = write_archive(tmp_path / "x.fmu", members)
    with load(path) as first, load(path) as second:
        assert not first.notes
        (note,) = second.notes
        assert note.startswith("small: can be instantiated only once per process")
        assert note.endswith("libneeded.so")
    with load(path) as third:
        assert not third.notes


def clocked(causality, **options):
    clock = (
        f'<Clock name="tick" valueReference="550" causality="{causality}" '
        'intervalVariability="triggered"/>'
    )
    return xml3(**options).replace("<ModelVariables>", f"<ModelVariables>{clock}")


def test_clocks_need_their_functions_and_event_mode(tmp_path):
    """Without event mode they are not activated in co-simulation; else a function is missing."""
    path = compile_fmu(tmp_path / "x.fmu", clocked("output"), "probe3.c")
    refused(
        path,
        "it has no function fmi3SetClock, which the standard requires",
        interface_type="me",
    )
    with opened(path, interface_type="cs") as (fmu, instance):
        assert fmu.notes[0] == (
            "probe: its clocks are not activated, as it has no event mode: tick"
        )
        assert got(instance, "event_mode") == [0.0]


def test_event_mode_that_is_declared_and_refused(tmp_path):
    """The second try is without: the run says so once, with the FMU's reason, and is right."""
    xml = xml3(event_mode=True)
    path = compile_fmu(tmp_path / "x.fmu", xml, "probe3.c", defines=("REFUSES",))
    with opened(path, interface_type="cs") as (fmu, instance):
        assert got(instance, "event_mode") == [0.0]
        (refusal,) = fmu.notes
        assert "refuses to be instantiated with event mode" in refusal
        assert refusal.endswith("error: no event mode")
        assert not fmu.component.interface.locates_events
        assert fmu.component.initialize(0.0, np.array([2.0])).tolist() == [0.0]
        rows = fmu.component.advance(np.array([0.0, 0.5, 1.0]), 0.5, np.full((3, 1), 2.0))
        assert rows.tolist() == [[1.0], [2.0]]  # x' = u


@pytest.mark.slow
def test_a_check_warns_of_event_mode_that_is_refused(tmp_path):
    """It runs without."""
    xml = xml3(event_mode=True)
    path = compile_fmu(tmp_path / "x.fmu", xml, "probe3.c", defines=("REFUSES",))
    findings = [finding for finding in check(path) if "event mode" in finding.text]
    assert [(finding.level, finding.where) for finding in findings] == [
        ("warning", "trial run, co-simulation")
    ]


def test_states_that_lie_are_not_saved(tmp_path):
    """A trial in another process finds out; the FMU runs without."""
    path = compile_fmu(tmp_path / "x.fmu", xml2(), "probe2.c", defines=("LIES",))
    with load(path, FmuOptions(interface_type="cs")) as fmu:
        assert fmu.notes[0].startswith(
            "probe: its state is not saved, although it says that it can be: goes back wrongly"
        )
        assert not fmu.description.capabilities["cs"].saves_state
        with pytest.raises(FmuError, match="the FMU cannot save its state"):
            fmu.component.save()


def test_released_states_are_used_again(probe2):
    """The memory that the FMU allocated for one copy takes the next."""

    def address(saved):
        state, _ = saved
        return state.fmu.value

    with load(probe2, FmuOptions(interface_type="cs")) as fmu:
        fmu.component.initialize(0.0, np.zeros(1))
        addresses = set()
        for _ in range(5):
            saved = fmu.component.save()
            fmu.component.restore(saved)
            addresses.add(address(saved))
            del saved
        assert len(addresses) == 1
        many = [fmu.component.save() for _ in range(10)]
        at_once = {address(saved) for saved in many}
        assert len(at_once) == 10
        del many
        assert address(fmu.component.save()) in at_once


def cycle(path, interface_type):
    """Load, run a step, free."""
    with load(path, FmuOptions(interface_type=interface_type)) as fmu:
        component = fmu.component
        component.prepare(0.1, np.zeros(1, np.bool_), {})
        component.initialize(0.0, np.zeros(1))
        component.advance(np.array([0.0, 0.1]), 0.1, np.zeros((2, 1)))


def footprint():
    """Return open file descriptors, mappings, and resident memory [bytes] of this process."""
    gc.collect()
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    return (
        len(os.listdir("/proc/self/fd")),
        len(Path("/proc/self/maps").read_text().splitlines()),
        resident,
    )


def grown(path, interface_type, *, warm_up, cycles, measure):
    for _ in range(warm_up):
        cycle(path, interface_type)
    before = measure()
    for _ in range(cycles):
        cycle(path, interface_type)
    return tuple(after - start for after, start in zip(measure(), before, strict=True))


def traced():
    """Count what Python allocated, to the byte, instead of the pages that it holds."""
    files, maps, _ = footprint()
    return files, maps, tracemalloc.get_traced_memory()[0]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts what Linux tells")
@pytest.mark.parametrize(
    ("number", "interface_type"), [(1, "me"), (1, "cs"), (2, "me"), (2, "cs"), (3, "me"), (3, "cs")]
)
def test_cycles_leave_nothing_behind(request, model1, slave1, number, interface_type):
    """5 MB in 10 000 cycles are 500 bytes in each.

    CPython keeps up to about 50 kB of small objects for the next ones, and enlarges tables that all
    modules share, such as that of interned strings, by megabytes at once: in one of three
    measurements at most, while a leak shows in each.
    """
    path = (
        {"me": model1, "cs": slave1}[interface_type]
        if number == 1
        else request.getfixturevalue(f"probe{number}")
    )
    tracemalloc.start()
    try:
        for _ in range(3):
            files, maps, memory = grown(path, interface_type, warm_up=8, cycles=50, measure=traced)
            if memory < 50 * 500 + 50_000:
                break
    finally:
        tracemalloc.stop()
    assert (files, abs(maps) <= 2) == (0, True)
    assert memory < 50 * 500 + 50_000


@pytest.mark.campaign
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts what Linux tells")
@pytest.mark.parametrize(("number", "interface_type"), [(1, "me"), (2, "cs"), (3, "cs")])
def test_ten_thousand_cycles(request, model1, number, interface_type):
    path = model1 if number == 1 else request.getfixturevalue(f"probe{number}")
    files, maps, memory = grown(path, interface_type, warm_up=100, cycles=10_000, measure=footprint)
    assert (files, abs(maps) <= 2) == (0, True)
    assert memory < 5_000_000
