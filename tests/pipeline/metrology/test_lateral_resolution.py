"""Height transfer of chirps and a star that were blurred by known optics."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.lateral_resolution import (
    HeightTransfer,
    height_transfer,
    lateral_period_limit,
    whole_cycles,
)

AMPLITUDE = 0.01
PIXEL = 0.0025
LONG, SHORT, LENGTH = 0.3, 0.03, 6.0  # the chirp's periods at its ends and its length: log-linear in between
SIGMA = 0.018  # of the Gaussian blur, mm
LIMIT = np.pi * SIGMA * np.sqrt(2 / np.log(2))
"""exp(-2 π² σ² / p²) is one half."""


def chirp() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (n,), local periods and heights of a chirp, with 1 mm of its ends' periods beyond both ends."""
    x = np.arange(-1.0, LENGTH + 1.0, PIXEL)
    share = np.clip(x / LENGTH, 0, 1)
    period = LONG * (SHORT / LONG) ** share
    phase = np.cumsum(2 * np.pi * PIXEL / period) - np.pi * PIXEL / period  # the integral up to x itself
    return x, period, AMPLITUDE * np.cos(phase)


X, PERIOD, TRUE = chirp()
INSIDE = (X > 0) & (X < LENGTH)


def airy(z: np.ndarray, cutoff_period: float) -> np.ndarray:
    """Heights as an incoherent aberration-free lens would carry them over."""
    f = np.fft.rfftfreq(len(z), PIXEL) * cutoff_period
    inside = np.minimum(f, 1)
    transfer = 2 / np.pi * (np.arccos(inside) - inside * np.sqrt(1 - inside**2))
    return np.fft.irfft(np.fft.rfft(z) * transfer, n=len(z))


def limit_of(measured: np.ndarray, strips: np.ndarray | None = None):
    """Of measured heights (rows, n) of the chirp, all of whose rows are one profile."""
    rows = len(measured)
    along, period, true = (np.tile(a[INSIDE], rows) for a in (X, PERIOD, TRUE))
    groups = np.tile(whole_cycles(X[INSIDE], PERIOD[INSIDE]), rows)
    assert len(along) == len(groups)
    return lateral_period_limit(height_transfer(groups, period, true, measured[:, INSIDE].ravel(), strips))


def test_groups_are_whole_cycles():
    """A cosine of constant period 0.1: between starts of cycles lie 0.1 mm; the last, begun cycle does not count."""
    x = np.arange(0, 1.04, 0.001)
    groups = whole_cycles(np.random.default_rng(1).permutation(x), np.full(len(x), 0.1), cycles=2)
    assert set(groups.tolist()) == {-1, 0, 1, 2, 3, 4}
    ordered = whole_cycles(x, np.full(len(x), 0.1), cycles=2)
    np.testing.assert_array_equal(ordered[[10, 150, 210, 450, 990, 1010]], [0, 0, 1, 2, 4, -1])


def test_the_transfer_of_a_gaussian_is_gaussian():
    measured = gaussian_filter1d(TRUE, SIGMA / PIXEL)
    groups = whole_cycles(X[INSIDE], PERIOD[INSIDE])
    transfer = height_transfer(groups, PERIOD[INSIDE], TRUE[INSIDE], measured[INSIDE] + 0.3)
    assert np.all(np.diff(transfer.period) < 0)
    np.testing.assert_allclose(
        transfer.ratio[1:-1], np.exp(-2 * np.pi**2 * SIGMA**2 / transfer.period[1:-1] ** 2), atol=0.02
    )


@pytest.mark.parametrize("sigma", [0.010, 0.018, 0.030])
def test_a_gaussian_halves_the_height_at_a_known_period(sigma):
    found = limit_of(gaussian_filter1d(TRUE, sigma / PIXEL)[None])
    assert found.period == pytest.approx(LIMIT * sigma / SIGMA, rel=0.001)


def test_a_perfect_lens_halves_the_height_at_2_47_times_its_cutoff_period():
    """The modulation transfer of a circular pupil is 1/2 at 0.4040 of the cut-off frequency."""
    found = limit_of(airy(TRUE, 0.04)[None])
    assert found.period == pytest.approx(0.04 / 0.4040, rel=0.001)


@pytest.mark.parametrize("filtered", [False, True])
def test_the_limit_scatters_as_it_says_with_raw_and_with_filtered_noise(filtered):
    """80 maps of 12 rows: standardised errors have mean 0 and variance 1, within 4.5 and 5 of their sd.

    Raw maps are judged by their residuals. Filtered noise is correlated along the row, so that each row is a strip of
    its own; 12 of them know their sd to 1 in 5, which widens the variance to that of Student's t with 11 degrees, about
    11 / 9, less where several groups pool. The tolerance holds that share, too.
    """
    rng, blurred = np.random.default_rng(5), gaussian_filter1d(TRUE, SIGMA / PIXEL)
    count = int(INSIDE.sum())
    strips = np.repeat(np.arange(12), count) if filtered else None
    z = []
    for _ in range(80):
        noise = 2e-3 * rng.standard_normal((12, len(X)))
        if filtered:
            noise = gaussian_filter1d(noise, 3.0, axis=1)
        found = limit_of(blurred + noise, strips)
        z.append((found.period - LIMIT) / found.sd)
    tolerance = 5 * np.sqrt(2 / 79)
    assert abs(np.mean(z)) < 4.5 / np.sqrt(80) * (np.sqrt(11 / 9) if filtered else 1)
    assert 1 - tolerance < np.var(z, ddof=1) < (11 / 9 if filtered else 1) * (1 + tolerance)


