"""Fringe orders where no period spans the field: right or not given, however large the noise."""

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.grey_variance import GreyVariance
from greenough.pipeline.order_search import ColumnWindow

HETERODYNE = FringeSet((70, 64, 59), (4, 4, 4), field=1024)


def frames(column, fringes, amplitude=90.0):
    """Frames as the fringe set's docstring writes them, (frames, rows, cols) float32."""
    return np.stack(
        [
            120 + amplitude * np.cos(2 * pi * column / period + fringes.start + fringes.sign * 2 * pi * n / steps)
            for period, steps in zip(fringes.periods, fringes.steps, strict=True)
            for n in range(steps)
        ]
    ).astype(np.float32)


@given(
    periods=st.sampled_from([(70, 64, 59), (31, 29), (100, 37.5, 11), (21.3, 18.7, 16.1, 13.9)]),
    start=st.floats(-4, 4),
    sign=st.sampled_from([1, -1]),
    steps=st.integers(3, 7),
)
@settings(max_examples=25)
def test_exact_fringes_of_any_periods_start_and_sign_give_their_column(periods, start, sign, steps):
    field = 800 if periods != (31, 29) else 860
    fringes = FringeSet(periods, (steps,) * len(periods), field=field, start=start, sign=sign)
    column = np.linspace(0, field - 1, 3000).reshape(1, -1)
    phase_map = decode(frames(column, fringes), fringes)
    assert phase_map.valid.all()
    np.testing.assert_allclose(phase_map.absolute, 2 * pi * column / periods[-1], atol=5e-3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sigma_dn", [2.0, 8.0, 25.0])
def test_noise_gives_no_wrong_order(seed, sigma_dn):
    rng = np.random.default_rng(seed)
    column = rng.uniform(0, 1023, (100, 1000))
    noisy = frames(column, HETERODYNE) + sigma_dn * rng.standard_normal((12, *column.shape)).astype(np.float32)
    phase_map = decode(noisy, HETERODYNE)
    error = (phase_map.absolute - 2 * pi * column / 59)[phase_map.valid]
    # An order is allowed to be wrong once in a million: of 100 000 pixels more than two are in a test of 9 by 0.0014.
    assert (np.abs(error) > pi).sum() <= 2
    if sigma_dn == 2.0:
        assert phase_map.valid.mean() > 0.999


def test_harmonics_that_no_variance_knows_of_do_not_exchange_orders():
    column = np.linspace(5, 1000, 4000).reshape(1, -1)
    for gamma in (1.4, 2.2):
        bent = 255 * (frames(column, HETERODYNE) / 255) ** gamma
        phase_map = decode(bent, HETERODYNE)
        error = phase_map.absolute - 2 * pi * column / 59
        assert phase_map.valid.any()
        assert np.nanmax(np.abs(error)) < 1.0


def test_the_margin_keeps_slightly_bent_fringes_from_wrong_orders():
    """Three steps take the second harmonic for fringes: phases err by much more than the noise that is stated.

    Stronger bending is not caught: the phases themselves then fit another order best.
    """
    fringes = FringeSet((70, 64, 59), (3, 3, 3), field=1024)
    column = np.linspace(5, 1000, 20_000).reshape(1, -1)
    bent = 255 * (frames(column, fringes) / 255) ** 1.4
    error = decode(bent, fringes, GreyVariance(0.01, 0.0)).absolute - 2 * pi * column / 59
    assert not (np.abs(error) > pi).any()


def test_a_window_tells_orders_apart_that_repeat():
    fringes = FringeSet((100, 50), (4, 4), field=1000)
    column = np.linspace(2, 990, 2000).reshape(1, -1)
    window = ColumnWindow(column + 20.0, np.full(column.shape, 45.0))
    phase_map = decode(frames(column, fringes), fringes, window=window)
    assert phase_map.valid.all()
    np.testing.assert_allclose(phase_map.absolute, 2 * pi * column / 50, atol=5e-3)
    nowhere = ColumnWindow(np.full(column.shape, np.nan), window.half_width)
    assert not decode(frames(column, fringes), fringes, window=nowhere).valid.any()


@pytest.mark.parametrize(
    ("fringes", "half_width", "sentence"),
    [
        (FringeSet((100, 50), (4, 4), field=1000), None, "repeat together every 100 columns"),
        (FringeSet((50,), (4,), field=1000), None, "does not span the field"),
        (FringeSet((50,), (4,), field=1000), 60.0, "stripes leave 120 columns open"),
    ],
)
def test_sets_that_cannot_tell_orders_are_refused(fringes, half_width, sentence):
    stack = frames(np.zeros((2, 2)), fringes)
    window = None if half_width is None else ColumnWindow(np.zeros((2, 2)), np.full((2, 2), half_width))
    with pytest.raises(InputError, match=sentence):
        decode(stack, fringes, window=window)
