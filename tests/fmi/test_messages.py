"""What an FMU logs is taken in C: formatted, bounded, from any thread, never printed."""

import subprocess
import sys
import threading
from ctypes import c_char_p, c_double, c_int, c_void_p
from pathlib import Path

import pytest

import cosim
from cosim.errors import RunError
from cosim.fmi.binary.messages import MESSAGES, Message, Messages
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.native.library import library
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import opened, xml2

KEY = 4711


@pytest.fixture
def messages():
    messages = Messages()
    messages.accept(KEY)
    return messages


def log(status, category, form, *arguments, key=KEY):
    """Call the logger as an FMU does: with variable arguments."""
    library.cosim_log(
        c_void_p(key),
        c_char_p(b"one"),
        c_int(status),
        c_char_p(category),
        c_char_p(form),
        *arguments,
    )


def test_a_message_is_formatted_with_its_arguments(messages):
    log(0, b"logAll", b"%s: %d of %g %%", c_char_p(b"pump"), c_int(-3), c_double(2.5))
    assert messages.drain() == [Message(None, "info", "logAll", "pump: -3 of 2.5 %")]


def test_levels_are_those_of_a_log(messages):
    for status in (*range(7), -1):
        log(status, None, b"text %d", c_int(status))
    levels = ["info", "warning", "warning", "error", "fatal", "info", "warning", "warning"]
    assert messages.last_as_suffix == "; its last message: warning: text -1"
    assert [message.level for message in messages.drain()] == levels
    assert (messages.drain(), messages.last_as_suffix) == ([], "")


@pytest.mark.parametrize("form", [b"%s", b"%s %s %s %s %s %s %s %s %s %s"])
def test_long_messages_end_after_1000_bytes(messages, form):
    """Nothing beyond it is written, of the category neither."""
    log(1, b"c" * 500, form, *[c_char_p(b"x" * 5000)] * 10)
    (message,) = messages.drain()
    assert message == Message(None, "warning", "c" * 99, "x" * 1000)


def test_messages_that_are_not_utf8_are_kept(messages):
    log(3, b"\xff", b"\xff")
    log(3, b"", None)
    library.cosim_log_text(c_void_p(KEY), c_int(0), None, c_char_p(b"%s %n %d"))  # FMI 3: no format
    assert messages.drain() == [
        Message(None, "error", "\ufffd", "\ufffd"),
        Message(None, "error", "", ""),
        Message(None, "info", "", "%s %n %d"),
    ]


def test_the_last_ones_are_kept_and_the_others_counted(messages):
    for i in range(MESSAGES + 3):
        log(0, b"", b"%d", c_int(i))
    drained = messages.drain()
    assert drained[0] == Message(None, "warning", "", "3 earlier messages of the FMU were dropped")
    assert [message.text for message in drained[1:]] == [str(i) for i in range(3, MESSAGES + 3)]
    log(0, b"", b"new")
    assert [message.text for message in messages.drain()] == ["new"]


def test_messages_reach_who_accepts_their_key(messages):
    """An unknown key belongs to an FMU of FMI 1.0 that is being instantiated, or to nobody."""
    other = Messages()
    other.accept(None)
    log(0, b"", b"unknown", key=KEY + 1)
    assert [message.text for message in other.drain()] == ["unknown"]
    other.accept(KEY + 1)
    for key in (KEY, KEY + 1, KEY + 2):
        log(0, b"", b"%d", c_int(key), key=key)
    assert [message.text for message in messages.drain()] == ["4711"]
    assert [message.text for message in other.drain()] == ["4712"]
    del other
    log(0, b"", b"gone", key=KEY + 1)


def test_a_message_has_the_time_at_which_it_came(messages):
    """None before the initialization; dropped messages are counted at the first one left."""
    log(0, b"", b"early")
    for k in range(MESSAGES + 2):
        messages.clock.value = 0.5 * k
        log(0, b"", b"%d", c_int(k))
        if k == 1:
            assert [(m.time, m.text) for m in messages.drain()] == [
                (None, "early"),
                (0.0, "0"),
                (0.5, "1"),
            ]
    log(0, b"", b"again")
    drained = messages.drain()
    assert drained[0] == Message(1.5, "warning", "", "1 earlier messages of the FMU were dropped")
    assert [(m.time, m.text) for m in drained[1:-1]] == [
        (0.5 * k, str(k)) for k in range(3, MESSAGES + 2)
    ]
    assert (drained[-1].time, drained[-1].text) == (messages.clock.value, "again")


def test_messages_from_other_threads(messages):
    """Every message is kept or counted.

    ctypes releases Python's lock in the call, so the threads do run at once.
    """
    threads = [
        threading.Thread(target=lambda i=i: [log(0, b"", b"%d", c_int(i)) for _ in range(2000)])
        for i in range(4)
    ]
    for thread in threads:
        thread.start()
    drained = []
    while any(thread.is_alive() for thread in threads):
        drained += messages.drain()
    drained += messages.drain()
    dropped = [int(text.split()[0]) for *_, text in drained if "dropped" in text]
    kept = [text for *_, text in drained if "dropped" not in text]
    assert set(kept) <= {"0", "1", "2", "3"}
    assert len(kept) + sum(dropped) == 8000


