"""What the optimizer makes of the kernels changes none of their bits."""

import shutil
import subprocess
import sys

import pytest

import cosim
from cosim.native import build

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc'"),
]

STOP = 8.0  # s; estimates have come by then
SCENARIOS = ("academic", "academic-noisy", "closed-loop", "compensation")
RUN = """
import sys
from cosim.native import build

build.LIBRARY = sys.argv[1]
import cosim
from cosim.native import library

assert library.library._name == sys.argv[1]
stop = {"scenario.stop": float(sys.argv[2])}
for name in sys.argv[3:]:
    print(cosim.run(name, out=f"{name}.mcap", set=stop).content_hash())
"""


def test_kernels_compiled_without_optimization_give_the_bits_of_the_shipped_library(tmp_path):
    """Logs of the shipped scenarios have one content hash at -O0 and at -O3."""
    target = tmp_path / build.LIBRARY
    sources = [build.HERE / name for name in build.SOURCES]
    build.compile_library(sources, target, ["-O0", *build.INCLUDES])
    result = subprocess.run(
        [sys.executable, "-c", RUN, target, str(STOP), *SCENARIOS],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    shipped = []
    for name in SCENARIOS:
        out = tmp_path / f"shipped-{name}.mcap"
        shipped.append(cosim.run(name, out=out, set={"scenario.stop": STOP}).content_hash())
    assert result.stdout.split() == shipped
