"""A worker: a child process that does what its parent asks, one thing after the other.

Both write pickled values to one socket, each behind a mark and its length. The first has where to
import from, the second the subject; each further one a function and a member of it.
"""

from __future__ import annotations

import os
import pickle
import struct
import sys
from collections.abc import Callable
from typing import Any, Final

from cosim.errors import ChangedFileError, CosimError, RunError, UsageError
from cosim.processes import describe_exit, end_with_parent, leave_no_core

MARK: Final = b"cosim reply\0"
HEAD: Final = struct.Struct(f"<{len(MARK)}sQ")
SOCKET_LOST: Final = 113  # exit code: the parent, or a member, closed the socket
DONE: Final = "done"  # with a value
LOST: Final = "lost"  # with a reason: the member ended, or would have ended, this process
REFUSED: Final = "refused"  # with a class of error and its text: nothing can be run


def packed(value: object) -> bytes:
    """Return a value as it goes through the socket."""
    content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    return HEAD.pack(MARK, len(content)) + content


def answer(work: Callable[[], Any]) -> bytes:
    """Do some work; return what there is to say of it, as it goes through the socket."""
    try:
        return packed((DONE, work()))
    except ChangedFileError as error:  # the parent adds the way out, in its language
        return packed((REFUSED, ChangedFileError, error.problem))
    except CosimError as error:
        return packed((REFUSED, UsageError if error.exit_code == 2 else RunError, str(error)))
    except SystemExit as error:
        code = error.code
        return packed(
            (LOST, describe_exit(code if isinstance(code, int) else int(code is not None)))
        )
    except BaseException as error:
        return packed((LOST, f"{type(error).__name__}: {error}".removesuffix(": ")))


def serve(socket: int) -> None:
    """Answer requests until the socket is closed."""
    sys.path[:] = pickle.loads(_read_packed(socket))
    from cosim.studies import members

    content = _read_packed(socket)
    opened: list[members.OpenedSubject] = []
    _write(socket, answer(lambda: opened.append(members.opened(pickle.loads(content)))))
    try:
        while True:
            request = _read_packed(socket)

            def work(request: bytes = request) -> Any:
                function, member = pickle.loads(request)
                return function(opened[0].subject, member)

            _write(socket, answer(work))
    finally:
        members.close()


def _read_packed(socket: int) -> bytes:
    return _read(socket, HEAD.unpack(_read(socket, HEAD.size))[1])


def _read(socket: int, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = os.read(socket, count - len(data))
        if not part:
            raise EOFError
        data += part
    return bytes(data)


def _write(socket: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(socket, view) :]


def main(socket: int) -> None:
    """Serve; nothing else is done at the end, as what a member left behind might hang there."""
    end_with_parent()
    leave_no_core()
    os.set_inheritable(socket, False)  # what a member starts must not keep it open
    try:
        serve(socket)
    except (OSError, EOFError):
        os._exit(SOCKET_LOST)


if __name__ == "__main__":
    main(int(sys.argv[1]))
