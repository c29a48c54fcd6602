"""The command line: ``cosim``, or ``python -m cosim``."""

import atexit
import gc
import os
import sys

_INTERRUPTED = 130  # exit code after Ctrl-C
_LOADS_BINARIES = "cosim.fmi.binary.library"


class _LastHandler:
    """Ends the process after the exit handlers of Python, before those of loaded binaries.

    Binaries of FMUs stay loaded to the end where they pin themselves, and may crash there: those of
    pythonfmu3 use memory that they have freed. The exit code belongs to the command.
    """

    def __init__(self) -> None:
        self.exit_code: int | None = None

    def __call__(self) -> None:
        if self.exit_code is None or _LOADS_BINARIES not in sys.modules:
            return
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):  # Python says so
            return
        os._exit(self.exit_code)


def main() -> None:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback.

    Numpy's linear algebra gets one thread, unless the environment says otherwise: matrices here are
    so narrow that its threads wait for each other longer than they compute. The garbage collector
    is off until a command starts it (:mod:`cosim.cli.command`).
    """
    last_handler = _LastHandler()
    atexit.register(last_handler)  # the first to be registered is the last to be called
    gc.disable()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from cosim.cli import main as run
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)
    try:
        run()
    except SystemExit as end:
        if isinstance(end.code, int):
            last_handler.exit_code = end.code
        raise


if __name__ == "__main__":
    main()
