"""Records of a part of a period: what they do not determine is said, and nothing else."""

import pytest

from cosim.theory.documents import Verdict
from tests.theory.first_order import sine


def test_a_large_disturbance_whose_rate_is_hardly_known_is_weak():
    """Of a tenth of a period: far above the noise, but its effect is not linear in the rate."""
    (parameter,) = sine(length=0.4, sigma=1e-3)
    assert parameter.verdict is Verdict.WEAK
    assert "not linear over its interval" in parameter.reason
    (longer,) = sine(length=1.2, sigma=1e-3)
    assert longer.verdict is Verdict.IDENTIFIABLE
    assert longer.value == pytest.approx(1.3, abs=4.0 * longer.standard_error)


@pytest.mark.parametrize("seed", range(3))
def test_the_rate_of_a_short_record_is_no_alias(seed):
    """2 pi / h beside the true rate has the same samples."""
    (parameter,) = sine(length=2.0, sigma=0.1, seed=seed)
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.value == pytest.approx(1.3, abs=4.0 * parameter.standard_error)


@pytest.mark.parametrize("sigma", [3e-3, 1e-2, 3e-2])
def test_data_that_do_not_determine_a_rate_do_not_contradict_the_model(sigma):
    """A slower sine, down to none, explains them; the optimum that converges is another one."""
    (parameter,) = sine(length=0.4, sigma=sigma)
    assert parameter.verdict is Verdict.NO_ESTIMATE
    assert parameter.value is None
    assert "these data hardly determine theta" in parameter.reason
