"""Manifests of FMI-LS-DAE: written, read in all their variants, checked, and used by an FMU."""

import re
import zipfile

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from cosim.blocks.plant import descriptor_form
from cosim.cli import main
from cosim.core.linear import DescriptorModel
from cosim.errors import AssumptionError, FmuError, GraphError
from cosim.fmi.checking.check import check
from cosim.fmi.component import load
from cosim.fmi.description import Dae, Formulation
from cosim.fmi.exporting.export import export
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.reading.model_description import read
from cosim.theory.plants.descriptor import DescriptorSystem
from tests.fmi.dae import ABOUT, LISTS, RATE, STRUCTURE, SYSTEM, build, descriptor, manifest

A = SYSTEM.A
B = np.hstack([SYSTEM.Bu, SYSTEM.Bd])
C = SYSTEM.C
RIGHT = LISTS + STRUCTURE.format(rate=RATE)


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = tmp_path_factory.mktemp("dae") / "plant.fmu"
    return export(descriptor(), path, name="plant", fmi="3").path


# --- out ---


@pytest.mark.slow
def test_a_dae_fmu_is_a_valid_fmu(plant):
    """The validator of fmpy and our own check find nothing; x_b and its residual are arrays."""
    assert validate_fmu(str(plant)) == []
    assert check(plant) == ()
    description = fmpy.read_model_description(str(plant), validate=True)
    causalities = {variable.name: variable.causality for variable in description.modelVariables}
    assert causalities["residual"] == "local"


def test_a_written_description_reads_back_as_it_was(plant):
    """Dependencies are those of the partitioned equations (2)-(3): y of x_a and x_b, not of u."""
    everything = ("u", "delta", "x_a", "x_b")
    dependencies = {
        "y": ("x_a", "x_b"),
        "x_a": ("x_a",),
        "x_b": ("x_b",),
        "der(x_a)": everything,
    }
    residuals = ((Formulation("residual", everything),),)
    expected = Dae("0.0.1", ("x_b",), residuals, dependencies)
    assert read(plant).description.dae == expected


def test_the_manifest_names_the_version_that_it_follows(plant):
    """Text, schema and sample of the draft disagree."""
    with zipfile.ZipFile(plant) as archive:
        text = archive.read(MANIFEST).decode()
    assert 'fmi-ls:fmi-ls-version="0.0.1"' in text
    draft = "the draft of org.fmi-standard.fmi-ls-dae, version 0.0.1"
    assert f"<!-- Follows the text of {draft}; its schema" in text


class Driven:
    """An exported plant in continuous-time mode, variable by variable."""

    def __init__(self, fmu, u):
        self.instance = fmu.instance
        fmu.component.prepare(0.1, np.zeros(2, np.bool_), {})
        fmu.component.initialize(0.0, u)
        fmu.component.outputs(0.0, u)

    def __getitem__(self, name):
        return self.instance.get_float64(self._references(name))

    def __setitem__(self, name, values):
        self.instance.set_float64(self._references(name), values)

    def jacobian(self, unknown, known):
        """Return the block of the Jacobian for one unknown and one known variable."""
        unknowns = self._references(unknown)
        knowns = self._references(known)
        columns = []
        for seed in np.eye(knowns.size):
            columns.append(self.instance.get_directional_derivative(unknowns, knowns, seed))
        return np.column_stack(columns)

    def _references(self, name):
        return self.instance.description.references_of([name])


U = np.array([0.75, -1.25])


def test_algebraic_variables_are_calculated_until_they_are_set(plant):
    """Calculated, the residual is rounding; set, x_a', y and the residual follow from the values.

    They are calculated again when a saved state is restored.
    """
    with load(plant) as fmu:
        fmu = Driven(fmu, U)
        x_a = fmu["x_a"]
        known_part = -A[2:, :2] @ x_a - B[2:] @ U
        solved = np.linalg.solve(A[2:, 2:], known_part)
        assert fmu["x_b"] == pytest.approx(solved, rel=1e-14)
        assert fmu["residual"] == pytest.approx(np.zeros(2), abs=1e-15)
        calculated = fmu["der(x_a)"]
        saved = fmu.instance.get_fmu_state()
        x_b = np.array([0.5, -3.0])
        fmu["x_b"] = x_b
        state = np.concatenate([x_a, x_b])
        derivatives = A[:2] @ state + B[:2] @ U
        residual = A[2:] @ state + B[2:] @ U
        assert np.array_equal(fmu["x_b"], x_b)
        assert fmu["der(x_a)"] == pytest.approx(derivatives, rel=1e-15)
        assert fmu["residual"] == pytest.approx(residual, rel=1e-15)
        assert fmu["y"] == pytest.approx(C @ state, rel=1e-15)
        fmu["u"] = np.array([2.0])
        residual = A[2:] @ state + B[2:] @ [2.0, U[1]]
        assert fmu["residual"] == pytest.approx(residual, rel=1e-15)
        fmu.instance.set_fmu_state(saved)
        assert np.array_equal(fmu["der(x_a)"], calculated)


