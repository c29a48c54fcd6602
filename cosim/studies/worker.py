"""A worker: a child process that does what its parent asks, one thing after the other.

Both write pickled values to one socket, each behind a mark and its length. The first has where to
import from, the second the subject; each further one a function and a member of it.
"""

from __future__ import annotations

import os
import pickle
import struct
import sys
from typing import Any, Final, NoReturn

from cosim.errors import ChangedFileError, CosimError, UsageError
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


def send(socket: int, data: bytes) -> None:
    """Write all of it."""
    view = memoryview(data)
    while view:
        view = view[os.write(socket, view) :]


def receive(socket: int) -> Any:
    """Read a value.

    Raises
    ------
    OSError
        If the socket is closed.
    """
    return pickle.loads(_read(socket, HEAD.unpack(_read(socket, HEAD.size))[1]))


def _read(socket: int, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = os.read(socket, count - len(data))
        if not part:
            raise EOFError("the socket is closed")
        data += part
    return bytes(data)


def answer(function: Any, *arguments: Any) -> tuple[Any, ...]:
    """Call a function, and return what there is to say of it."""
    try:
        return (DONE, function(*arguments))
    except CosimError as error:
        if isinstance(error, ChangedFileError):  # the parent adds the way out, in its language
            return (REFUSED, ChangedFileError, error.problem)
        return (REFUSED, UsageError if error.exit_code == 2 else CosimError, str(error))
    except SystemExit as error:
        code = error.code
        return (LOST, describe_exit(code if isinstance(code, int) else int(code is not None)))
    except BaseException as error:
        return (LOST, f"{type(error).__name__}: {error}".removesuffix(": "))


def main(socket: int) -> NoReturn:
    """Serve until the socket is closed."""
    end_with_parent()
    leave_no_core()
    os.set_inheritable(socket, False)  # what a member starts must not keep it open
    try:
        sys.path[:] = receive(socket)
        from cosim.studies import members

        subject = receive(socket)
        reply = answer(members.opened, subject)
        send(socket, packed((DONE, None) if reply[0] == DONE else reply))
        while True:
            function, member = receive(socket)
            reply = answer(function, subject, member)
            try:
                data = packed(reply)
            except Exception as error:  # what cannot be pickled raises anything
                data = packed((LOST, f"{type(error).__name__}: {error}"))
            send(socket, data)
    except (OSError, EOFError):
        pass
    members.close()
    os._exit(SOCKET_LOST)


if __name__ == "__main__":
    main(int(sys.argv[1]))
