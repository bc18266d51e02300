"""Claims about how two renderers are compared: what their sampling errors are, and whether they render the same."""

import numpy as np
import pytest

from greenough.twin.validation.benchmarks.rendering import SIGMAS, phase_rms, same_light_rows, samples_for
from greenough.twin.validation.benchmarks.rendering import standard_errors as z

SAMPLES = np.array([16, 64, 256])
SHAPE = (40, 50)


def fringes(phase: float, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Twelve steps of fringes, (rows, cols, 12), whose frames have noise of their own."""
    steps = np.arange(12)
    field = np.linspace(0, 20, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    stack = 1 + np.cos(field[..., None] + phase + 2 * np.pi * steps / 12)
    return stack + noise * rng.standard_normal(stack.shape)


@pytest.mark.parametrize("needed", [20, 100, 256, 5000])
def test_where_errors_fall_as_the_square_root_the_number_of_paths_is_the_one_with_that_error(needed):
    assert samples_for(3 / np.sqrt(needed), SAMPLES, list(3 / np.sqrt(SAMPLES))) == pytest.approx(needed, rel=1e-9)


def test_where_errors_fall_slowly_the_number_beyond_is_at_most_what_they_need():
    """Errors that fall with the fourth root would take the square of what is said."""
    errors = list(SAMPLES**-0.25)
    assert samples_for(errors[1], SAMPLES, errors) == pytest.approx(64)
    assert samples_for(errors[2] / 2, SAMPLES, errors) == pytest.approx(4 * 256)


def test_nothing_is_said_of_fewer_paths_than_were_rendered():
    assert np.isnan(samples_for(0.5, SAMPLES, [0.4, 0.2, 0.1]))


def test_an_error_of_phase_is_its_root_mean_square():
    rng = np.random.default_rng(1)
    everywhere = np.ones(SHAPE, bool)
    assert phase_rms(fringes(0.3, 0, rng), fringes(0.1, 0, rng), everywhere) == pytest.approx(0.2)
    # Noise s in each of N frames of amplitude 1 gives s sqrt(2 / N) rad; of 2000 pixels within 10 % in 1e10 runs.
    noisy = phase_rms(fringes(0, 0.02, rng), fringes(0, 0, rng), everywhere)
    assert noisy == pytest.approx(0.02 * np.sqrt(2 / 12), rel=0.1)


def test_the_mean_of_equal_pictures_is_a_standard_error_from_zero():
    """Mean square of 400 draws of unit variance: within 35 % in all but one run of a million."""
    rng = np.random.default_rng(1)
    drawn = [z([rng.standard_normal(SHAPE), rng.standard_normal(SHAPE)]) for _ in range(400)]
    assert np.mean(np.square(drawn)) == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize(
    ("brighter", "phase", "holds"),
    [(1.0, 0.0, [True, True]), (1.01, 0.0, [False, True]), (1.0, 0.01, [True, False])],
)
def test_renderers_of_other_light_or_other_phase_are_told_apart(brighter, phase, holds):
    """The false-alarm rate of each row is that of ``SIGMAS`` = 4, one in 16 000."""
    rng = np.random.default_rng(1)
    ours, theirs = ([fringes(p, 0.1, rng) for _ in range(2)] for p in (0.0, phase))
    rows = same_light_rows([brighter * t for t in theirs], ours, np.ones(SHAPE, bool), "the other")
    assert [row.holds for row in rows] == holds
    assert all(row.limit == SIGMAS for row in rows)
