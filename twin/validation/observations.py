"""What the pipeline would measure of one drawn instrument, without rendering a picture.

The instrument is the one that is rendered: the same lenses as they were assembled, board, postures, stage, drifts and
vibrations, drawn by the same seed and run. A pixel's light is the mean over the light paths that the renderer takes,
`greenough.twin.validation.light_paths.Nodes`, traced one by one; an edge is seen where that mean of paths puts it. What
decoding and fitting do to pixels is not simulated: their noise is drawn, of a size that rendered captures have shown.

Left out: the ink's thickness, which shifts all spots of a posture alike; blur of finite spots beyond the mean of their
edges; the facets of the board's mesh; harmonics of the fringes; flicker.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from greenough.instrument.contract import BLANK, Placement
from greenough.instrument.rigfile import RigFile
from greenough.pipeline.acquisition import RIM_PX
from greenough.pipeline.bundle_data import BundleData, PlaneBlocks, SpotPhases, block_side
from greenough.pipeline.camera_calibration import CameraCalibration, calibrate_camera
from greenough.pipeline.point_spread import PointSpread
from greenough.pipeline.slope_blur import freed_from_blur
from greenough.pipeline.spots import Spots
from greenough.scenes.board import PrintedBoard, blank_height, ceramic_height

from ..instability import Instability
from ..quadrature import nodes_of_direct_light
from ..scene import NODES_FLAT
from ..settings import TwinSettings
from ..stage import rigid
from ..workbench import Workbench
from .light_paths import STAGGER, LightPaths, Nodes, light_paths, renderer_nodes

EXPOSING = 2  # white frames until an exposure is set
RIM_POINTS = 6  # of a spot's circle
FOCUS_POINTS = 7  # along either side of the picture
_STEP = 1e-3  # mm or px of differences
_SPOT_MARGIN_PX = 6  # of ink around a spot that is measured
_INTERSECTIONS = 4


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    Parameters
    ----------
    centre_px : float
        Of one coordinate of a spot's centre.
    spot_phase_rad : float
        Of the phase at a spot.
    pixel_phase_rad : float
        Of the phase of a single pixel.
    """

    centre_px: float
    spot_phase_rad: float
    pixel_phase_rad: float


Relief = Callable[[np.ndarray], np.ndarray]
"""Height (n,) of a surface over (n, 2) x, y in its own frame."""


@dataclass(frozen=True, eq=False)
class Instrument:
    """One drawn instrument in one run, whose light paths can be asked for what they measure."""

    rig_file: RigFile
    settings: TwinSettings
    workbench: Workbench
    paths: LightPaths
    instability: Instability
    flat_nodes: Nodes
    edge_nodes: Nodes

    @property
    def chief(self) -> Nodes:
        """The one path through the middles of pixel, stops and spectrum."""
        zero = np.zeros((1, 2))
        return Nodes(zero, zero, zero, np.array([self.settings.optics.wavelength_um]))

    @property
    def rad_per_column(self) -> float:
        return 2 * np.pi / self.rig_file.procedure.periods_px[-1]


def build(rig_file: RigFile, settings: TwinSettings, run: str) -> Instrument:
    """The instrument that ``greenough.twin.open`` would open."""
    tables = (nodes_of_direct_light(count) for count in (NODES_FLAT, settings.render.nodes_edges))
    flat, edge = (renderer_nodes(table, settings) for table in tables)
    return Instrument(
        rig_file,
        settings,
        Workbench(rig_file, settings),
        light_paths(rig_file, settings),
        Instability(settings.stability, settings.seed, run, rig_file.procedure.contract.exposures),
        flat,
        edge,
    )


@dataclass(frozen=True, eq=False)
class Surface:
    """What lies under the lenses during one capture."""

    twin_from_part: np.ndarray
    relief: Relief
    column_shift: float = 0.0  # by which the projected picture has moved

    def slopes(self, xy: np.ndarray) -> np.ndarray:
        """(n, 2)."""
        steps = _STEP * np.eye(2)
        return np.stack([(self.relief(xy + s) - self.relief(xy - s)) / (2 * _STEP) for s in steps], axis=-1)


