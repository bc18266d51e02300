"""Claims about measurement noise on repeated maps whose noise is known."""

import numpy as np
import pytest

from greenough.twin.validation.acceptance.noise import AS_IT_IS_SUFFIX, NAMES, STEADY_SUFFIX, row_of_pair
from greenough.twin.validation.measured import RAW
from greenough.twin.validation.measured_noise import Repeated


def pair(noise: float, stated: float = 1e-3) -> Repeated:
    rng = np.random.default_rng(2)
    shape = (150, 200)
    first, second = noise * rng.standard_normal((2, *shape))
    everywhere = np.ones(shape)
    return Repeated("coin", RAW, first, second, stated * everywhere, everywhere, 0 * everywhere, everywhere > 0)


def test_noise_as_stated_holds_and_more_of_it_fails(setup):
    """Of 30 000 pixels the noise is known to 0.4 %, so that 2 % happens by chance once in 1e6."""
    found = row_of_pair(setup, pair(1e-3), STEADY_SUFFIX)
    assert found.ratio == pytest.approx(1, abs=0.02)
    assert found.holds
    assert found.name in NAMES
    assert found.peer == pytest.approx(1.0)
    assert row_of_pair(setup, pair(1.1e-3), STEADY_SUFFIX).holds is False
    assert row_of_pair(setup, pair(0.9e-3), STEADY_SUFFIX).holds is False


def test_with_all_effects_the_ratio_is_reported(setup):
    found = row_of_pair(setup, pair(1.1e-3), AS_IT_IS_SUFFIX)
    assert found.holds is None
    assert found.ratio == pytest.approx(1.1, abs=0.02)
    assert found.name in NAMES