def test_derivatives_by_set_algebraic_variables_are_those_of_the_matrices(plant):
    """Where x_b is set, it does not follow x_a and the inputs."""
    with load(plant) as fmu:
        fmu = Driven(fmu, U)
        fmu["x_b"] = np.zeros(2)
        assert np.array_equal(fmu.jacobian("der(x_a)", "x_a"), A[:2, :2])
        assert np.array_equal(fmu.jacobian("der(x_a)", "delta"), B[:2, 1:])
        assert np.array_equal(fmu.jacobian("y", "x_a"), C[:, :2])


@pytest.mark.parametrize("is_set", [False, True])
def test_derivatives_know_algebraic_variables_and_residuals(plant, is_set):
    """Calculated, x_b follows, except in derivatives by x_b itself and of the residual."""
    with load(plant) as fmu:
        fmu = Driven(fmu, U)
        if is_set:
            fmu["x_b"] = np.zeros(2)
        else:
            follows = A[:2, 2:] @ np.linalg.solve(A[2:, 2:], A[2:, :2])
            reduced = A[:2, :2] - follows
            assert fmu.jacobian("der(x_a)", "x_a") == pytest.approx(reduced, rel=1e-14)
        assert np.array_equal(fmu.jacobian("der(x_a)", "x_b"), A[:2, 2:])
        assert np.array_equal(fmu.jacobian("y", "x_b"), C[:, 2:])
        assert np.array_equal(fmu.jacobian("residual", "x_b"), A[2:, 2:])
        assert np.array_equal(fmu.jacobian("residual", "x_a"), A[2:, :2])
        assert np.array_equal(fmu.jacobian("residual", "u"), B[2:, :1])


def outputs(path, options):
    """Run an FMU for 0.4 s with inputs linear in time; return its outputs."""
    t = np.arange(201) / 500.0
    rows = np.column_stack([0.5 + t, 1.0 - 0.5 * t])
    with load(path, options) as fmu:
        fmu.component.prepare(0.002, np.zeros(2, np.bool_), {})
        initial = fmu.component.initialize(0.0, rows[0])
        return np.vstack([initial, fmu.component.advance(t, 0.002, rows)])


def test_both_forms_agree_for_several_algebraic_variables(plant):
    """The eigenvalues reach 3/s: a step of 2 ms is wrong by (3 h)^6 / 7200 = 6e-18.

    200 of those are less than rounding, which is 200 times 4e-16. rk4 as the ordinary solver is
    wrong by (3 h)^5 / 120 = 6e-14 in a step, 1.3e-11 in all. Steps of co-simulation are exact.
    """
    exact = outputs(plant, FmuOptions(interface_type="cs"))
    assert outputs(plant, FmuOptions(dae="residual")) == pytest.approx(exact, abs=1e-13)
    assert outputs(plant, FmuOptions(dae="ode")) == pytest.approx(exact, abs=1.3e-11)


def test_a_model_without_a_residual_form_is_refused(tmp_path):
    """FMI 2, a system without algebraic states, matrices that do not fit."""
    standard = "the layered standard for it is on top of FMI 3: use FMI 3"
    with pytest.raises(FmuError, match=f"x: FMI 2.0 has no residual form; {standard}"):
        export(descriptor(), tmp_path / "x.fmu", name="x", fmi="2")
    whole = DescriptorSystem.partitioned(A=A, Bu=SYSTEM.Bu, Bd=SYSTEM.Bd, C=C, n_a=4)
    reason = "without algebraic states there is no residual form"
    with pytest.raises(AssumptionError, match=f"n_a = 4 of 4 states: {reason}"):
        descriptor_form(whole, np.zeros(4))
    right = descriptor()
    with pytest.raises(GraphError, match=r"matrix by_z: expected shape \(9, 2\), got \(9, 1\)"):
        DescriptorModel(right.reduced, "x_b", right.by_x, right.by_z[:, :1], right.by_u)


# --- in ---

BARE = ABOUT.replace("fmi-ls:fmi-ls", "fmi-ls")