def phase_of(instrument: Instrument, surface: Surface, pixels: np.ndarray, nodes: Nodes) -> np.ndarray:
    """Absolute phase (n,) that pixels (n, 2) have of a Lambertian surface; NaN where less than half the light comes.

    The mean over all nodes of weight times phasor, as the renderer takes it.
    """
    n, count = len(pixels), len(nodes)
    pixel = (pixels[:, None] + nodes.within).reshape(-1, 2)

    def each(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (n, *values.shape)).reshape(-1, *values.shape[1:])

    um = each(nodes.wavelength_um)
    origin, direction, weight = instrument.paths.ray(pixel, each(nodes.camera_stop), um)
    points, normals = _met(surface, origin, direction)
    mirror, towards, light = instrument.paths.column(points, each(nodes.projector_stop), um)
    share = (weight * light * np.maximum(np.sum(normals * towards, axis=1), 0.0)).reshape(n, count)
    column = mirror[:, 0].reshape(n, count)
    middle = column.mean(axis=1)
    phasor = np.sum(share * np.exp(1j * instrument.rad_per_column * (column - middle[:, None])), axis=1)
    rows, cols = instrument.rig_file.projector.shape
    row = mirror[:, 1].reshape(n, count)
    lit = np.all((column > 0) & (column < cols - 1) & (row > 0) & (row < rows - 1), axis=1)
    phase = instrument.rad_per_column * (middle + surface.column_shift - STAGGER) + np.angle(phasor)
    return np.where(lit, phase, np.nan)


