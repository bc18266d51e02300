"""What blur times brightness does to heights, predicted without the renderer.

Where brightness changes within the camera's point spread, the phase of a pixel is pulled towards the brighter side.
Here the specimen is traced from the middle of the camera's pupil on a fine grid, shaded by textbook formulas as the
middle of the projector's pupil lights it, and its phasors L exp(i Phi) are blurred by pixel, Airy pattern and defocus.
What the argument has moved by, times dz/dPhi along the pixel's ray, is the predicted height error.

Left out are interreflections, the change of brightness over the pupils (1.7 degrees wide), penumbras, and the
projector's blur: along a surface's phase it is symmetric, so to first order it only lowers the contrast.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.fft import fft2, fftfreq, ifft2

from greenough.scenes.materials import MATERIALS
from greenough.scenes.parts import Part, merge

from ..bench import Bench
from ..diffraction import geometric_transfer, optical_transfer
from ..settings import OpticsSettings
from .shading import radiance

MARGIN_PX = 32  # pixels around the picture whose light is blurred into it
LAYER_MM = 0.25  # step of the defocus for which transfer functions are made; between them they are interpolated
LIFT_MM = 2e-4  # shadow rays start so far above the surface
_BLOCK_ROWS = 96


def predict_height_error(
    bench: Bench, shape: tuple[int, int], mirrors: tuple[int, int], period_px: float, subpixels: int = 3
) -> np.ndarray:
    """Height error of each pixel by blur times brightness, (rows, cols) mm; NaN where the pixel's ray meets no light.

    Parameters
    ----------
    bench : Bench
        With the specimen mounted.
    shape : (rows, cols)
        Of the camera.
    mirrors : (rows, cols)
        Of the projector.
    period_px : float
        Period of the densest fringes, in projector columns.
    subpixels : int
        Rays per pixel along each axis, odd.
    """
    optics = bench.settings.optics
    if subpixels % 2 == 0:
        raise ValueError(f"an even number of subpixels, {subpixels}, has no ray in the middle of a pixel")
    fine = tuple((n + 2 * MARGIN_PX) * subpixels for n in shape)
    phasor, defocus = np.zeros(fine, np.complex64), np.zeros(fine, np.float32)
    phase, mm_per_rad = np.full(fine, np.nan), np.full(fine, np.nan)
    surface = _Surface(bench.parts_in_world(), bench.world_from_twin, optics, mirrors, 2 * np.pi / period_px)
    u, v = (
        (np.arange(n) + 0.5) / subpixels - 0.5 - MARGIN_PX - (size - 1) / 2
        for n, size in zip(fine[::-1], shape[::-1], strict=True)
    )
    for rows in _blocks(fine[0]):
        seen = surface.seen(u, v[rows])
        phasor[rows], defocus[rows] = seen.radiance * np.exp(1j * seen.phase), seen.defocus
        phase[rows], mm_per_rad[rows] = np.where(seen.radiance > 0, seen.phase, np.nan), seen.mm_per_rad
    blurred = blur(phasor, defocus, subpixels, optics)
    middle = tuple(slice(MARGIN_PX * subpixels + subpixels // 2, -MARGIN_PX * subpixels, subpixels) for _ in shape)
    moved = np.angle(blurred[middle] * np.exp(-1j * phase[middle]))
    return moved * mm_per_rad[middle]


def blur(phasor: np.ndarray, defocus: np.ndarray, subpixels: int, optics: OpticsSettings) -> np.ndarray:
    """Phasors (rows, cols) on a fine grid, blurred by pixel, Airy pattern and their own defocus in mm."""
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    fy, fx = (fftfreq(n, pixel / subpixels) for n in phasor.shape)
    radius = np.hypot(fy[:, None], fx)
    box = np.sinc(fy * pixel)[:, None] * np.sinc(fx * pixel)
    lens = optical_transfer(radius, optics.na, optics.wavelength_um * 1e-3) * box
    passes = lens != 0
    level = np.abs(defocus) / LAYER_MM
    spectrum = np.zeros(phasor.shape, np.complex64)
    for layer in range(int(np.ceil(level.max())) + 1):
        share = np.clip(1 - np.abs(level - layer), 0, None)
        disc = geometric_transfer(radius[passes], optics.na, layer * LAYER_MM)
        spectrum[passes] += fft2(phasor * share, workers=2)[passes] * lens[passes] * disc
    return np.asarray(ifft2(spectrum, workers=2))


@dataclass(frozen=True)
class _Seen:
    """What a block of rays sees; all arrays are (rows, cols)."""

    radiance: np.ndarray  # 0 where nothing is seen or no light falls
    phase: np.ndarray  # of the densest fringes, rad from the projector's axis
    mm_per_rad: np.ndarray  # change of world z with phase along the ray
    defocus: np.ndarray  # mm along the camera's axis


class _Surface:
    """The mounted parts with the two pupils, in the world frame."""

    def __init__(
        self,
        parts: Sequence[Part],
        world_from_twin: np.ndarray,
        optics: OpticsSettings,
        mirrors: tuple[int, int],
        rad_per_column: float,
    ):
        half_angle = np.radians(optics.convergence_deg) / 2
        self.optics, self.mirrors, self.rad_per_column = optics, mirrors, rad_per_column
        self.camera, self.projector = (world_from_twin @ _pupil(a, optics) for a in (-half_angle, half_angle))
        self.vertices, self.faces = merge(parts)
        self.normals = np.concatenate([_vertex_normals(part) for part in parts])
        self.materials = [MATERIALS[part.material] for part in parts]
        self.first_face = np.cumsum([0] + [len(part.faces) for part in parts])
        self.scene = EmbreeScene()
        TriangleMesh(self.scene, self.vertices.astype(np.float32), self.faces)

    def seen(self, u: np.ndarray, v: np.ndarray) -> _Seen:
        """Along the rays of columns ``u`` and rows ``v``, in pixels from the camera's axis."""
        right, down, forward = self.camera[:3, :3].T
        origin = self.camera[:3, 3]
        step = self.optics.camera_focal_px
        direction = forward + (u[:, None] * right + v[:, None, None] * down) / step  # (rows, cols, 3)
        rays = direction.reshape(-1, 3)
        face = self.scene.run(
            np.broadcast_to(origin, rays.shape).astype(np.float32), rays.astype(np.float32), query="INTERSECT"
        )
        hit = np.flatnonzero(face >= 0)
        face, rays = face[hit], rays[hit]
        corners = self.vertices[self.faces[face]]  # (n, 3, 3)
        depth, weights = _meet(origin, rays, corners)
        point = origin + depth[:, None] * rays
        normal = np.einsum("nc,nck->nk", weights, self.normals[self.faces[face]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facet /= np.linalg.norm(facet, axis=1, keepdims=True)

        place, columns_per_depth = self._projected(point, rays)
        to_light = self.projector[:3, 3] - point
        lit = (np.abs(place) < np.array(self.mirrors[::-1]) / 2).all(axis=1) & ~self._shaded(point, facet, to_light)
        light = np.zeros(len(hit))
        part = np.searchsorted(self.first_face, face, side="right") - 1
        for k, material in enumerate(self.materials):
            of = lit & (part == k)
            light[of] = radiance(material, normal[of], _unit(to_light[of]), _unit(-rays[of]))

        def image(values: np.ndarray) -> np.ndarray:
            whole = np.zeros(direction.shape[:2])
            whole.flat[hit] = values
            return whole

        return _Seen(
            radiance=image(light),
            phase=image(self.rad_per_column * place[:, 0]),
            mm_per_rad=image(rays[:, 2] / (self.rad_per_column * columns_per_depth)),
            defocus=image(depth - self.optics.pupil_distance_mm),
        )

    def _projected(self, point: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(column, row) of points (n, 3) from the projector's axis, (n, 2), and d column / d depth along rays, (n,)."""
        right, down, forward = self.projector[:3, :3].T
        scale = self.optics.pupil_distance_mm / (
            1e-3 * np.array([self.optics.column_pitch_um, self.optics.row_pitch_um])
        )
        local = point - self.projector[:3, 3]
        depth = local @ forward
        place = np.stack([local @ right, local @ down], axis=-1) / depth[:, None]
        change = (rays @ right - place[:, 0] * (rays @ forward)) / depth
        return place * scale, change * scale[0]

    def _shaded(self, point: np.ndarray, facet: np.ndarray, to_light: np.ndarray) -> np.ndarray:
        start = (point + LIFT_MM * facet).astype(np.float32)
        return self.scene.run(start, to_light.astype(np.float32), query="OCCLUDED") >= 0


def _pupil(angle: float, optics: OpticsSettings) -> np.ndarray:
    """``twin_from_path`` (4, 4): right, down and forward of an image, and the pupil's middle; leans towards +x."""
    c, s = np.cos(angle), np.sin(angle)
    frame = np.eye(4)
    frame[:3, :3] = np.array([[c, 0, -s], [0, -1, 0], [-s, 0, -c]]).T
    frame[:3, 3] = optics.pupil_distance_mm * np.array([s, 0, c])
    return frame


def _vertex_normals(part: Part) -> np.ndarray:
    if part.normals is None:
        raise ValueError(
            f"facets of {part.material} have no smooth normals: brightness would jump from one to the next"
        )
    return part.normals


def _meet(origin: np.ndarray, rays: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (n,) and barycentric coordinates (n, 3) where rays (n, 3) meet the planes of triangles (n, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    facet = np.cross(b - a, c - a)
    depth = np.einsum("nk,nk->n", a - origin, facet) / np.einsum("nk,nk->n", rays, facet)
    inside = origin + depth[:, None] * rays - a
    facet /= np.einsum("nk,nk->n", facet, facet)[:, None]
    second = np.einsum("nk,nk->n", np.cross(inside, c - a), facet)
    third = np.einsum("nk,nk->n", np.cross(b - a, inside), facet)
    return depth, np.stack([1 - second - third, second, third], axis=-1)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def _blocks(rows: int) -> Iterator[slice]:
    return (slice(start, min(start + _BLOCK_ROWS, rows)) for start in range(0, rows, _BLOCK_ROWS))
