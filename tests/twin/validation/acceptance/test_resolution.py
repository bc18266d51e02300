"""Claims about the lateral resolution, on relief that was lowered by a known share."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.scenes.chirp import chirp, period, relief
from greenough.twin.validation.acceptance import resolution
from greenough.twin.validation.acceptance.relief_transfer import relief_transfer

PIXEL_MM = 0.0099


@pytest.fixture
def along_y(setup, measured, grid, by_name):
    """Rows of a chirp of which the predicted share is left at each period, as if the blur were ``wider`` times as wide.

    Fringes of 21.6 px.
    """

    def made(wider: float, seed: int = 0):
        x, y = grid(6.0, 0.8, PIXEL_MM)
        z, _ = relief(x)
        true = np.stack([x, y, z], axis=-1)
        absolute = np.broadcast_to(2 * np.pi / 21.6 * np.arange(x.shape[1]), x.shape)
        artefact = measured(chirp(), true, phase_map=SimpleNamespace(absolute=absolute), sigma=2e-4, seed=seed)
        predicted = relief_transfer(setup, artefact.phase_map, artefact.judged, filtered=False)
        periods = np.geomspace(0.03, 0.41, 200)
        left = np.array([predicted.along(wider * PIXEL_MM / each) for each in periods])
        lowered = z * np.interp(period(x), periods, left)
        points = np.stack([x, y, lowered], axis=-1)
        again = measured(chirp(), true, points=points, phase_map=artefact.phase_map, sigma=2e-4, seed=seed)
        return by_name(resolution.rows_of_chirp(setup, "y", again))

    return made


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_predicted_is_found_and_holds(along_y, seed):
    row = along_y(1.0, seed)["lateral_period_limit_y"]
    assert row.ratio == pytest.approx(1, abs=max(0.02, 4.5 * row.u / row.value))
    assert row.holds


def test_a_wider_blur_is_found_and_fails(along_y):
    row = along_y(1.2)["lateral_period_limit_y"]
    assert row.ratio == pytest.approx(1.2, abs=0.03)
    assert row.holds is False


def test_without_a_point_spread_there_is_no_prediction(setup, along_y):
    setup.calibration.point_spread = None
    with pytest.raises(InputError, match="no point spread"):
        along_y(1.0)
