"""Small twins, a scene for the plugins, and the statistics by which pictures are compared."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student
from scipy.stats import ttest_ind

import greenough.twin as gt
from greenough.twin.renderer import mi
from greenough.twin.scene import axis_frame

STABLE = (
    "twin.light.ambient=0",
    "twin.stability.flicker=0",
    "twin.stability.vibration_um=0",
    "twin.stability.table_drift_um=0",
    "twin.stability.path_drift_um=0",
)
# The whole field in coarse pixels, and lenses of which every effect is known in closed form.
SMALL = ("twin.optics.glass=false", "camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875")
PERFECT = (
    "twin.stage.position_sd_um=0",
    "twin.stage.straightness_sd_um=0",
    "twin.stage.pitch_roll_sd_urad=0",
    "twin.stage.axis_sd_deg=0",
    "twin.board.print_sd_um=0",
    "twin.board.scale_sd_ppm=0",
    "twin.board.bow_sd_um=0",
    "twin.board.wedge_sd_urad=0",
    "twin.board.ink_thickness_um=0",
)
NOISELESS = (
    "camera.bits=0",
    "twin.camera.shot_noise=false",
    "twin.camera.read_noise_e=0",
    "twin.camera.prnu=0",
    "twin.camera.dsnu_e=0",
)
PINHOLES = ("twin.optics.finite_aperture=false", "twin.optics.camera_diffraction=false")

Opener = Callable[..., tuple[gt.TwinRig, gt.Bench]]


@pytest.fixture(scope="session")
def small() -> Opener:
    """Opens a twin of 60 x 80 pixels with ideal lenses that does not change with time.

    ``perfect`` switches off mechanical errors, ``noiseless`` those of the camera, ``pinholes`` all blur of lenses.
    """

    def opened(
        *overrides: str,
        perfect: bool = False,
        noiseless: bool = False,
        pinholes: bool = False,
        run: str = "test",
        exposures_done: int = 0,
    ) -> tuple[gt.TwinRig, gt.Bench]:
        off = ((perfect, PERFECT), (noiseless, NOISELESS), (pinholes, PINHOLES))
        chosen = [*SMALL, *STABLE, *(setting for asked, settings in off if asked for setting in settings)]
        return gt.open("twin", [*chosen, *overrides], run=run, exposures_done=exposures_done)

    return opened


def chance_of(ours: np.ndarray, theirs: np.ndarray, paths: int) -> float:
    """Probability that two renderers of the same picture differ in some pixel as much as these, or more.

    Student's t in each pixel from the scatter over seeds, and Sidak's correction for the number of pixels. A test that
    asks for more than p refuses two equal renderers with probability p. Light that only few paths meet is counted, so
    the error of a mean is never taken to be less than the weight of one path.

    Parameters
    ----------
    ours, theirs : (seeds, ...)
        Independent renders.
    paths : int
        Light paths per pixel and render.
    """
    n = len(ours)
    one_path = max(ours.max(), theirs.max()) / (n * paths)
    variance = (ours.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / n + one_path**2
    statistic = np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / np.sqrt(variance)
    # At least n - 1 degrees of freedom, up to twice as many where both scatter alike.
    smallest = 2 * student.sf(statistic.max(), n - 1)
    return float(-np.expm1(statistic.size * np.log1p(-smallest)))


@pytest.fixture(scope="session")
def chance() -> Callable[[np.ndarray, np.ndarray, int], float]:
    return chance_of


def chance_of_brightness(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Probability that the mean light of two equal pictures, (seeds, ...), differs as much as here: Welch's t-test."""
    flat = [picture.reshape(len(picture), -1).mean(axis=1) for picture in (ours, theirs)]
    _, probability = ttest_ind(*flat, equal_var=False)
    return float(np.asarray(probability))


@pytest.fixture(scope="session")
def chance_brightness() -> Callable[[np.ndarray, np.ndarray], float]:
    return chance_of_brightness


