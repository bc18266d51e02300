"""Claims about amplification and linearity of z, on step gauges whose errors are known."""

import numpy as np
import pytest

from greenough.scenes.step_gauge import step_gauge
from greenough.twin.validation.acceptance import steps


@pytest.fixture
def gauge(setup, measured, grid, by_name):
    """Rows of a gauge whose heights z are measured as ``seen(z)``."""

    def made(seen=lambda z: z, seed: int = 0, scale_sd: float = 0.0):
        part = step_gauge(3)
        x, y = grid(7.0, 6.0, 0.02)
        z = np.zeros_like(x)
        for height, ((left, right), (low, high)) in zip(
            part.as_built["step_heights_mm"], part.as_built["step_boxes_mm"], strict=True
        ):
            z[(x > left) & (x < right) & (y > low) & (y < high)] = height
        true = np.stack([x, y, z], axis=-1)
        return by_name(
            steps.rows_of_gauge(setup, measured(part, true, errors=seen(z) - z, seed=seed, scale_sd=scale_sd))
        )

    return made


@pytest.mark.parametrize("seed", [0, 1])
def test_steps_of_a_perfect_instrument_have_their_certified_heights_within_their_uncertainty(gauge, seed):
    found = gauge(seed=seed)
    assert set(found) == set(steps.NAMES)
    for step in steps.STEPS:
        row = found[f"step_{step}"]
        assert abs(row.value) < 4.5 * row.u  # once in 1e5 for each
        assert row.u < 0.1
    assert found["alpha_z"].value == pytest.approx(1, abs=1e-4)
    assert all(row.holds for row in found.values())


def test_an_amplification_is_found_and_refused(gauge):
    found = gauge(lambda z: 1.004 * z)
    assert found["alpha_z"].value == pytest.approx(1.004, abs=1e-4)
    assert found["alpha_z"].holds is False
    assert found["step_largest"].value == pytest.approx(4.0 * -1.3, abs=0.1)  # of the deepest groove
    assert found["linearity_z"].holds


def test_a_bent_scale_is_found_by_its_linearity(gauge):
    found = gauge(lambda z: z + 8e-3 * z**2)
    assert found["linearity_z"].value > 4
    assert found["linearity_z"].holds is False


def test_a_missing_scale_error_is_in_the_uncertainty(gauge):
    found = gauge(scale_sd=1e-3)
    assert found["alpha_z"].u == pytest.approx(1e-3, rel=0.02)
    assert found["step_1300um_groove"].u == pytest.approx(1.3, rel=0.02)
