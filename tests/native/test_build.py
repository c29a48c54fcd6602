"""The kernels compile without a warning and run without undefined behavior."""

import importlib.util
import math
import platform
import shutil
import subprocess
import sys

import pytest

from cosim.native import build
from cosim.native.numerics.expression import FUNCTIONS, OPERATIONS, compile_expression
from cosim.native.numerics.instructions import ROW_OPERATIONS
from cosim.native.numerics.reductions import PARTS

SOURCES = [build.HERE / name for name in build.SOURCES]
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no cc")


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """Compile each kernel as it is shipped; return the objects, and what the compiler says."""
    folder = tmp_path_factory.mktemp("objects")
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow"]
    flags = [*build.FLAGS[:-1], *build.OPTIONS, *warnings]
    compiled = {}
    for source in SOURCES:
        target = folder / f"{source.stem}.o"
        command = ["cc", *flags, "-c", source, "-o", target]
        result = subprocess.run(command, capture_output=True, text=True, check=True)
        compiled[target] = result.stderr
    return compiled


@pytest.mark.slow
@needs_cc
def test_the_kernels_compile_without_a_warning(objects):
    """All of -Wall -Wextra -Wconversion are errors here."""
    for said in objects.values():
        assert not said, said


def test_lines_of_c_have_100_columns_at_most():
    """As those of Python have; in kernels and in the sources of exported FMUs."""
    package = build.HERE.parent
    files = [*package.rglob("*.c"), *package.rglob("*.h")]
    assert files
    for path in files:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            assert len(line) <= 100, f"{path}:{number}"


def symbols(path, kinds):
    """Return the symbols of an object or a library that are of these kinds, as nm shows them."""
    options = ["-D"] if path.suffix == ".so" else []
    result = subprocess.run(["nm", *options, path], capture_output=True, text=True, check=True)
    fields = [line.split() for line in result.stdout.splitlines()]
    return {parts[-1].split("@")[0].lstrip("_") for parts in fields if parts[-2] in kinds}


# rounded one way by IEEE 754, or exact; the maximum of zeros of both signs is asked for nowhere
EXACT = {"sqrt", "fabs", "copysign", "fmax", "fmin", "frexp", "ldexp"}
MATHEMATICS = {*dir(math), "fma", "fmax", "fmin", "rint", "lrint", "nearbyint", "round", "sincos"}


@pytest.mark.slow
@needs_cc
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_the_kernels_call_no_function_whose_bits_depend_on_the_c_library(objects):
    """Only square roots come from there.

    Only the list of message buffers is ever written, and which FMU a process is in.
    """
    for compiled in objects:
        needed = symbols(compiled, "U")
        assert needed & (MATHEMATICS) <= EXACT, compiled.name
        if compiled.stem not in ("callbacks", "running"):
            assert not symbols(compiled, "bBdDC"), compiled.name


HASH = r"""
#include "elementary.h"
#include <stdint.h>
#include <stdio.h>
#include <string.h>

typedef double (*function)(double x);

static uint64_t bits(double x)
{
    uint64_t word;
    memcpy(&word, &x, sizeof word);
    return word;
}

int main(void)
{
    const function functions[] = {cosim_sin, cosim_cos, cosim_tan, cosim_asin, cosim_acos,
                                  cosim_atan, cosim_sinh, cosim_cosh, cosim_tanh, cosim_exp,
                                  cosim_ln};
    uint64_t word = 1, hash = 0;
    for (int i = 0; i < 20000; ++i) {
        word = word * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
        const uint64_t wide = word ^ word >> 29;
        const double small = (double)(int64_t)wide * 0x1p-60;
        double any;
        memcpy(&any, &wide, sizeof any);
        for (size_t k = 0; k < sizeof functions / sizeof functions[0]; ++k) {
            hash = hash * 31 + bits(functions[k](small));
            hash = hash * 31 + bits(functions[k](any));
        }
        hash = hash * 31 + bits(cosim_pow(any, small));
        hash = hash * 31 + bits(cosim_pow(small * small, 20.0 * small));
    }
    printf("%016llx\n", (unsigned long long)hash);
    return 0;
}
"""
COMPILERS = {
    "cc without optimization": ["cc", "-O0"],
    "cc for this processor": ["cc", "-O3", "-march=native"],
    "zig": build.cross_compiler("x86_64-linux-gnu"),
}


