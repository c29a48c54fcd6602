import numpy as np

from cosim.theory.disturbances.excitation import describe_excitation, information
from cosim.theory.disturbances.regression import expand, mu
from tests.theory.academic import delayed


def papers_information(case, steps):
    t = np.linspace(case("C03")["expected"]["T_id"], 40.0, steps + 1)
    return information(mu(expand((1, 1)), *delayed(t))[:, 1:], t[1] - t[0])


def test_the_information_is_the_papers(case):
    """Eigenvalues and condition over [T_id, 40] from exact delta."""
    expected = case("C03")["expected"]
    rel = case("C03")["tol"]["rel"]
    # Richardson's step on the trapezoid rule leaves order h^4: h = 4 ms, derivatives of order
    # 10^4 / 180, far below 1e-6 * 1.7e-3
    matrix = (4.0 * papers_information(case, 8192) - papers_information(case, 4096)) / 3.0
    eigenvalues = np.linalg.eigvalsh(matrix)
    np.testing.assert_allclose(eigenvalues, expected["info_eigs_T_id_to_40"], rtol=rel)
    np.testing.assert_allclose(eigenvalues[-1] / eigenvalues[0], expected["info_cond"], rtol=rel)


def test_the_information_converges_with_order_two(case):
    """Halving the step quarters the error of the trapezoid rule."""
    best = (4.0 * papers_information(case, 4096) - papers_information(case, 2048)) / 3.0
    coarse, fine = (np.abs(papers_information(case, steps) - best).max() for steps in (512, 1024))
    assert 3.9 < coarse / fine < 4.1


def test_the_verdict_names_the_prior_that_decides(case):
    """1/P0 = 1e-3 against 1.70e-3: the paper's own setting."""
    eigenvalues = np.array(case("C03")["expected"]["info_eigs_T_id_to_40"])
    assert describe_excitation(eigenvalues, 1e-3).startswith(
        "the prior 1/P0 = 0.001 is 0.59 of the smallest information eigenvalue 0.0017: the "
        "estimate in that direction is the prior's, not the data's (weight of the prior 0.37); "
        "2 of 5 directions are affected, condition 3.23e+04"
    )


def test_the_verdict_has_numbers(subtests):
    """The data determine eta, nothing does, or the prior does."""
    for eigenvalues, prior, message in [
        (
            [1.0, 4.0],
            1e-9,
            "the prior 1/P0 = 1e-09 is 1e-09 of the smallest information eigenvalue 1: the "
            "regressor is persistently exciting (rank 2 of 2), condition 4",
        ),
        (
            [4.0, 1.0],
            None,
            "the regressor is persistently exciting (rank 2 of 2), smallest information "
            "eigenvalue 1, condition 4",
        ),
        (
            [4.0, -1e-17],
            None,
            "the regressor is not persistently exciting (rank 1 of 2): the smallest information "
            "eigenvalue -1e-17 is zero to rounding beside the largest 4; some combination of the "
            "regression coefficients leaves no trace in the data",
        ),
        (
            [0.0, 0.0],
            1e-3,
            "the regressor is not persistently exciting (rank 0 of 2): the smallest information "
            "eigenvalue 0 is zero to rounding beside the largest 0; some combination of the "
            "regression coefficients leaves no trace in the data; the prior alone decides it",
        ),
    ]:
        with subtests.test(message=message):
            assert describe_excitation(np.array(eigenvalues), prior) == message
