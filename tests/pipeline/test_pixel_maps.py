import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.pipeline.bundle_data import block_map
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.phase_height import MIN_PLANES, MISFIT_RAD
from greenough.pipeline.pixel_maps import model_maps, plane_residuals
from greenough.pipeline.projector_model import ProjectorModel

SHAPE = (243, 318)  # no multiple of anything
LOW, HIGH = -1.42, 1.47


@pytest.fixture(scope="module")
def instrument() -> InstrumentModel:
    """Pixels of 40 µm; fields of a few hundredths of a px and of a radian, as lenses have them."""
    rng = np.random.default_rng(1)
    camera = CameraModel(5670.0, 5680.0, -0.3, 160.0, 118.0, -1.0, 0.0, -0.004, 0.003, SHAPE)
    look = np.eye(4)
    look[:3, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    look[:3, 3] = [0.1, -0.2, 224.56]
    seen = DepthField((0.0, 0.0), (0.031, 0.024), (1, 5), (1, 5), 1.5)
    lit = DepthField((159.0, 0.0), (205.0, 5.3), (0, 6), (0, 5), 1.5)
    return InstrumentModel(
        ImagingPath(camera, look, seen, rng.normal(0, 0.005, (2, len(seen.orders)))),
        ProjectorModel(
            np.array([159.0, 29.2, 0.4, 3.1, 4.6e-4, 1e-5, -4.4e-3]), lit, rng.normal(0, 0.01, len(lit.orders))
        ),
        np.empty(0),
    )


@pytest.fixture(scope="module")
def maps(instrument):
    return model_maps(instrument, LOW, HIGH)


def everywhere(height):
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.stack([u.ravel(), v.ravel()], axis=-1), np.full(u.size, float(height))


@pytest.mark.parametrize("height", [-1.4, -0.333, 0.0, 0.9, 1.45])
def test_every_pixel_measures_what_the_model_says_to_hundredths_of_a_micrometre(instrument, maps, height):
    rays, relation = maps
    truth = instrument.points(*everywhere(height))
    z = relation.height(instrument.projector.phase(truth).reshape(SHAPE))
    assert np.abs(z - height).max() < 0.03e-3
    assert np.abs(rays.points(z).reshape(-1, 3) - truth).max() < 0.03e-3


def test_neighbouring_pixels_have_no_pattern_of_their_own(instrument, maps):
    """Third differences of a smooth map are rounding alone: 24 bits of 9 mm, of 300 rad."""
    rays, relation = maps
    plane = instrument.projector.phase(instrument.points(*everywhere(0.3))).reshape(SHAPE)
    for values in (*np.moveaxis(rays.origin, -1, 0), relation.height(plane)):
        assert np.abs(np.diff(values.astype(float), n=3, axis=1)).max() < 0.02e-3


def planes(instrument, heights, seed=2, noise=0.0):
    rng = np.random.default_rng(seed)
    points = [instrument.points(*everywhere(height)) for height in heights]
    return np.stack([instrument.projector.phase(xyz).reshape(SHAPE) + rng.normal(0, noise, SHAPE) for xyz in points])


@pytest.mark.slow
def test_planes_that_lie_as_stated_leave_nothing_over(instrument, maps):
    rays, relation = maps
    heights = np.linspace(-1.3, 1.4, 9)
    found = plane_residuals(relation, rays, planes(instrument, heights), lambda k, xy: np.full(len(xy), heights[k]))
    assert np.abs(found.blocks_um).max() < 0.03
    assert found.pixels_um.max() < 0.03
    assert (found.count == 9).all()


@pytest.mark.slow
def test_a_plane_that_lies_otherwise_shows_with_its_sign_and_shape(instrument, maps):
    rays, relation = maps
    heights = np.linspace(-1.3, 1.4, 9)
    phases = planes(instrument, heights, noise=0.01)

    def stated(k, xy):
        return heights[k] - (k == 4) * 2e-3 * xy[:, 0]

    found = plane_residuals(relation, rays, phases, stated)
    expected = block_map(2.0 * rays.points(np.full(SHAPE, heights[4]))[..., 0])
    # A block of 49 pixels: 0.16 mm/rad times 0.01 rad over 7; five of them among 1500 blocks.
    assert np.abs(found.blocks_um[4] - expected).max() < 5 * 1.8 / 7
    assert np.abs(found.blocks_um[5]).max() < 5 * 1.8 / 7
    upright = np.abs(rays.origin[..., 0]) < 0.3  # where the slope adds nothing
    assert np.sqrt(np.mean(found.pixels_um[upright] ** 2)) == pytest.approx(1.6, rel=0.1)


@pytest.mark.slow
def test_planes_that_a_pixel_did_not_see_or_that_miss_the_model_do_not_count(instrument, maps):
    rays, relation = maps
    heights = np.linspace(-1.3, 1.4, MIN_PLANES + 1)
    phases = planes(instrument, heights)
    phases[0, :, 200:] = np.nan
    phases[:2, :, 250:] = np.nan
    phases[-1, 100, 50] += 1.1 * MISFIT_RAD
    phases[3, 100, 60] += 0.9 * MISFIT_RAD
    found = plane_residuals(relation, rays, phases, lambda k, xy: np.full(len(xy), heights[k]))
    assert (found.count[:, 250:] == MIN_PLANES - 1).all()
    assert found.count[100, 50] == found.count[100, 220] == MIN_PLANES
    assert found.count[100, 60] == MIN_PLANES + 1
    seen = relation.within(relation.z_range, found.count >= MIN_PLANES)
    assert not seen.valid[:, 250:].any()
    assert seen.valid[:, :250].all()