@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize(
    "others",
    [list(COMPILERS)[:2], pytest.param(list(COMPILERS)[2:], marks=pytest.mark.campaign)],
    ids=["cc", "zig"],
)
def test_compilers_and_their_options_do_not_change_a_bit_of_the_elementary_functions(
    others, tmp_path
):
    """Arguments of every size; also where the compiler may use every instruction it finds."""
    (tmp_path / "main.c").write_text(HASH, encoding="utf-8")
    flags = [flag for flag in build.FLAGS if flag not in ("-O2", "-shared")]
    sources = [tmp_path / "main.c", build.source("elementary.c")]
    hashes = {}
    commands = {"cc": ["cc", "-O2"]} | {name: COMPILERS[name] for name in others}
    for name, command in commands.items():
        if name == "zig" and not runs_here(command):
            pytest.skip("zig is not there, or makes no program for this machine")
        program = tmp_path / "program"
        options = [*flags, *build.INCLUDES]
        subprocess.run([*command, *options, *sources, "-o", program, "-lm"], check=True)
        result = subprocess.run([program], capture_output=True, text=True, check=True)
        hashes[name] = result.stdout
    assert len(set(hashes.values())) == 1, hashes


ROTATIONS = """
#include <stdio.h>
#include <stdint.h>
#include <string.h>
#include "householder.h"

int main(void)
{
    static double R[40 * 40], block[67 * 40], work[40];
    uint64_t state = 1, hash = 14695981039346656037u;
    for (int n = 1; n <= 40; ++n)
        for (int rows = 1; rows <= 67; rows += 3) {
            for (int i = 0; i < n * rows; ++i) {
                state = state * 6364136223846793005u + 1442695040888963407u;
                block[i] = (double)(int64_t)state;
            }
            cosim_householder(n, R, rows, block, work);
            for (int i = 0; i < n * n; ++i) {
                uint64_t bits;
                memcpy(&bits, R + i, sizeof bits);
                hash = (hash ^ bits) * 1099511628211u;
            }
        }
    printf("%llu", (unsigned long long)hash);
    return 0;
}
"""


@pytest.mark.slow
@needs_cc
def test_options_do_not_change_a_bit_of_the_rotations(tmp_path):
    """Columns may be taken side by side, but the rows of each are summed in their order."""
    (tmp_path / "main.c").write_text(ROTATIONS, encoding="utf-8")
    flags = [flag for flag in build.FLAGS if flag not in ("-O2", "-shared")]
    sources = [tmp_path / "main.c", build.source("householder.c")]
    hashes = set()
    for options in (["-O2"], build.OPTIONS, ["-O3", "-march=native"]):
        program = tmp_path / "program"
        command = ["cc", *options, *flags, *build.INCLUDES, *sources, "-o", program, "-lm"]
        subprocess.run(command, check=True)
        result = subprocess.run([program], capture_output=True, text=True, check=True)
        hashes.add(result.stdout)
    assert len(hashes) == 1, hashes


def runs_here(command):
    """Return whether there is this cross compiler, and its programs run on this machine."""
    return bool(command) and sys.platform == "linux" and platform.machine() == "x86_64"


def enumerated(text):
    """Return the names in an ``enum``, in lower case, without their values."""
    names = text[text.index("enum {") + 6 : text.index("};")].replace("\n", " ").split(",")
    return [name.partition("=")[0].strip().lower() for name in names]


def test_the_operations_are_numbered_as_in_c():
    """Python and C agree on the order, by name; those on rows stand behind the others."""
    [header] = [path for path in build.headers(["expression.c"]) if path.name == "operations.h"]
    names = enumerated(header.read_text(encoding="utf-8"))
    in_c = [name.replace("minimum", "min").replace("maximum", "max") for name in names]
    assert in_c == [*OPERATIONS, "operations"]
    assert OPERATIONS[-len(FUNCTIONS) :] == FUNCTIONS
    text = build.source("reductions.c").read_text(encoding="utf-8")
    assert enumerated(text.replace(" = OPERATIONS", "")) == [*ROW_OPERATIONS]


def test_the_parts_of_reductions_are_numbered_as_in_c():
    """Each is the bit of its place."""
    text = build.source("reductions.c").read_text(encoding="utf-8")
    bits = text[text.index("enum {\n    ENDS") :]
    assert enumerated(bits) == [*PARTS]
    values = [int(item.partition("=")[2]) for item in bits[: bits.index("}")].split(",")]
    assert values == [1 << number for number in range(len(PARTS))]