@pytest.mark.parametrize("in_strips", [False, True])
def test_strips_know_how_much_filtered_noise_scatters_and_residuals_do_not(in_strips):
    """Ratios of 60 maps against the mean of all: noise alike over 10 px leaves far less than n independent errors.

    About 30 groups of 12 strips each: the variance of Student's t with 11 degrees is 11 / 9, less for the mean taken
    out; its scatter over 1800 values, 5 sd at sqrt(3 / 1800) each, stays within a quarter. Without strips it is far
    beyond.
    """
    rng, blurred, count = np.random.default_rng(6), gaussian_filter1d(TRUE, SIGMA / PIXEL), int(INSIDE.sum())
    groups = np.tile(whole_cycles(X[INSIDE], PERIOD[INSIDE]), 12)
    period, true = np.tile(PERIOD[INSIDE], 12), np.tile(TRUE[INSIDE], 12)
    strips = np.repeat(np.arange(12), count) if in_strips else None
    transfers = []
    for _ in range(60):
        noise = gaussian_filter1d(2e-3 * rng.standard_normal((12, len(X))), 3.0, axis=1)
        transfers.append(height_transfer(groups, period, true, (blurred + noise)[:, INSIDE].ravel(), strips))
    ratios, sds = (np.array([getattr(t, name) for t in transfers]) for name in ("ratio", "ratio_sd"))
    variance = np.var((ratios - ratios.mean(axis=0)) / sds)
    if in_strips:
        assert variance == pytest.approx(11 / 9, rel=0.25)
    else:
        assert variance > 2.5


def test_a_siemens_star_has_the_same_limit():
    """36 petals, rings of equal steps in the logarithm of the radius; voids in a sector."""
    size, sigma_px = 700, 5.0
    v, u = np.indices((size, size)) - (size - 1) / 2
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    true = np.cos(36 * angle)
    measured = gaussian_filter(true, sigma_px)
    measured[(angle > 0.5) & (angle < 0.6)] = np.nan
    edges = np.geomspace(60, 330, 40)
    groups = np.digitize(radius, edges) - 1
    groups[groups == len(edges) - 1] = -1
    transfer = height_transfer(
        groups.ravel(), (2 * np.pi * radius / 36).ravel(), true.ravel(), measured.ravel(),
        np.floor((angle + np.pi) / (2 * np.pi) * 12).astype(int).ravel() % 12,
    )  # fmt: skip
    found = lateral_period_limit(transfer)
    assert found.period == pytest.approx(LIMIT / SIGMA * sigma_px, rel=0.01)
    assert found.groups >= 10
    assert found.n == transfer.n[np.abs(np.log(transfer.period / found.period)) < np.log(1.4)].sum()


def test_scaling_all_lengths_scales_the_limit():
    groups = whole_cycles(X[INSIDE], PERIOD[INSIDE])
    measured = gaussian_filter1d(TRUE, SIGMA / PIXEL)[INSIDE]
    one = lateral_period_limit(height_transfer(groups, PERIOD[INSIDE], TRUE[INSIDE], measured))
    other = lateral_period_limit(height_transfer(groups, 7 * PERIOD[INSIDE], 7 * TRUE[INSIDE], 7 * measured))
    assert other.period == pytest.approx(7 * one.period)
    assert other.sd == pytest.approx(7 * one.sd)


def test_relief_that_does_not_show_the_limit_is_told():
    groups = whole_cycles(X[INSIDE], PERIOD[INSIDE])
    period, true = PERIOD[INSIDE], TRUE[INSIDE]
    for call, told in (
        (lambda: lateral_period_limit(height_transfer(groups, period, true, 0.9 * true)), "does not fall through"),
        (lambda: lateral_period_limit(height_transfer(groups, period, true, 0.2 * true)), "does not fall through"),
        (lambda: height_transfer(groups, period, true, np.full(len(true), np.nan)), "no group"),
        (lambda: height_transfer(groups, period[1:], true, true), "one length"),
        (
            lambda: lateral_period_limit(
                HeightTransfer(np.array([2.0, 1, 0.5]), np.array([0.9, 0.6, 0.2]), *[np.ones(3)] * 2)
            ),
            "at least 6",
        ),
    ):
        with pytest.raises(InputError, match=told):
            call()
