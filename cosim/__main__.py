"""The command line: ``cosim``, or ``python -m cosim``."""

import gc
import os
import sys

_INTERRUPTED = 130  # exit code after Ctrl-C


def main() -> None:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback.

    Numpy's linear algebra gets one thread, unless the environment says otherwise: matrices here are
    so narrow that its threads wait for each other longer than they compute. The garbage collector
    is off until a command starts it (:mod:`cosim.cli.collecting`).
    """
    gc.disable()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from cosim.cli import main as run
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)
    run()


if __name__ == "__main__":
    main()