def _met(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and normals (n, 3) where rays meet a surface; Newton's iteration along each ray."""
    motion = surface.twin_from_part
    o, d = (origin - motion[:3, 3]) @ motion[:3, :3], direction @ motion[:3, :3]
    t = -o[:, 2] / d[:, 2]
    for _ in range(_INTERSECTIONS):
        p = o + t[:, None] * d
        gap = p[:, 2] - surface.relief(p[:, :2])
        t = t - gap / (d[:, 2] - np.sum(surface.slopes(p[:, :2]) * d[:, :2], axis=1))
    p = o + t[:, None] * d
    normals = np.column_stack([-surface.slopes(p[:, :2]), np.ones(len(p))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return p @ motion[:3, :3].T + motion[:3, 3], normals @ motion[:3, :3].T


def spot_centres(instrument: Instrument, board: PrintedBoard, twin_from_board: np.ndarray, nodes: Nodes) -> np.ndarray:
    """Centres (spots, 2) of the ellipses that the pipeline's fit finds.

    A pixel takes the mean over the stop of what it sees, so that an edge is blurred by where the parts of the stop
    image it, weighted by the light that comes through each. The fit finds the mean: what skew and change of the blur do
    to it, it corrects, and what is left of that is not simulated.
    """
    angle = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    radii = board.nominal.diameters()[:, None, None] / 2
    rims = board.centres[:, None] + radii * circle  # (spots, points, 2)
    spots, count = len(rims), len(nodes)

    def imaged(xy: np.ndarray) -> np.ndarray:  # (m, 2) to (m, nodes, 2)
        flat = np.column_stack([xy, ceramic_height(board, xy)])
        points = flat @ twin_from_board[:3, :3].T + twin_from_board[:3, 3]
        m = len(points)
        stop = np.tile(nodes.camera_stop, (m, 1))
        pixels = instrument.paths.image(np.repeat(points, count, axis=0), stop, np.tile(nodes.wavelength_um, m))
        return pixels.reshape(m, count, 2)

    middles = imaged(board.centres)
    _, _, weight = instrument.paths.ray(
        middles.reshape(-1, 2), np.tile(nodes.camera_stop, (spots, 1)), np.tile(nodes.wavelength_um, spots)
    )
    weight = weight.reshape(spots, 1, count, 1)
    weight /= weight.sum(axis=2, keepdims=True)
    edges = imaged(rims.reshape(-1, 2)).reshape(spots, RIM_POINTS, count, 2)
    return ellipse_centres(np.sum(weight * edges, axis=2))


def ellipse_centres(points: np.ndarray) -> np.ndarray:
    """Centres (n, 2) of the conics a x² + b x y + c y² + d x + e y = 1 best fitted to points (n, m, 2)."""
    middle = points.mean(axis=1, keepdims=True)
    scale = np.abs(points - middle).max(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis((points - middle) / scale, -1, 0)
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    a, b, c, d, e = (np.linalg.pinv(design) @ np.ones((*x.shape, 1)))[..., 0].T
    determinant = 4 * a * c - b * b
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=-1) / determinant[:, None]
    return middle[:, 0] + scale[:, 0] * centre


@dataclass(frozen=True, eq=False)
class Observations:
    """What the bundle is made from.

    Parameters
    ----------
    data : BundleData
    camera : CameraCalibration
        The paper's camera, from the same spots.
    readings_mm : (planes,)
        The blank side at 0 first.
    exposures_at_postures : (postures,)
        How many had been taken when each was done.
    world_from_twin : (4, 4)
        The calibrated frame as it truly is.
    """

    data: BundleData
    camera: CameraCalibration
    readings_mm: np.ndarray
    exposures_at_postures: np.ndarray
    world_from_twin: np.ndarray


def observe(instrument: Instrument, noise: Noise, rng: np.random.Generator) -> Observations:
    """One calibration's observations, in the order in which they are captured."""
    procedure, bench = instrument.rig_file.procedure, instrument.workbench
    frames = sum(procedure.steps)
    serial = EXPOSING
    spots, phases, taken = [], [], []
    for k in (*range(procedure.postures - 1), None):
        bench.place(Placement("board", posture=k))
        bench.position = 0.0
        found, measured = see_spots(instrument, "board", serial, noise, rng)
        spots.append(found)
        phases.append(measured)
        serial += frames
        taken.append(serial)
    serial += EXPOSING
    heights = (np.arange(procedure.planes) - (procedure.planes - 1) / 2) * procedure.plane_step_mm
    bench.place(Placement("board", face=BLANK))
    planes = []
    for height in (0.0, *heights):
        bench.position = float(height)
        planes.append(see_blank(instrument, serial, noise, rng))
        serial += frames
    board = instrument.rig_file.board.nominal
    camera = calibrate_camera(spots, board, instrument.rig_file.camera.shape, len(spots) - 1)
    blur = point_spread(instrument)
    seen = zip(spots, phases, camera.spot_heights(board), strict=True)
    freed = [freed_from_blur(found, measured, z, blur, fit_pull=0.0, rim_share=0.0) for found, measured, z in seen]
    return Observations(
        BundleData(tuple(found for found, _ in freed), tuple(measured for _, measured in freed), tuple(planes)),
        camera,
        np.array([0.0, *heights]),
        np.array(taken),
        bench.world_from_twin(),
    )


def point_spread(instrument: Instrument) -> PointSpread:
    """What the pipeline finds of the blur: where the light paths of pixels come closest, and how they part from there.

    As pictures of spots cannot, it is exact; the least spread of paths o + t d over the stop is at t = -cov(o, d) /
    var(d).
    """
    optics, (rows, cols) = instrument.settings.optics, instrument.rig_file.camera.shape
    px_per_mm = optics.camera_focal_px / optics.pupil_distance_mm
    cutoff = 2 * optics.na / (optics.wavelength_um * 1e-3 * px_per_mm)
    if not optics.finite_aperture:
        return PointSpread(cutoff, 0.0, (0.0, 0.0, 0.0, 0.0), (rows, cols))
    v, u = np.meshgrid(*((n - 1) * np.linspace(0.1, 0.9, FOCUS_POINTS) for n in (rows, cols)), indexing="ij")
    pixels, nodes = np.stack([u.ravel(), v.ravel()], axis=-1), instrument.edge_nodes
    n, count = len(pixels), len(nodes)
    origin, direction, weight = instrument.paths.ray(
        np.repeat(pixels, count, axis=0), np.tile(nodes.camera_stop, (n, 1)), np.tile(nodes.wavelength_um, n)
    )
    slope = (direction[:, :2] / direction[:, 2:]).reshape(n, count, 2)
    foot = origin[:, :2].reshape(n, count, 2) - origin[:, 2].reshape(n, count, 1) * slope
    share = (weight / weight.reshape(n, count).sum(axis=1).repeat(count)).reshape(n, count, 1)
    slope, foot = (each - np.sum(share * each, axis=1, keepdims=True) for each in (slope, foot))
    spread = np.sum(share * slope**2, axis=(1, 2))
    heights = -np.sum(share * slope * foot, axis=(1, 2)) / spread
    du, dv = (pixels - [(cols - 1) / 2, (rows - 1) / 2]).T
    surface = np.stack([np.ones(n), du, dv, du**2 + dv**2], axis=-1)
    c, a, b, d = (float(term) for term in np.linalg.lstsq(surface, heights, rcond=None)[0])
    # A disc of radius D per height has the variance D²/4 along each of two axes.
    return PointSpread(cutoff, float(np.sqrt(2 * spread.mean())) * px_per_mm, (c, a, b, d), (rows, cols))


def moved_by(instrument: Instrument, serial: int, only_densest: bool = False) -> np.ndarray:
    """Motion (4, 4) of the specimen in a capture: drift and the mean vibration of its frames."""
    frames = sum(instrument.rig_file.procedure.steps)
    first = frames - instrument.rig_file.procedure.steps[-1] if only_densest else 0
    vibration = instrument.instability.vibration(serial + np.arange(first, frames)).mean(axis=0)
    return rigid(Rotation.identity(), vibration + instrument.instability.table_drift(serial))


def path_shift(instrument: Instrument, serial: int) -> float:
    """Columns by which the projected picture has moved."""
    pitch = instrument.settings.optics.column_pitch_um * 1e-3
    return instrument.instability.path_drift(serial) / pitch


def see_spots(
    instrument: Instrument, part: str, serial: int, noise: Noise, rng: np.random.Generator
) -> tuple[Spots, SpotPhases]:
    """The printed side as it is mounted: spots and their phases."""
    bench = instrument.workbench
    board = bench.printed_board(part)
    pose = moved_by(instrument, serial) @ bench.twin_from_part()
    true = spot_centres(instrument, board, pose, instrument.edge_nodes)
    surface = Surface(
        moved_by(instrument, serial, only_densest=True) @ bench.twin_from_part(),
        lambda xy: ceramic_height(board, xy),
        path_shift(instrument, serial),
    )
    px_per_mm = instrument.settings.optics.camera_focal_px / instrument.settings.optics.pupil_distance_mm
    radii = px_per_mm * board.nominal.diameters() / 2
    rows, cols = instrument.rig_file.camera.shape
    reach = (radii + _SPOT_MARGIN_PX)[:, None]
    found = true + noise.centre_px * rng.standard_normal(true.shape)
    phase = phase_of(instrument, surface, found, instrument.flat_nodes)
    offsets = reach[:, None] * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # (spots, 4, 2)
    around = phase_of(instrument, surface, (found[:, None] + offsets).reshape(-1, 2), instrument.chief).reshape(-1, 4)
    gradient = np.stack([around[:, 0] - around[:, 1], around[:, 2] - around[:, 3]], axis=-1) / (2 * reach)
    # The spot's fit takes the plane through its interior: its middle.
    middle = phase + noise.spot_phase_rad * rng.standard_normal(len(found))
    seen = np.all((found > reach) & (found < [cols, rows] - reach - 1), axis=1) & np.isfinite(around).all(axis=1)
    centres = np.where(seen[:, None], found, np.nan)
    axes = np.where(seen, radii, np.nan)
    sigma = np.where(seen, noise.centre_px, np.nan)
    return (
        Spots(centres, np.stack([axes, axes], axis=-1), sigma),
        SpotPhases(
            np.where(seen, middle, np.nan),
            np.where(seen[:, None], gradient, np.nan),
            np.where(seen, noise.spot_phase_rad, np.nan),
        ),
    )


def see_blank(instrument: Instrument, serial: int, noise: Noise, rng: np.random.Generator) -> PlaneBlocks:
    """The blank side as it is mounted: blocks, as many across the picture as the bundle takes."""
    bench = instrument.workbench
    board = bench.printed_board("board")
    surface = Surface(
        moved_by(instrument, serial, only_densest=True) @ bench.twin_from_part(),
        lambda xy: blank_height(board, xy),
        path_shift(instrument, serial),
    )
    rows, cols = instrument.rig_file.camera.shape
    side = block_side(cols)
    v, u = np.meshgrid(*((np.arange(n // side) + 0.5) * side - 0.5 for n in (rows, cols)), indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    half = 0.25 * side + RIM_PX  # a block counts from three quarters on
    rim = pixels[:, None] + half * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    lit = np.isfinite(phase_of(instrument, surface, rim.reshape(-1, 2), instrument.chief)).reshape(-1, 4).all(axis=1)
    origin, direction, _ = instrument.paths.ray(
        rim.reshape(-1, 2), np.zeros((4 * len(pixels), 2)), np.full(4 * len(pixels), instrument.chief.wavelength_um[0])
    )
    points, _ = _met(surface, origin, direction)
    motion = surface.twin_from_part
    on_part = (points - motion[:3, 3]) @ motion[:3, :3]
    on_board = np.all(np.abs(on_part[:, :2]) < board.nominal.size_mm / 2, axis=1).reshape(-1, 4).all(axis=1)
    pixels = pixels[lit & on_board]
    phase = phase_of(instrument, surface, pixels, instrument.flat_nodes)
    return PlaneBlocks(pixels, phase + noise.pixel_phase_rad / side * rng.standard_normal(len(pixels)))