# what MAIN calls, and what that calls
CALLED = ("cascade.c", "linear.c", "elementary.c", "expression.c", "alphas.c", "regression.c")
MAIN = r"""
#include "linear.h"
#include "regression.h"
#include <math.h>
#include <stdlib.h>

/* Every array is a heap block of exactly the documented size: one element too many is found. */
static double *doubles(size_t n) { return calloc(n ? n : 1, n ? sizeof(double) : 1); }

static int32_t drive(cosim_step step, void *self, int n_u, int n_y, int steps)
{
    double *t = doubles((size_t)steps + 1), *u = doubles((size_t)((steps + 1) * n_u));
    double *y = doubles((size_t)(steps * n_y));
    int32_t status;
    for (int k = 0; k <= steps; ++k) {
        t[k] = 0.1 * k;
        for (int j = 0; j < n_u; ++j)
            u[k * n_u + j] = sin(1.0 + k * (j + 0.7));
    }
    cosim_cascade(step, self, steps, t, 0.1, u, n_u, y, n_y, &status);
    free(t), free(u), free(y);
    return status;
}

static void linear(int n, int m, int p)
{
    const int N = n + 2 * m;
    double *A = doubles((size_t)(n * n)), *B = doubles((size_t)(n * m));
    double *C = doubles((size_t)(p * n)), *D = doubles((size_t)(p * m));
    double *Ad = doubles((size_t)(n * n));
    double *B0 = doubles((size_t)(n * m)), *B1 = doubles((size_t)(n * m));
    double *work = doubles((size_t)(4 * N * N)), *memory = doubles((size_t)(2 * n));
    uint8_t *held = calloc((size_t)m + 1, 1);
    for (int i = 0; i < n * n; ++i) A[i] = sin(i);
    for (int i = 0; i < n * m; ++i) B[i] = cos(i);
    held[0] = 1;
    cosim_first_order_hold(n, m, A, B, 0.1, held, Ad, B0, B1, work);
    cosim_linear self = {n, m, p, Ad, B0, B1, C, D, memory};
    drive(cosim_linear_step, &self, m, p, 20);
    free(A), free(B), free(C), free(D);
    free(Ad), free(B0), free(B1), free(work), free(memory), free(held);
}

static void least_squares(const cosim_recovery *recovery, int groups, int unknowns, int parameters,
                          int held, double prior)
{
    double *memory = doubles((size_t)((unknowns + 1) * (unknowns + 3)));
    double *y = doubles((size_t)(parameters + unknowns));
    cosim_least_squares self = {unknowns, groups, parameters, held, 0.3, prior, recovery, memory};
    cosim_least_squares_start(&self, y);
    drive(cosim_least_squares_step, &self, unknowns + 1, parameters + unknowns, 40);
    free(memory), free(y);
}

int main(void)
{
    const int sizes[][3] = {{3, 2, 4}, {0, 2, 1}, {2, 0, 2}, {1, 1, 0}, {0, 0, 0}};
    for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; ++i)
        linear(sizes[i][0], sizes[i][1], sizes[i][2]);

    double *line = doubles(1 + 3 * 2);
    cosim_delay delay = {3, 2, line};
    drive(cosim_delay_step, &delay, 2, 2, 20);

    const int32_t code[] = {CODE};
    const double constants[] = {CONSTANTS};
    cosim_program *programs = malloc(2 * sizeof *programs);
    programs[0] = programs[1] = (cosim_program){sizeof code / sizeof code[0], code, constants};
    cosim_expression expression = {2, programs};
    drive(cosim_expression_step, &expression, 0, 2, 20);

    const int32_t steps[] = {0, 4, 2}, row[] = {2, 0, 1, 1, 0, 2};
    const int32_t factor[] = {0, 4, 1, 5, 0, 5, 2, 3, 2, 4, 1, 3};
    const double delays[] = {0.0, 0.4, 0.2}, sign[] = {1, -1, 1, -1, 1, -1};
    /* one alpha is an expression, the other a signal, also between its samples */
    const int32_t element[] = {-1, 0}, before[] = {0, 0, 0, 0, 3, 2};
    const double part[] = {0.0, 0.0, 0.0, 0.0, 0.5, 0.0};
    const cosim_past_alphas alphas = {{2, 1, element, programs}, 3, 4, delays, before, part};
    double *samples = doubles((size_t)(1 + 4 + 2 * 3 + cosim_past_alphas_memory(&alphas)));
    cosim_regressor regressor = {3, 6, 2, steps, &alphas, row, factor, sign, samples};
    drive(cosim_regressor_step, &regressor, 2, 6, 20);

    const cosim_recovery two[] = {{COSIM_EXPONENTIAL, {2, 0, 0}, {1, 0}, {-1, 1, 0}, 2.0},
                                   {COSIM_EXPONENTIAL, {5, 0, 0}, {0, 0}, {-1, 1, 0}, 1.0}};
    const cosim_recovery pair = {COSIM_EXPONENTIALS, {1, 2, 0}, {0, 1}, {1, -1, 1}, 1.0};
    const cosim_recovery sine = {COSIM_SINE, {1, 2, 0}, {0, 0}, {1, -1, 1}, 0.5};
    for (int held = 0; held < 2; ++held) {
        least_squares(two, 2, 5, 2, held, 0.0);
        least_squares(&pair, 1, 2, 2, held, 0.1);
        least_squares(&sine, 1, 2, 1, held, 0.0);
    }
    free(line), free(programs), free(samples);
    return 0;
}
"""


