"""What members of tests do to their workers: a member's ``set["does"]`` names it."""

import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

from cosim.errors import ChangedFileError, RunError, ScenarioError
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, StudyMember, StudySubject
from cosim.studies.workers import LocalExecutor

C = ctypes.CDLL(None)
SCENARIO = 'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'
SCENARIO += 'u = { kind = "constant", value = 1.0 }\n'


def processes():
    """Return parent and group of each process that is no zombie, by its number."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, *numbers = path.read_text().rpartition(")")[2].split()[:3]
            if state != "Z":
                found[int(path.parent.name)] = tuple(map(int, numbers))
    return found


def wait_until(condition):
    """Wait for at most a minute."""
    limit = time.monotonic() + 60.0
    while not condition() and time.monotonic() < limit:
        time.sleep(0.02)
    assert condition()


def leave_a_process(exit_code, session):
    """Start one that keeps the files of this one open, perhaps in its own session, and end."""
    if os.fork() == 0:
        if session:
            os.setsid()
        time.sleep(20.0)
        os._exit(0)
    os._exit(exit_code)


def to_all_files(deed):
    """Do something to what is open besides the standard streams."""
    for number in [number for number in map(int, os.listdir("/dev/fd")) if number > 2]:
        with suppress(OSError):  # of the listing itself
            deed(number)


def print_much():
    print('("done", 1)')
    os.write(1, b"printed\n" * 1000)
    os.write(2, b"printed\n" * 1000)


def ignore_and_sleep():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(600.0)


def throw(error):
    raise error


EXITS = "ends the process with exit code"
HANGS = "hangs: did not end within 3 s"
CLOSES = "closes the pipe of its worker process"
SIGNALS = {n: getattr(signal, n) for n in ("SIGKILL", "SIGTERM", "SIGFPE", "SIGBUS")}
SIGNALS["signal 40"] = 40
# what costs a member its worker, with the reason of its failure
BAD = {
    "SIGSEGV": ("crashes: SIGSEGV", lambda: ctypes.string_at(0)),
    "abort": ("crashes: SIGABRT", os.abort),
    **{s: (f"crashes: {s}", partial(signal.raise_signal, n)) for s, n in SIGNALS.items()},
    "_exit": (f"{EXITS} 0", lambda: os._exit(0)),
    "exit of C with 0": (f"{EXITS} 0", lambda: C.exit(0)),
    "exit of C with 3": (f"{EXITS} 3", lambda: C.exit(3)),
    "sys.exit": (f"{EXITS} 3", lambda: sys.exit(3)),
    "sys.exit with a text": (f"{EXITS} 1", lambda: sys.exit("stop")),
    "sys.exit with nothing": (f"{EXITS} 0", sys.exit),
    "ValueError": ("ValueError: invalid literal for int() with base 10: 'x'", lambda: int("x")),
    "MemoryError": ("MemoryError", lambda: bytearray(1 << 62)),
    "KeyboardInterrupt": ("KeyboardInterrupt", lambda: signal.raise_signal(signal.SIGINT)),
    "BaseException": ("GeneratorExit", lambda: throw(GeneratorExit())),
    "leaves a process": (f"{EXITS} 4", lambda: leave_a_process(4, session=False)),
    "leaves a session": (f"{EXITS} 5", lambda: leave_a_process(5, session=True)),
    "closes files": (CLOSES, lambda: to_all_files(os.close)),
    "replaces files": (
        CLOSES,
        lambda: to_all_files(lambda n: os.dup2(os.open(os.devnull, os.O_RDWR), n)),
    ),
    "writes into files": (
        "writes into the pipe of its worker process",
        lambda: to_all_files(lambda n: os.write(n, b"hello\n")),
    ),
    "object": ("TypeError: cannot pickle 'generator' object", lambda: (_ for _ in ())),
    "sleep": (HANGS, lambda: time.sleep(600.0)),
    "ignores SIGTERM": (HANGS, ignore_and_sleep),
    "search in C": (HANGS, lambda: re.match("(a+)+$", "a" * 64 + "b")),  # with Python's lock
}
OTHER = {
    "starts a process": lambda: subprocess.Popen(["sleep", "600"]),
    "prints": print_much,
    "is refused": lambda: throw(ScenarioError("unknown kind 'plnat'")),
    "is an error": lambda: throw(RunError("'a.fmu' is none")),
    "finds a change": lambda: throw(ChangedFileError("a.csv has changed")),
}
DEEDS = {**OTHER, **{name: deed for name, (_, deed) in BAD.items()}}
poisoned = False


def do(subject, member):
    """Do what a member says; the metrics are what it knows of its process."""
    global poisoned
    if poisoned:
        os.abort()
    if "begun" in member.set:
        Path(member.set["begun"], str(os.getpid())).touch()
    does = member.set["does"]
    poisoned = does == "poison"
    found = DEEDS[does]() if does in DEEDS else None
    if does == "object":
        return found
    metrics = {"pid": os.getpid(), **member.set.get("metrics", {})}
    metrics |= {name: os.environ.get(name) for name in member.set.get("tells", ())}
    wall_time = member.set.get("seconds", 0.0)
    return MemberOutcome(member.number, COMPLETE, metrics=metrics, wall_time=wall_time)


def doing(number, does="nothing", **more):
    """Return a member that does something."""
    return StudyMember(number, set={"does": does, **more})


def executor(folder, workers=2, **options):
    """Return one whose subject is a scenario of a constant."""
    path = folder / "x.toml"
    path.write_text(SCENARIO)
    return LocalExecutor(StudySubject(str(path), metrics={"y": "last(u.y)"}), workers, **options)


def outcomes_of(folder, members, workers=2, **options):
    """Run members; return what came of them by number, each of which comes once."""
    with executor(folder, workers, **options) as workers:
        results = list(workers.run(members, do))
    by_number = {member.number: result for member, result in results}
    assert len(by_number) == len(results)
    assert all(result.number == number for number, result in by_number.items())
    return by_number


def failures(outcomes):
    """Return the reasons of those that failed."""
    return {number: one.reason for number, one in outcomes.items() if one.status == FAILED}
