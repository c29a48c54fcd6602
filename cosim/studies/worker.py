"""A worker: a child process that does what its parent asks, one thing after the other.

The parent writes pickles to a socket: where to import from, the subject, then functions and members
of it, in pairs. What comes of opening the subject and of each pair goes back behind a mark and its
length, by which the parent tells it from what foreign code writes there.
"""

from __future__ import annotations

import os
import pickle
import socket
import struct
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from cosim.errors import ChangedFileError, CosimError, RunError, UsageError
from cosim.processes import describe_exit, end_with_parent, leave_no_core

MARK: Final = b"cosim reply\0"
HEAD: Final = struct.Struct(f"<{len(MARK)}sQ")
SOCKET_LOST: Final = 113  # exit code: the parent, or a member, closed the socket
DONE: Final = "done"  # with a value
LOST: Final = "lost"  # with a reason: the member ended, or would have ended, this process
REFUSED: Final = "refused"  # with a class of error and its text: nothing can be run


def answer(work: Callable[[], Any]) -> bytes:
    """Do some work; return what there is to say of it, as it goes through the socket."""
    try:
        return _packed(DONE, work())
    except ChangedFileError as error:  # the parent adds the way out, in its language
        return _packed(REFUSED, ChangedFileError, error.problem)
    except CosimError as error:
        return _packed(REFUSED, UsageError if error.exit_code == 2 else RunError, str(error))
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
        return _packed(LOST, describe_exit(code))
    except BaseException as error:
        return _packed(LOST, f"{type(error).__name__}: {error}".removesuffix(": "))


def _packed(*reply: Any) -> bytes:
    content = pickle.dumps(reply, pickle.HIGHEST_PROTOCOL)
    return HEAD.pack(MARK, len(content)) + content


def serve(parent: socket.socket) -> None:
    """Answer requests until the socket is closed."""
    requests = parent.makefile("rb")
    sys.path[:] = pickle.load(requests)
    from cosim.studies import members

    subject = pickle.load(requests)
    parent.sendall(answer(lambda: bool(members.opened(subject))))
    try:
        while True:
            function, member = pickle.load(requests)
            parent.sendall(answer(partial(function, subject, member)))
    finally:
        members.close()


def main(number: int) -> None:
    """Serve; nothing else is done at the end, as what a member left behind might hang there."""
    end_with_parent()
    leave_no_core()
    parent = socket.socket(fileno=number)  # what a member starts does not keep it open
    parent.set_inheritable(False)
    try:
        serve(parent)
    except (OSError, EOFError):
        os._exit(SOCKET_LOST)


if __name__ == "__main__":
    main(int(sys.argv[1]))