def test_an_fmu_hands_over_its_messages(exported, capfd):
    """The FMU logs a refused call; the second time there is nothing new; nothing is printed."""
    with load(exported, FmuOptions(interface_type="cs")) as fmu:
        assert fmu.drain() == []
        with pytest.raises(
            RunError, match="its last message: error: call not allowed in this mode"
        ):
            fmu._instance.do_step(0.0, 0.1)
        ((_, level, _, text),) = fmu.drain()
        assert (level, text) == ("error", "call not allowed in this mode")
        assert fmu.drain() == []
    assert capfd.readouterr() == ("", "")


def test_two_instances_keep_their_messages_apart(probe2, probe3):
    with (
        opened(probe2, interface_type="cs") as (first, first_instance),
        opened(probe3, interface_type="cs") as (second, second_instance),
    ):
        first_instance.get_fmu_state()
        assert second.drain() == []
        second_instance.get_fmu_state()
    expected = [
        Message(None, "info", "probe", "allocated a state"),
        Message(None, "info", "probe", "freed"),
    ]
    assert first.drain() == expected
    assert second.drain() == expected


@pytest.mark.parametrize("probe", ["probe2", "probe3"])
def test_the_time_is_that_of_the_simulation(probe, request):
    """The time is that of the initialization, of ``set_time``, or of the begin of the step.

    The probe logs that it allocates a state.
    """

    def logged_at(fmu, instance):
        instance.get_fmu_state()
        (message,) = fmu.drain()
        assert message.text == "allocated a state"
        return message.time

    path = request.getfixturevalue(probe)
    with opened(path, interface_type="me") as (fmu, instance):
        assert logged_at(fmu, instance) is None
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        assert logged_at(fmu, instance) == 2.0
        instance.exit_initialization_mode()
        instance.set_time(2.5)
        assert logged_at(fmu, instance) == 2.5
    with opened(path, interface_type="cs") as (fmu, instance):
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        instance.do_step(2.0, 0.5)
        assert logged_at(fmu, instance) == 2.0
        instance.do_step(2.5, 0.5)
        assert logged_at(fmu, instance) == 2.5


def test_the_time_is_that_of_the_simulation_in_fmi_1(slave1):
    with opened(slave1) as (fmu, instance):
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        assert [(message.time, message.text) for message in fmu.drain()] == [
            (None, "hello world"),
            (2.0, "x = 0"),
        ]
        instance.do_step(2.5, 0.5)
        log(0, b"", b"in the step", key=fmu._instance.messages._struct.key)
        assert [message.time for message in fmu.drain()] == [2.5]


@pytest.mark.parametrize("block", [1000, 7, 1])
def test_messages_have_the_time_in_the_log_at_which_they_came(tmp_path, block):
    """Messages keep their time and their order, however long the block.

    The FMU logs where each of its steps begins.
    """
    fmu = compile_fmu(tmp_path / "model.fmu", xml2(), "probe2.c", defines=("SAYS",))
    scenario = write(tmp_path, fmu, stop=0.9)
    log = cosim.run(scenario, out=tmp_path / "one.mcap", block=block)
    recorded = [message for message in log.messages() if message.text.startswith("step: ")]
    begins = [float(message.text.removeprefix("step: ")) for message in recorded]
    assert [message.time_ns for message in recorded] == [100_000_000 * k for k in range(9)]
    assert begins == [k / 10 for k in range(9)]


def write(folder, fmu, *, stop=0.1):
    """Write a scenario of one FMU with one input, u."""
    path = folder / "one.toml"
    path.write_text(f"""
[scenario]
name = "one"
stop = {stop}
step = 0.1
[components.plant]
kind = "fmu"
interface_type = "cs"
path = "{fmu}"
[components.u]
kind = "constant"
value = 3.0
[connections]
"plant.u" = "u.y"
""")
    return path


def test_messages_come_into_the_log_with_their_category(tmp_path, slave1):
    log = cosim.run(write(tmp_path, slave1), out=tmp_path / "one.mcap")
    recorded = [(m.time_ns, m.level, m.source, m.text) for m in log.messages()]
    assert (0, "info", "plant", "probe: hello world") in recorded
    assert (0, "info", "plant", "probe: x = 3") in recorded


@pytest.mark.parametrize("name", ["slave1", "probe2"])
def test_nothing_is_printed_where_fmpy_has_no_logger(request, name):
    """Its import and its declarations say so on stdout, which carries our data: none is used."""
    path = request.getfixturevalue(name)
    lines = [
        "import sys",
        "sys.modules['fmpy.logging'] = None",
        "from cosim.fmi.component import load",
        f"load({str(path)!r}).close()",
        "assert 'fmpy' not in sys.modules",
    ]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


@pytest.mark.slow
def test_an_export_and_its_check_do_not_import_fmpy(tmp_path):
    """They take headers and schemas from its folder; its import may print on stdout."""
    lines = [
        "import sys",
        "from cosim.fmi import check, export",
        "from tests.fmi.plant import model",
        f"path = export(model(), {str(tmp_path / 'plant.fmu')!r}, name='plant').path",
        "check(path)",
        "assert 'fmpy' not in sys.modules",
    ]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
