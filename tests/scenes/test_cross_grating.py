"""Claims about the grating for the mapping of x and y."""

import numpy as np

from greenough.scenes.cross_grating import DRAWING, ERRORS, cross_grating

BOARD_PITCH_MM = 0.65


def test_the_dots_are_where_their_certificate_says():
    grating = cross_grating(4)
    centres = grating.as_built["centres_mm"]
    dots = grating.parts[0]
    assert centres.shape == (DRAWING.rows * DRAWING.cols, 3)
    # A dot has a fan around its centre: no other point is the corner of as many triangles.
    uses = np.bincount(dots.faces.ravel())
    middles = dots.vertices[uses == uses.max()]
    order = np.lexsort(middles[:, :2].T)
    np.testing.assert_allclose(middles[order], centres[np.lexsort(np.round(centres[:, :2], 9).T)], atol=1e-8)


def test_print_errors_are_those_of_a_grating_better_than_the_board():
    off = np.array([cross_grating(seed).as_built["centres_mm"][:, :2] for seed in range(3)]) - DRAWING.centres()
    scatter = off - np.mean(off, axis=1, keepdims=True)
    by_scale = ERRORS.scale_ppm * 1e-6 * np.abs(DRAWING.centres()).max()
    assert 0.5 * ERRORS.print_sd_um < 1e3 * scatter.std() < ERRORS.print_sd_um + 1e3 * by_scale
    assert len({tuple(each.ravel()) for each in off}) == 3


def test_its_pitch_is_no_multiple_of_the_board_s_and_it_fills_the_field():
    assert abs(DRAWING.pitch_mm / BOARD_PITCH_MM - 1) > 0.1
    reach = np.ptp(DRAWING.centres(), axis=0)
    assert (reach >= 0.8 * np.array([8.0, 6.0])).all()
    assert (reach <= [8.0, 6.0]).all()
