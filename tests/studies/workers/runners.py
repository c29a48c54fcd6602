"""Runners for tests: what a member does is its ``set["does"]``; the opening, the subject's."""

import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from cosim.errors import FmuError, ScenarioError
from cosim.studies.contracts import COMPLETE, MemberOutcome

C = ctypes.CDLL(None)


def search_in_c():
    """Keep Python's lock, and a core, in a search that backtracks without end."""
    re.match("(a+)+$", "a" * 64 + "b")


def leave_a_process():
    """Start one that keeps the files of this one open, and end."""
    if os.fork() == 0:
        time.sleep(600)
    os._exit(4)


def leave_a_session():
    """Start one that leads a session of its own and keeps the files of this one open, and end."""
    if os.fork() == 0:
        os.setsid()
        os.closerange(0, 3)
        time.sleep(20)
        os._exit(0)
    os._exit(5)


def own_descriptors():
    """Return the descriptors that are open, without the standard streams."""
    return [number for number in map(int, os.listdir("/dev/fd")) if number > 2]


def close_all_files():
    """Close all files; those of this process may have any number."""
    for descriptor in own_descriptors():
        with suppress(OSError):  # that of the listing itself
            os.close(descriptor)


def write_into_all_files():
    """Write where nobody asked for it."""
    for descriptor in own_descriptors():
        try:
            os.write(descriptor, b"hello\n")
        except OSError:
            continue


def replace_all_files():
    """Put others under the numbers of all files."""
    for descriptor in own_descriptors():
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, descriptor)


def print_much():
    """Print to the streams of Python and to the descriptors."""
    print('{"outcome": 1}')
    os.write(1, b"printed\n" * 1000)
    os.write(2, b"printed\n" * 1000)


def start_a_process():
    """Start one, and go on."""
    subprocess.Popen(["sleep", "600"])


def fill_memory():
    """Ask for more memory than any machine has."""
    bytearray(1 << 62)


DEEDS: dict[str, Callable[[], object]] = {
    "nothing": lambda: None,
    "SIGSEGV": lambda: ctypes.string_at(0),
    "abort": os.abort,
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGTERM": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "sleep": lambda: time.sleep(600),
    "search in C": search_in_c,
    "_exit": lambda: os._exit(0),
    "exit of C with 0": lambda: C.exit(0),
    "exit of C with 3": lambda: C.exit(3),
    "sys.exit": lambda: sys.exit(3),
    "sys.exit with a text": lambda: sys.exit("stop"),
    "sys.exit with nothing": sys.exit,
    "ValueError": lambda: int("x"),
    "FmuError": lambda: (_ for _ in ()).throw(FmuError("'a.fmu' is none")),
    "MemoryError": fill_memory,
    "KeyboardInterrupt": lambda: signal.raise_signal(signal.SIGINT),
    "leaves a process": leave_a_process,
    "leaves a session": leave_a_session,
    "starts a process": start_a_process,
    "prints": print_much,
    "closes files": close_all_files,
    "replaces files": replace_all_files,
    "writes into files": write_into_all_files,
}


class DoingRunner:
    """Does what a member says; its metrics are what it knows of its process."""

    def __init__(self, subject):
        self.subject = subject
        self.is_poisoned = False

    def __enter__(self):
        DEEDS[self.subject.set.get("opening", "nothing")]()
        return self

    def __exit__(self, error_type, error, trace):
        if "ended" in self.subject.set:
            Path(self.subject.set["ended"], str(os.getpid())).touch()
        DEEDS[self.subject.set.get("ending", "nothing")]()

    def run(self, member):
        """Do it."""
        if "begun" in member.set:
            Path(member.set["begun"], str(os.getpid())).touch()
        if self.is_poisoned:
            os.abort()
        does = member.set.get("does", "nothing")
        if does == "wait":
            while not Path(member.set["until"]).exists():
                time.sleep(0.01)
            does = "nothing"
        metrics = {"pid": float(os.getpid()), **member.set.get("metrics", {})}
        if does == "poison":
            self.is_poisoned = True
        elif does == "tell":
            metrics["told"] = str(os.environ.get(member.set["variable"]))
        elif does == "answer with an object":
            metrics["told"] = object()
        elif does == "answer for another":
            return MemberOutcome(member.number + 1, COMPLETE)
        elif does != "nothing":
            DEEDS[does]()
        return MemberOutcome(member.number, COMPLETE, metrics=metrics)


def open_doing(subject):
    """Open the runner above."""
    return DoingRunner(subject)


def refuse(subject):
    """Refuse the subject as a scenario with errors is refused."""
    raise ScenarioError(f"{subject.scenario}: unknown kind 'plnat'")
