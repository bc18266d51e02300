"""What a finite number of light paths per pixel does to phases and spots, before the camera adds its noise.

The reference has 4096 nodes per pixel, shifted at random in every pixel. Two of them, of different seeds, tell its own
noise, which is subtracted in quadrature. They are rendered in a crop of the picture.
"""

from typing import Any

import cv2
import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.spot_fit import fit_spots
from greenough.pipeline.spots import detect_spots
from greenough.twin.renderer import mi
from greenough.twin.validation.evaluation import smooth

AIRY_RADIUS_PX = 2.16
RIM_PX = 10  # of the light: its edge is blurred into the phase there, which is optics and not sampling
UM_PER_RAD = 163.1  # dz / dPhi on the axes: 12 columns of 17.835 um / (2 pi), over 2 sin 6 degrees
REFERENCE_NODES = 4096
GREY_PER_RADIANCE = 600.0  # a white Lambertian plane has 1 / pi
STAGE_ERRORS = ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")

Crop = tuple[int, int, int, int]  # first column and row, columns, rows


Twin = tuple[gt.TwinRig, gt.Bench, FringeSet]


def opened(*overrides: str) -> Twin:
    rig, bench = gt.open("twin", [*(f"twin.stage.{name}=0" for name in STAGE_ERRORS), *overrides], run="sampling")
    return rig, bench, FringeSet(rig.procedure.periods_px, rig.procedure.steps)


@pytest.fixture(scope="module")
def twin() -> Twin:
    """With ideal lenses."""
    return opened("twin.optics.glass=false")


def rendered(rig: gt.TwinRig, patterns: np.ndarray, crop: Crop, seed: int = 0, **integrator: Any) -> np.ndarray:
    """Radiance of all patterns in a crop, (N, rows, cols), with other settings of the integrator."""
    column, row, columns, rows = crop
    scene = rig.scene_dict(patterns)
    film = {"crop_offset_x": column, "crop_offset_y": row, "crop_width": columns, "crop_height": rows}
    scene["sensor"] = scene["sensor"] | {"film": scene["sensor"]["film"] | film}
    if "nodes" in integrator:
        for lens in ("sensor", "projector"):
            if "prescription" in scene[lens]:
                scene[lens] = scene[lens] | {"pupil_nodes": integrator["nodes"]}
        for name in ("node_table", "edge_table"):
            scene["integrator"].pop(name, None)
    scene["integrator"] = scene["integrator"] | integrator
    loaded = mi.load_dict(scene)
    channels = loaded.integrator().render_channels(loaded, loaded.sensors()[0], seed)
    return np.stack([np.array(channel).reshape(rows, columns) for channel in channels])


def references(rig: gt.TwinRig, patterns: np.ndarray, crop: Crop, **integrator: Any) -> list[np.ndarray]:
    many = {"nodes": REFERENCE_NODES, "nodes_indirect": REFERENCE_NODES}
    more = many | {"shift_per_pixel": True, "smoothing": 0} | integrator
    return [rendered(rig, patterns, crop, seed, **more) for seed in (1, 2)]


def decoded(stack: np.ndarray, fringes: FringeSet) -> PhaseMap:
    return decode((GREY_PER_RADIANCE * stack).astype(np.float32), fringes)


def beyond(noise: float, difference: np.ndarray) -> float:
    """RMS of a difference from the mean of two references with the reference's ``noise`` taken out."""
    assert np.isfinite(noise)
    assert np.isfinite(difference).all()
    return float(np.sqrt(max(0.0, np.mean(difference**2) - noise**2)))


@pytest.mark.parametrize("z", [-1.45, 0.0, 1.45])
def test_a_plane_is_as_smooth_as_its_best_polynomial_to_200_nm(twin, figure, z):
    rig, bench, fringes = twin
    rig.operator.place(Placement("plane"))
    rig.stage.move_to_mm(z)
    phase = decoded(rig.irradiance(fringes.patterns(*rig.projector.shape)), fringes)
    lit = bench.truth().lit_and_seen.astype(np.uint8)
    rig.stage.move_to_mm(0.0)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
    judged = cv2.erode(lit, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)
    assert judged.mean() > 0.4
    assert phase.valid[judged].all()
    row, column = np.nonzero(judged)
    x, y = 2 * column / rig.camera.shape[1] - 1, 2 * row / rig.camera.shape[0] - 1
    terms = np.stack([x**i * y**j for i in range(7) for j in range(7 - i)], axis=-1)
    values = phase.absolute[judged].astype(float)
    left = values - terms @ np.linalg.lstsq(terms[::11], values[::11], rcond=None)[0]
    floor = UM_PER_RAD * float(left.std())
    figure(f"sampling floor: plane at {z} mm beside its best surface of 6th order, RMS", floor, 0.2, "um")
    assert floor <= 0.2


