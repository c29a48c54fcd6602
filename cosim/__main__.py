"""The command line: ``cosim``, or ``python -m cosim``."""

import sys

_INTERRUPTED = 130  # exit code after Ctrl-C


def main() -> None:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback."""
    try:
        from cosim.cli import main as run
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)
    run()


if __name__ == "__main__":
    main()
