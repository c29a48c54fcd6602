"""What a command imports: an import takes as long as a short run."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

LIBRARIES = {"numpy", "mcap", "isal", "zstandard", "google", "pydantic", "typer", "rich"}
THEIR_OWN = {
    "annotated_doc",  # of typer
    "annotated_types",  # of pydantic
    "click",  # of typer, before it had its own copy
    "pydantic_core",
    "shellingham",  # of typer
    "typing_extensions",  # of pydantic
    "typing_inspection",  # of pydantic
}
CODE = """
import sys
before = set(sys.modules)
from cosim.cli import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
print(*sorted(set(sys.modules) - before), file=sys.stderr)
"""


def imported(*arguments):
    """Return the modules that are loaded when a command ends, besides those of Python itself."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    modules = done.stderr.splitlines()[-1].split()
    return [name for name in modules if name.split(".")[0] not in sys.stdlib_module_names]


def test_a_run_imports_no_library_that_it_does_not_use(tmp_path):
    """No scipy, fmpy, lz4 or matplotlib, and none of the libraries' own parts for other things."""
    modules = imported("run", "academic", "--out", str(tmp_path / "a.mcap"))
    packages = {name.split(".")[0] for name in modules}
    packages -= {name for name in packages if name.startswith("_sysconfigdata")}  # of Python
    assert packages <= {"cosim", *LIBRARIES, *THEIR_OWN}
    parts = {"numpy.f2py", "numpy.random", "numpy.testing", "mcap.writer"}
    assert not parts & set(modules)


def test_a_run_imports_no_part_of_cosim_for_what_it_has_not(tmp_path):
    """No other commands, kinds or methods, no swap, no replay's verification, no export."""
    modules = imported("run", "academic", "--out", str(tmp_path / "a.mcap"))
    others = (
        "cosim.blocks.kalman_identifier",
        "cosim.blocks.pid",
        "cosim.blocks.renamed",
        "cosim.cli.logs",
        "cosim.fmi.exporting",
        "cosim.fmi.reading",
        "cosim.report.verification",
        "cosim.scenario.data_files.field_file",
        "cosim.scenario.kinds.parts",
        "cosim.scenario.kinds.compensators",
        "cosim.scenario.kinds.field_data",
        "cosim.scenario.recordings.swap_comparison",
        "cosim.theory.assessment.noise_color",
        "cosim.theory.bounded",
        "cosim.theory.compensation",
    )
    assert [name for name in modules if name.startswith(others)] == []