@pytest.mark.parametrize("glass", ["false", "true"])
def test_spots_lie_where_many_nodes_put_them(figure, glass):
    rig, _, fringes = opened(f"twin.optics.glass={glass}")
    patterns = fringes.patterns(*rig.projector.shape)[[12, 18]]  # opposite phases: their mean is the background
    crop = (820, 240, 200, 150)  # away from the axes
    rig.operator.place(Placement("board", posture=2))
    found = detect_spots(rig.irradiance(fringes.patterns(*rig.projector.shape)).mean(axis=0) * 1e3, rig.board)
    corner, size = np.array(crop[:2]), np.array(crop[2:])
    inside = np.all((found.centres_px > corner + 30) & (found.centres_px < corner + size - 30), axis=1)
    assert inside.sum() >= 2

    def centres(stack: np.ndarray) -> np.ndarray:
        return fit_spots(stack.mean(axis=0) * 1e3, found.centres_px[inside] - corner, found.axes_px[inside]).centres_px

    first, second = (centres(stack) for stack in references(rig, patterns, crop, bounces=1))
    noise = float(np.sqrt(np.mean((first - second) ** 2))) / 2
    bias = beyond(noise, centres(rendered(rig, patterns, crop, bounces=1)) - (first + second) / 2)
    lenses = {"false": "ideal lenses", "true": "glass"}[glass]
    figure(f"spot centres, {lenses}, against {REFERENCE_NODES} nodes (noise {noise:.4f}), RMS", bias, 0.01, "px")
    assert bias <= 0.01


GLINTS = pytest.mark.xfail(
    strict=True,
    reason="the bar of 0.3 um is not met: glints between solder balls carry other fringe phases, and where they rival "
    "the direct light 16 guided paths a pixel are too few; more (twin.render.nodes_indirect) cost time in proportion",
)


@pytest.mark.parametrize(
    ("sample", "bounces", "glass"),
    [
        ("coin", 1, "false"),
        ("coin", 2, "false"),
        ("bga", 1, "false"),
        pytest.param("bga", 2, "false", marks=GLINTS),
        ("coin", 1, "true"),
        ("bga", 1, "true"),
    ],
)
def test_heights_are_those_of_many_nodes(figure, sample, bounces, glass):
    rig, bench, fringes = opened(f"twin.optics.glass={glass}")
    patterns = fringes.patterns(*rig.projector.shape)
    rig.operator.place(Placement(sample))
    # With interreflections the reference is slow: a smaller crop, in the same place.
    column, row, columns, rows = crop = (592, 444, 96, 72) if bounces == 1 else (620, 465, 40, 30)
    stacks = references(rig, patterns, crop, bounces=bounces)
    first, second = (decoded(stack, fringes) for stack in stacks)
    mean = decoded((stacks[0] + stacks[1]) / 2, fringes)
    truth = smooth(bench.truth(), AIRY_RADIUS_PX)[row : row + rows, column : column + columns]
    phase = decoded(rendered(rig, patterns, crop, bounces=bounces), fringes)
    judged = truth & mean.valid & phase.valid & first.valid & second.valid
    assert judged.mean() > 0.4

    def height(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return UM_PER_RAD * (one - other)[judged]

    noise = height(first.absolute, second.absolute).std() / 2
    error = beyond(noise, height(phase.absolute, mean.absolute))
    what = {"false": "ideal lenses, ", "true": "glass, "}[glass]
    what += "direct light" if bounces == 1 else "with interreflections"
    figure(f"{sample}, {what}, against {REFERENCE_NODES} nodes (noise {noise:.3f}), RMS", error, 0.3, "um")
    assert error <= 0.3
