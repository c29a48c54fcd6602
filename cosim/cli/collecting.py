"""The garbage collector of the command line's process.

What imports make stays, so that walking over it is in vain, and takes a tenth of a short run. The
process begins without the collector (:mod:`cosim.__main__`), and a command starts it when it has
imported what it needs.
"""

from __future__ import annotations

import gc


def start_collecting() -> None:
    """Start the garbage collector if it is off; what there is by then is never walked over."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