class Scenery:
    """A tilted plane and a ball, lit by a projector of 12 x 16 pixels, seen by a camera of 30 x 40, 10 units away."""

    distance = 10.0
    focal_px = 60.0
    shape = (30, 40)
    mirrors = (12, 16)
    pitch = 0.4
    paths = 64

    def __init__(self) -> None:
        self.patterns = np.random.default_rng(0).integers(0, 256, (2, *self.mirrors), dtype=np.uint8)
        self.camera_pose = mi.ScalarTransform4f(axis_frame(-0.2, self.distance))
        self.projector_pose = mi.ScalarTransform4f(axis_frame(0.25, self.distance))
        self.film = {
            "type": "hdrfilm",
            "width": self.shape[1],
            "height": self.shape[0],
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }

    def bodies(self) -> dict[str, Any]:
        tilted = mi.ScalarTransform4f().rotate([0.3, 1, 0], 20).scale([6, 6, 1])
        plane = {"type": "rectangle", "to_world": tilted, "bsdf": {"type": "diffuse", "reflectance": 0.8}}
        ball = {"type": "sphere", "radius": 0.8, "center": [0.3, 0.2, 0.6]}
        return {"plane": plane, "ball": ball | {"bsdf": {"type": "diffuse", "reflectance": 0.5}}}

    def corner(self, bsdf: dict[str, Any]) -> dict[str, Any]:
        """Two planes of one material that face each other at 70 degrees, open towards the lenses."""
        turn = mi.ScalarTransform4f().rotate
        left, right = (
            turn([0, 1, 0], angle).translate([x, 0, 0]).scale([1.5, 3, 1]) for angle, x in ((55, -1.5), (-55, 1.5))
        )
        return {
            "left": {"type": "rectangle", "to_world": left, "bsdf": bsdf},
            "right": {"type": "rectangle", "to_world": right, "bsdf": bsdf},
        }

    def perspective(self, **changes: Any) -> dict[str, Any]:
        """Mitsuba's own camera."""
        fov = float(np.degrees(2 * np.arctan(self.shape[1] / 2 / self.focal_px)))
        sensor = {"type": "perspective", "to_world": self.camera_pose, "fov": fov, "fov_axis": "x", "film": self.film}
        return sensor | {"near_clip": 0.1, "far_clip": 1000.0} | changes

    def lens_sensor(self, **changes: Any) -> dict[str, Any]:
        sensor = {"type": "lens_sensor", "to_world": self.camera_pose, "film": self.film}
        return sensor | {"focal_length_px": self.focal_px, "focus_distance": self.distance} | changes

    def projector(self, pattern: int) -> dict[str, Any]:
        """Mitsuba's own projector, scaled from the irradiance at distance 1 (times pi) to that in our focused plane."""
        grey = (self.patterns[pattern] / 255).astype(np.float32)[..., None]
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(grey), "raw": True, "format": "variant"}
        return {
            "type": "projector",
            "to_world": self.projector_pose,
            "fov": float(np.degrees(2 * np.arctan(self.mirrors[1] * self.pitch / 2 / self.distance))),
            "fov_axis": "x",
            "scale": self.distance**2 / np.pi,
            "irradiance": texture | {"filter_type": "nearest", "wrap_mode": "clamp"},
        }

    def lens_projector(self, **changes: Any) -> dict[str, Any]:
        emitter = {
            "type": "lens_projector",
            "to_world": self.projector_pose,
            "patterns": mi.TensorXf(self.patterns.astype(np.float32)),
            "column_pitch": self.pitch,
            "row_pitch": self.pitch,
            "focus_distance": self.distance,
        }
        return emitter | changes

    def path(self, bounces: int = 1) -> dict[str, Any]:
        """Mitsuba's own integrator, without Russian roulette."""
        return {"type": "path", "max_depth": bounces + 1, "rr_depth": 100}

    def fringe(self, bounces: int = 1, **changes: Any) -> dict[str, Any]:
        return {"type": "fringe", "bounces": bounces, "shift_per_pixel": True} | changes

    def renders(
        self,
        sensor: dict[str, Any],
        emitter: dict[str, Any],
        integrator: dict[str, Any],
        bodies: dict[str, Any] | None = None,
        seeds: Sequence[int] = range(32),
    ) -> np.ndarray:
        """Independent pictures of one scene, (seeds, rows, cols, channels)."""
        parts = {"type": "scene", "sensor": sensor, "emitter": emitter, "integrator": integrator}
        scene = mi.load_dict(parts | (self.bodies() if bodies is None else bodies))
        return np.stack([np.array(mi.render(scene, spp=self.paths, seed=mi.UInt32(seed)), float) for seed in seeds])


@pytest.fixture(scope="session")
def scenery() -> Scenery:
    return Scenery()


@pytest.fixture(scope="session")
def native(scenery: Scenery) -> np.ndarray:
    """The scenery by nothing but Mitsuba's own plugins, one channel per pattern: (seeds, rows, cols, N)."""
    seeds = range(1000, 1032)
    channels = [
        scenery.renders(scenery.perspective(), scenery.projector(k), scenery.path(), seeds=seeds)
        for k in range(len(scenery.patterns))
    ]
    return np.concatenate(channels, axis=-1)