@pytest.mark.parametrize(
    ("root", "about"),
    [
        ("fmiLayeredStandardManifest", ABOUT),
        ("fmiLayeredStandardManifest", BARE),
        ("fmi-dae", f'{ABOUT} isDaeFmu="true"'),
        ("fmi-dae", f'{BARE} isDaeFmu="true"'.replace("0.0.1", "0.1")),
        ("fmi-dae", f"{ABOUT}".replace("DAE support in FMI", "DAE support in FMI.")),
    ],
)
def test_all_variants_of_the_draft_are_read(root, about, tmp_path):
    """Two roots, attributes with a namespace and without, two versions, any description."""
    dae = read(with_manifest(tmp_path / "x.fmu", manifest(RIGHT, root, about))).description.dae
    assert dae.problems == ()
    assert dae.algebraic == ("z",)
    assert dae.residuals == ((Formulation("r"),),)
    assert dae.dependencies == {"der(x)": ("z",)}


def edited(old, new):
    assert old in RIGHT
    return manifest(RIGHT.replace(old, new, 1))


BROKEN = {
    "well-formed": ("<a", "it is not well-formed: "),
    "root": (
        manifest(RIGHT, "fmi-ode"),
        "the root: expected fmiLayeredStandardManifest or fmi-dae, got 'fmi-ode'",
    ),
    "name": (
        manifest(RIGHT, about=ABOUT.replace("-ls-dae", "-ls-x")),
        "fmi-ls-name: expected org.",
    ),
    "version": (
        manifest(RIGHT, about=ABOUT.replace("0.0.1", "2.0")),
        "fmi-ls-version: expected 0.0.1 or 0.1, got '2.0'",
    ),
    "z": (edited('"2"/>', '"99"/>'), "AlgebraicVariable: valueReference=99 is no variable"),
    "r": (edited('"4"', '"98"'), "Formulation: valueReference=98 is no variable"),
    "needs": (
        edited('dependencies="2"', 'dependencies="2 97"'),
        "'der(x)': dependencies name no variable: 97",
    ),
    "twice": (
        edited("</Alg", '<AlgebraicVariable valueReference="2"/></Alg'),
        "'z' is listed 2 times; expected once",
    ),
    "discrete": (
        edited('"2"/>', '"6"/>'),
        "'q': expected a real, continuous variable",
    ),
    "empty": (
        edited('<Formulation valueReference="4"/>', ""),
        "Residual: expected at least one Formulation, got none",
    ),
    "count": (
        edited('<Residual><Formulation valueReference="4"/></Residual>', ""),
        "expected as many residuals as algebraic variables (1), got 0",
    ),
}


def with_manifest(path, content):
    """Copy the FMU with another manifest."""
    with zipfile.ZipFile(build()) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            target.writestr(name, content if name == MANIFEST else source.read(name))
    return path


@pytest.mark.fast("version", "well-formed", "root", "discrete")
@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_manifest_is_reported_and_no_obstacle(what, tmp_path):
    """The residual form is refused; the ordinary one runs."""
    content, message = BROKEN[what]
    path = with_manifest(tmp_path / "x.fmu", content)
    assert any(message in problem for problem in read(path).description.dae.problems)
    refusal = rf'CUBIC: dae = "residual": {MANIFEST}: .*{re.escape(message)}'
    with pytest.raises(FmuError, match=refusal):
        load(path, FmuOptions(dae="residual"))
    load(path).close()


@pytest.mark.slow
def test_the_check_finds_all_that_is_wrong_with_a_manifest(tmp_path):
    """Each problem is an error of the manifest."""
    path = with_manifest(tmp_path / "x.fmu", edited('"4"', '"98"').replace("0.0.1", "2.0"))
    findings = [finding for finding in check(path) if finding.where == MANIFEST]
    assert [finding.level for finding in findings] == ["error", "error"]
    first, second = findings
    assert first.text.startswith("fmi-ls-version:")
    assert second.text.startswith("Formulation:")


@pytest.mark.slow
def test_a_manifest_without_a_structure_is_a_warning(tmp_path):
    """As the draft's own sample is."""
    sample = manifest("", "fmi-dae", f'{ABOUT} isDaeFmu="true"')
    path = with_manifest(tmp_path / "x.fmu", sample)
    (finding,) = [finding for finding in check(path) if finding.where == MANIFEST]
    assert finding.level == "warning"
    assert "lists no AlgebraicVariables or no Residual" in finding.text


def test_info_shows_the_residual_form(capsys):
    """Its version, its unknowns and its equations."""
    with pytest.raises(SystemExit):
        main(["info", str(build())])
    shown = " ".join(capsys.readouterr().out.split())
    unknowns = "residual form fmi-ls-dae 0.0.1 algebraic variables z"
    assert f"{unknowns} 0 = r depends on unknown der(x) depends on z" in shown
