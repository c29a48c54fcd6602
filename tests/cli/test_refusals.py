"""Wrong use of every command: refused before anything is read, run or written."""

import re
import shlex

import pytest

OPTIONS = {
    "run academic --dry-run --certify": "--dry-run .* --certify",
    "run academic --dry-run --find-step a.y=1": "--dry-run .* --find-step",
    "run academic --dry-run --fail-on warning": "--dry-run .* --fail-on",
    "run academic --dry-run --assert rms(a.y)<1": "--dry-run .* --assert",
    "run academic --find-step a.y=1 --step 0.1": "--find-step .* --step",
    "run academic --find-step a.y=1 --set scenario.step=0.1": "--find-step .* --set scenario.step",
    "run academic --find-step a.y=small": r"--find-step a\.y: .*'small'",
    "run academic --force": "--force .* --out",
    "run academic --rotate 1h --plot a.png": "--plot .* --rotate",
    "run academic --rotate 0.1s --rotate 2s": "--rotate: .*given 2 times",
    "run academic --rotate '1 MiBi'": "--rotate: .*'1 MiBi'",
    "run academic --port 0": "--port .* --live",
    "run academic --stop 1 --set scenario.stop=2": "--stop .* --set scenario.stop",
    "run academic --step 1 --set scenario.step=2": "--step .* --set scenario.step",
    "run academic --no-verdicts --set scenario.verdicts=false": "--no-verdicts .* --set",
    "run academic --no-verdicts --fail-on inconsistent": "omit --no-verdicts",
    "run academic --fail-on inconsistant": "did you mean 'inconsistent'",
    "run academic --assert plant.y": "expected a comparison|a reduction",
    "run academic --assert 'rms(plant.q) < 1'": "'plant' has no signal 'q'",
    "run academic --plot run.xyz": r"run\.xyz: .*'\.xyz'",
    "run academic --out a.mcap": "a.mcap exists; choose another path, or --force to replace it$",
    "run academic --rotate 0.1s --out a.mcap": r"a\.mcap exists; choose another path, or --force",
    "replay a.mcap --verify --stop 1": "--verify .* --stop$",
    "replay a.mcap --verify --set scenario.stop=0.02": "--verify .* --set scenario.stop$",
    "replay a.mcap --verify --vary a.b=1": "--verify .* --vary",
    "replay a.mcap --plot a.png --vary a.b=1": "--plot .* --vary",
    "replay a.mcap --fail-on warning --vary a.b=1": "--fail-on .* --vary",
    "replay a.mcap --assert rms(a.y)<1 --vary a.b=1": "--assert .* --vary",
    "replay a.mcap --assert rms(a.y)<1 --from 0": "--assert .* --from",
    "replay a.mcap --assert rms(a.y)<1 --to 1": "--assert .* --to",
    "replay a.mcap --scenario loop.toml": "a.mcap has its own scenario; omit --scenario",
    "replay field.mcap": "another tool and has no scenario; expected --scenario",
    "replay field.mcap --verify --scenario loop.toml --map plant.y=/drive/state.position": (
        "--verify compares with a log of cosim; field.mcap is of another tool"
    ),
    "replay part.mcap --verify": "no signal of this run's components: u, delta",
    "replay part.mcap --component observer --verify": (
        "its input 'observer.u' comes from 'u.y', which is neither computed nor recorded"
    ),
    "study academic --dry-run --fail-on warning": "--dry-run .* --fail-on",
    "study academic --dry-run --assert rms(a.y)<1": "--dry-run .* --assert",
    "study academic --dry-run --scheduler tcp://a:1": "--dry-run .* --scheduler",
    "study academic --stop 1 --set scenario.stop=2": "--stop .* --set scenario.stop",
    "study filters.toml --fail-on inconsistent": "--results",
    "tune academic --quiet": "--quiet .* --out or --json",
    "tune academic --json --stop 1 --set scenario.stop=2": "--stop .* --set scenario.stop",
    "info academic --out a.png": "--out .* --graph",
    "info academic --graph --out a.xyz": "'.xyz'",
    "info a.mcap --graph": "--graph a.mcap: .*a scenario.*a log",
    "linearize a.fmu --toml --json": "--toml .* --json",
    "linearize a.fmu --disturbance d": "--disturbance .* --toml",
}
FILES = {
    "info none.mcap": r"none\.mcap",
    "info .": "a folder",
    "hash none.mcap": r"none\.mcap",
    "hash academic": "academic",
    "hash plant.fmu": "expected a log",
    "check no.fmu": "no.fmu: there is no such file",
    "list tabel": "unknown kind 'tabel'; did you mean 'table'?",
    "cat a.mcap --format xml": "--format: .*'xml'; available: csv, jsonl",
    "cat a.mcap --signals plant.v": "'plant' has no signal 'v'",
    "cat a.mcap --from nan": "--from: .*nan",
    "cat a.mcap --to early": "--to: .*'early'",
    "cat a.mcap --to snan": "--to: .*'snan'",
    "cat none.mcap": r"none\.mcap cannot be read",
    "cat none.mcap --follow": r"none\.mcap cannot be read",
    "convert a.mcap a.txt": r"'\.txt'",
    "convert a.mcap old.csv": "old.csv exists; choose another path, or --force to replace it$",
    "convert a.mcap a.npz --from 2 --to 1": r"--from = 2\.0 s .*--to = 1\.0 s",
    "cut a.mcap -o c.mcap": "--from, --to",
    "cut a.mcap --from 3 --to 2 -o c.mcap": r"--from = 3\.0 s .*--to = 2\.0 s",
    "cut a.mcap --from 30 -o c.mcap": r"a\.mcap from 30 s: no rows",
    "cut a.mcap --to 0.05 -o b.mcap": "b.mcap exists",
    "merge a.mcap -o c.mcap": "two logs.*got 1",
    "merge a.mcap a.mcap -o c.mcap": "they overlap",
    "cut a.mcap --from 0 -o c.csv": r"--out c\.csv: expected .*\.mcap.*convert' writes",
    "merge a.mcap a.mcap -o c.NPZ": r"--out c\.NPZ: expected .*'\.NPZ'",
    "recover short.mcap -o c.mat": r"--out c\.mat: expected .*'\.mat'",
    "recover none.mcap -o c.mcap": r"none\.mcap cannot be read",
    "diff a.mcap b.mcap plant.x_c": "'plant' has no signal 'x_c'; did you mean 'x_b'?",
    "diff a.mcap b.mcap --tol u.y": r"--tol 'u\.y': .*no '='",
    "diff a.mcap b.mcap --tol u.y=a": r"--tol u\.y: .*'a'",
    "diff a.mcap b.mcap --tol u.y=-1": r"--tol u\.y: .*-1\.0",
    "diff a.mcap b.mcap --tol plant.w=1": r"--tol plant\.w: .*Available: u\.y, delta\.y",
    "diff a.mcap b.mcap --tol u.y=1 --tol u.y=2": r"--tol u\.y: .*given 2 times",
    "diff a.mcap b.mcap --plot d.doc": r"'\.doc'",
    "diff a.mcap b.mcap --atol -1": r"--atol: .*-1\.0",
    "metrics a.mcap": "expected an expression, .*--of",
    "metrics a.mcap 'rms('": r"metrics\.rms\(: metric 'rms\('",
    "metrics a.mcap last(plant.z)": "'plant' has no signal 'z'",
    "metrics a.mcap a=last(t) a=initial(t)": "metric 'a': given twice",
    "metrics a.mcap --of none": "dataset of a study",
    "metrics a.mcap --of a --of b": "--of: .*given 2 times",
    "metrics none.mcap last(t)": "none.mcap",
    "plot a.mcap observer.delta --out two.xyz": "two.xyz",
    "plot a.mcap observer.dleta --out x.png": "did you mean 'delta'",
    "plot a.mcap plant.x_a[2] --out y.png": "'plant.x_a' has 2 elements, numbered from 0",
    "plot plant.y --out y.png": "expected a log",
    "plot a.mcap b.mcap --out y.png": "several logs",
    "play a.mcap --port 0 --speed 0": r"--speed: .*0\.0",
    "play a.mcap --port 70000": "--port: .*70000",
    "play a.mcap --port 0 plant.z": r"a\.mcap has no 'plant\.z': 'plant' has no signal 'z'",
    "play a.mcap --port 0 --layout a.mcap": r"--layout a\.mcap: exists; choose another path",
    "play a.mcap --port 0 --layout none/x.json": r"none/x\.json: No such file or directory",
    "compare academic --swap plant=/dev/zero --swap plant=a.fmu#xs": (
        "(?s)--swap plant: [^\n]*'/dev/zero'.*--swap plant: [^\n]*'#xs'"
    ),
    "compare academic --estimators all --swap plant=a.fmu --swap plant=b.fmu": "--swap plant",
    "compare academic --estimators all --no-base": "--no-base",
    "compare academic": "--swap or --estimators",
    "compare loop.toml --swap plant=field.mcap --map plant.y=/other.position": (
        "no alternative has a port '/other.position'"
    ),
    "export academic --component delta": (
        "'delta' is of kind 'disturbance', which cannot be exported; available: sum, .*descriptor, "
    ),
    "export academic --component plnt": "no component 'plnt'; did you mean 'plant'?",
    "linearize plant.fmu --set u=fast": "start value of 'u': .*'fast'",
    "linearize plant.fmu --set =3": "--set '=3': .*no name",
    "linearize plant.fmu --set u": "--set 'u': .*no '='",
    "linearize plant.fmu --input w": "no input 'w'.*: u, delta",
}
READ_BY = "'cosim cat' without --follow, diff, metrics, plot and convert read it"
LINES_OF_OWN_LOGS = (
    "hash {}",
    "cat {} --follow",
    "cut {} --from 0 -o c.mcap",
    "merge {} a.mcap -o c.mcap",
    "play {} --port 0",
)
OTHERS = {
    "replay old.csv": f"old.csv': expected a log .* got a table; {READ_BY}",
    **{
        line.format(name): f"{name}'?: expected a log .*of cosim, got {found} .*{READ_BY}"
        for line in LINES_OF_OWN_LOGS
        for name, found in {"old.csv": "a table;", "field.mcap": "an MCAP file of another"}.items()
    },
}
# The reason is the same for every command that needs a signal which was not recorded.
NO_LOG = {
    "replay text.mcap": "text.mcap is not an MCAP file",
    "info empty.mcap": "empty.mcap is empty; expected an MCAP file",
    "diff short.mcap a.mcap": "short.mcap is truncated",
    "plot short.mcap u.y -o x.png": "short.mcap is truncated",
    "info short.mcap": "'cosim recover'",
}
PARTIAL = (
    r'is partial \(recorded with \[record\] signals = \["plant\.\*", "observer\.delta"\], '
    r"every = 10\); available: plant.u, plant.delta, plant.y, plant.x_a, plant.x_b, observer.delta"
)
UNRECORDED = dict.fromkeys(
    [
        "cat part.mcap --signals u.y",
        "convert part.mcap a.csv --signals u.*",
        "plot part.mcap u.y --out a.png",
        "diff part.mcap a.mcap u.y",
    ],
    PARTIAL,
)
GOAL = "--minimize abs(last(plant.y)-0.5)"
VARY = "--vary plant.time_constant=log:0.1:10"
STUDIES = {
    "study filters.toml --vary observer.filter_rate=log:10:1e3": "log:FIRST:LAST:POINTS",
    "study filters.toml --vary observer.filter_rate=lgo:10:1e3:3": "did you mean 'log'",
    "study filters.toml --metric error=rms(": r"metrics\.error: metric 'rms\('",
    "study filters.toml --keep 1,,2": "--keep: .*'1,,2'",
    "study filters.toml --keep wurst": "--keep",
    "study filters.toml --keep 0,4": "--keep: .*member 4",
    "study filters.toml --workers 0": "--workers: .*0",
    "study filters.toml --timeout -1": "--timeout",
    "study filters.toml --sampling sobol": "nothing is drawn",
    "study filters.toml --seeds 3": "nothing in the scenario has a seed",
    "study filters.toml --set observer.filter_rate=1": "it is varied",
    "study filters.toml --cases a.csv --cases b.csv": "--cases: .*given 2 times",
    "study filters.toml --out a -o b": "--out: .*given 2 times",
    "study filters.toml --out memory://a": "--out: .*'memory://a'",
    "study show .": "dataset of a study",
    "study show filters.toml": "dataset of a study",
    "study show none": "dataset of a study",
    f"tune lag.toml {VARY}": "--minimize and --maximize",
    f"tune lag.toml {VARY} {GOAL} --maximize last(plant.y)": "--minimize and --maximize",
    f"tune lag.toml {GOAL} --vary plant.time_constant=3": r"--vary plant\.time_constant: .*'3'",
    f"tune lag.toml {GOAL} {VARY} --method x": "--method: .* optuna, got 'x'",
    f"tune lag.toml {GOAL} --vary plant.time_constant=1,2": "'cobyqa'.*'optuna'",
    f"tune lag.toml {GOAL} {VARY} --scheduler tcp://127.0.0.1:1": "--scheduler: .*'cobyqa'",
    f"tune lag.toml {GOAL} {VARY} --standard-errors": "--standard-errors: .* rms ",
}
WRONG = OPTIONS | FILES | OTHERS | NO_LOG | UNRECORDED | STUDIES
WITH_VIEWERS = [line for line in WRONG if line.startswith("play")]  # need the SDK of viewers


def contents(folder):
    """Return the bytes of all files in a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, marks=[pytest.mark.slow] * (line in WITH_VIEWERS)) for line in WRONG],
)
def test_wrong_use_is_refused(call, files, line):
    """Exit 2, nothing on stdout, no file touched, and the names in a message without traceback."""
    before = contents(files)
    code, out, err = call(*shlex.split(line))
    assert (code, out) == (2, ""), err
    assert re.search(WRONG[line], err)
    assert all(text.startswith("cosim: ") for text in err.splitlines())
    assert contents(files) == before