@pytest.mark.slow
@needs_cc
def test_the_kernels_run_clean_under_the_sanitizers(tmp_path):
    """No access outside the documented sizes and no undefined behavior, also for empty systems."""
    sanitizers = "-fsanitize=address,undefined"
    (tmp_path / "probe.c").write_text("int main(void) { return 0; }\n")
    probe = subprocess.run(
        ["cc", sanitizers, tmp_path / "probe.c", "-o", tmp_path / "probe"],
        capture_output=True,
        check=False,
    )
    if (
        probe.returncode
        or subprocess.run([tmp_path / "probe"], capture_output=True, check=False).returncode
    ):
        pytest.skip("the compiler lacks the sanitizers")
    text = (
        " + ".join(f"{name}(t)" for name in FUNCTIONS)
        + " - min(t, 2)*max(t, 3)/(-t)**2 + "
        + "t + (" * 50
        + "t"
        + ")" * 50
    )
    program = compile_expression(text)
    code, constants = (
        ", ".join(map(repr, array.tolist())) for array in (program.code, program.constants)
    )
    (tmp_path / "main.c").write_text(
        MAIN.replace("CODE", code, 1).replace("CONSTANTS", constants, 1), encoding="utf-8"
    )
    # of warnings errors: a struct that has changed is written here by the order of its members
    strict = ["-Wall", "-Werror", "-fno-sanitize-recover=all"]
    options = ["-std=c11", "-g", "-O1", sanitizers, *strict, *build.INCLUDES]
    sources = [tmp_path / "main.c", *map(build.source, CALLED)]
    compiled = subprocess.run(
        ["cc", *options, *sources, "-o", tmp_path / "main", "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert compiled.returncode == 0, compiled.stderr
    # leaks need ptrace, which containers refuse; what is freed is not the kernels' business
    result = subprocess.run(
        [tmp_path / "main"],
        capture_output=True,
        text=True,
        env={"ASAN_OPTIONS": "detect_leaks=0"},
        check=False,
    )
    assert result.returncode == 0, result.stderr


def hook(tmp_path):
    """Load the hook as hatchling does: from its file, with hatchling there."""
    import hatchling  # noqa: F401

    spec = importlib.util.spec_from_file_location("hook", build.HERE / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.KernelBuildHook(str(tmp_path), {}, None, None, str(tmp_path), "wheel")


def test_the_build_asks_for_a_compiler_only_where_there_is_none(tmp_path, monkeypatch):
    """`cc` is used where there is one; else ziglang becomes a build dependency."""
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert hook(tmp_path).dependencies() == []
    assert build.compiler() == ["/usr/bin/cc"]
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert hook(tmp_path).dependencies() == ["ziglang"]


def test_zig_is_always_given_a_target(monkeypatch):
    """Without one it emits the instructions of the host, and the bits would differ."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    command = build.compiler()
    assert command[1:5] == ["-m", "ziglang", "cc", "-target"]
    assert "-" in command[5]


def test_no_compiler_at_all_is_an_error_with_the_way_out(tmp_path, monkeypatch):
    """It names both ways to get one."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        RuntimeError, match="no C compiler: install one as 'cc', or 'pip install ziglang'"
    ):
        build.compile_library(SOURCES, tmp_path / "x.so")


@needs_cc
def test_the_words_of_the_compiler_are_passed_on(tmp_path):
    """The file, the line and its words."""
    source = tmp_path / "wrong.c"
    source.write_text('#error "this is wrong"\n', encoding="utf-8")
    with pytest.raises(RuntimeError, match=r"(?s)cc failed:.*wrong\.c:1.*this is wrong"):
        build.compile_library([source], tmp_path / "x.so")
