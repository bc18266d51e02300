"""A Gray code says where a pixel is, also on the edges of its stripes, or says nothing."""

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from greenough.instrument.errors import InputError
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.gray_code import locate, stripe_patterns

COLS = 1024


def test_codes_of_neighbours_differ_in_one_bit_and_count():
    patterns = stripe_patterns(COLS, 16, 6)
    assert set(np.unique(patterns)) == {0, 255}
    codes = patterns[:, ::16] > 0  # (bits, stripes)
    assert (np.abs(np.diff(codes.astype(int), axis=1)).sum(axis=0) == 1).all()
    assert len(np.unique(codes, axis=1).T) == 64
    # The binary number of a Gray code is the running exclusive or of its bits; in integers, of its right shifts.
    word = np.packbits(codes[::-1], axis=0, bitorder="little")[0].astype(int)
    binary = word.copy()
    for shift in (1, 2, 4):
        binary ^= binary >> shift
    assert binary.tolist() == list(range(64))


@given(blur=st.floats(0.01, 3.0), width=st.sampled_from([16, 20.5, 33]), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_every_pixel_lies_within_its_window_whatever_the_blur(blur, width, seed):
    rng = np.random.default_rng(seed)
    bits = int(np.ceil(np.log2(COLS / width)))
    sharp = stripe_patterns(COLS, width, bits)
    white = gaussian_filter1d(sharp.astype(float), blur, axis=1)[:, None]  # (bits, 1, cols)
    white, black = (values + 2 * rng.standard_normal(white.shape) for values in (white, 255 - white))
    window = locate(white, black, width)
    column = np.arange(COLS)[None]
    known = np.isfinite(window.centre)
    assert known.mean() > 0.98
    assert (np.abs(window.centre - column)[known] <= window.half_width[known] + 0.5).all()


def test_one_period_and_a_blurred_code_of_its_width_make_no_wrong_order():
    fringes = FringeSet((16,), (4,), field=COLS)
    column = np.broadcast_to(np.arange(COLS), (50, COLS))
    rng = np.random.default_rng(5)
    noisy = [120 + 80 * np.cos(2 * pi * column / 16 + pi * n / 2) for n in range(4)] + rng.normal(0, 2, (4, 50, COLS))
    grey = gaussian_filter1d(stripe_patterns(COLS, 16, 6).astype(float), 2.0, axis=1)
    white = grey[:, None] + rng.normal(0, 2, (6, 50, COLS))
    for black in (255 - grey[:, None] + rng.normal(0, 2, (6, 50, COLS)), np.full((1, 50, COLS), 127.5)):
        phase_map = decode(noisy, fringes, window=locate(white, black, 16))
        assert phase_map.valid.mean() > 0.99
        assert np.nanmax(np.abs(phase_map.absolute - 2 * pi * column / 16)) < 0.3


def test_shadows_and_two_doubtful_bits_say_nothing():
    white = np.array([[200.0, 101, 2], [200.0, 99, 3], [100.0, 200, 2]])[:, None]
    black = np.array([[0.0, 100, 2], [0.0, 101, 2], [100.0, 0, 2]])[:, None]
    centre = locate(white, black, 10).centre[0]
    assert np.isfinite(centre).tolist() == [True, False, False]


@pytest.mark.parametrize(("bits", "others", "width"), [(0, 1, 10), (31, 31, 10), (3, 2, 10), (3, 3, 0)])
def test_what_is_no_code_is_refused(bits, others, width):
    with pytest.raises(InputError, match="Gray code"):
        locate(np.zeros((bits, 2, 2)), np.zeros((others, 2, 2)), width)
