"""Claims about decoding beside others: the peers decode what we decode, and every row is there."""

import sys
from types import SimpleNamespace

import numpy as np

from greenough.pipeline.fringes import PAPER
from greenough.twin.validation.benchmarks import decoding, synthetic
from greenough.twin.validation.benchmarks.required import REQUIRED

SHAPE = (12, 320)
TRUE = synthetic.plane_phases(PAPER, SHAPE, np.zeros(1))[0]


def test_numpys_decoder_finds_the_phase_of_frames_with_little_noise():
    absolute = decoding.decode_by_numpy(synthetic.frames(PAPER, SHAPE, 0.2), PAPER)
    np.testing.assert_allclose(absolute, TRUE, atol=0.02)


def test_columns_of_fringes_become_phases_of_the_densest_set(monkeypatch):
    """Its own decoder need not be installed: what is given to it is held, and what it returns is made up."""
    given = {}

    class Fringes:
        def __init__(self, **settings):
            given.update(settings)

        def decode(self, stack):
            return None, None, (12 / (2 * np.pi) * TRUE)[None, ..., None]

    monkeypatch.setitem(sys.modules, "fringes", SimpleNamespace(Fringes=Fringes))
    decoded = decoding.decoder_of_fringes(PAPER, "precise")(synthetic.frames(PAPER, SHAPE, 1.0))
    np.testing.assert_allclose(decoded, TRUE, rtol=1e-6)
    assert given["mode"] == "precise"
    assert given["N"] == (PAPER.steps,)
    np.testing.assert_allclose(given["X"] / np.array(given["v"][0]), PAPER.periods)


def test_wrong_orders_are_counted_and_pixels_left_out_are_not():
    absolute = TRUE.copy()
    absolute[3, 4:9] += 2 * np.pi
    absolute[5, 7] -= 4 * np.pi
    absolute[6, 7] += 3.0
    absolute[7, 7] = np.nan
    assert decoding.wrong_orders(absolute, TRUE) == 6


def test_a_peer_with_fewer_wrong_orders_makes_the_row_fail(monkeypatch):
    hurt = np.where(np.arange(SHAPE[1]) < 5, TRUE + 2 * np.pi, TRUE)
    found = decoding.order_rows(PAPER, SHAPE, 3, {"worse": lambda stack: hurt})
    assert [row.holds for row in found if row.limit is not None] == [True]
    monkeypatch.setattr(decoding, "wrong_orders", lambda absolute, true: 0 if absolute is hurt else 1)
    found = decoding.order_rows(PAPER, SHAPE, 3, {"better": lambda stack: hurt})
    assert [row.holds for row in found if row.limit is not None] == [False]


def test_all_required_rows_are_there_but_those_of_a_peer_that_is_not(monkeypatch):
    monkeypatch.setattr(decoding, "find_spec", lambda name: None)
    found = {row.name for row in decoding.rows("twin", ["camera.rows=24", "camera.cols=320"])}
    assert {name for name in REQUIRED["decoding"] if "fringes, " not in name} <= found
    assert not any("against fringes" in name for name in found)
