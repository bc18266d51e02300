"""A camera behind an ideal lens of finite aperture or behind glass, with square pixels and diffraction.

Any integrator may sample its rays, which are spread over the pixel and the Airy pattern around it. The pattern's skirt
is wide: a few fixed rays cannot stand for it. An integrator that knows this sensor takes the rays of ``pixel_ray`` and
passes the finished picture through ``diffract``.

.. pluginparameters::

 * - to_world: transform
     Sensor to world. As with Mitsuba's own ``perspective`` the sensor looks along +z with the image's columns running
     along -x and its rows along -y; the origin is the centre of the entrance pupil.
 * - focal_length_px: float
     Equivalent pinhole focal length, in pixels.
 * - principal_point_px: (column, row)
     Where the axis meets the image, pixel centres at integers (default: middle of the film).
 * - focus_distance: float
     Distance from the pupil to the plane in focus, in scene units.
 * - aperture_radius: float
     Radius of the entrance pupil in scene units; 0 is a pinhole (default).
 * - wavelength: float
     Wavelength in scene units for the diffraction at the aperture that focuses at ``focus_distance``; 0 switches
     diffraction off (default).
 * - diffraction_na: float
     Numerical aperture for the diffraction, where it is not aperture_radius / focus_distance (a pinhole that still
     diffracts like the lens it stands for).
 * - prescription: string
     "camera" or a TOML file of ``greenough.twin.glass``: glass in place of the ideal lens (default: none). Focus and
     aperture are then the prescription's, but an aperture_radius of 0 leaves only rays through the stop's middle.
 * - glass_errors: string
     As-built errors of the glass as JSON, see ``greenough.twin.glass.placed.errors_to_json`` (default: none).
 * - pupil_nodes: integer
     How many rays share the pupil: a rim that cuts through the share of one dims it (default: 16).
"""

from functools import lru_cache

import cv2
import numpy as np

from ..diffraction import pixel_response, response_after_tent
from ..glass.mounting import mount
from ..glass.paraxial import DESIGN_WAVELENGTH_UM
from ..renderer import dr, mi

BORDER = 32  # pixels around a picture whose light reaches into it


class LensSensor(mi.Sensor):
    """See the module for the parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        film = self.film()
        size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
        self.size = (int(crop[0]), int(crop[1]))  # (cols, rows)
        self.offset = (int(offset[0]), int(offset[1]))
        self.focal = float(props["focal_length_px"])
        centre = props.get("principal_point_px", mi.ScalarPoint2f(0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5))
        self.centre = (float(centre[0]), float(centre[1]))
        self.focus = float(props["focus_distance"])
        self.aperture = float(props.get("aperture_radius", 0.0))
        wavelength = float(props.get("wavelength", 0.0))
        na = float(props.get("diffraction_na", self.aperture / self.focus))
        world_from_local = props.get("to_world", mi.ScalarTransform4f())
        self.origin = world_from_local @ mi.ScalarPoint3f(0, 0, 0)
        self.to_world = mi.AffineTransform4f(np.array(world_from_local.matrix, np.float32))
        dr.make_opaque(self.to_world)
        self.response = None
        self.diffraction = (self.focus / self.focal, na, wavelength) if wavelength > 0 and na > 0 else None
        if self.diffraction is not None:
            marginal, conditional = pixel_response(*self.diffraction)
            self.response = (mi.Float(marginal), mi.Float(conditional.ravel()), conditional.shape)
        self.m_needs_sample_3 = self.aperture > 0
        self.glass = None
        if "prescription" in props:
            errors = props.get("glass_errors", "")
            self.glass = mount(props["prescription"], errors, outwards=False, nodes=int(props.get("pupil_nodes", 16)))

    def displacement(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Where in units of pixels the light of a pixel comes from, for a sample (u, v) of the unit square."""
        if self.response is None:
            return _box(u), _box(v)
        marginal, conditional, (rows, cols) = self.response
        x = _read(marginal, u, dr.width(marginal))
        at = u * (rows - 1)
        row = dr.minimum(mi.UInt32(at), rows - 2)
        upper = _read(conditional, v, cols, row * cols)
        lower = _read(conditional, v, cols, (row + 1) * cols)
        return x, dr.lerp(upper, lower, at - row)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        """A ray from the aperture through the focused image of a position in the film's crop; its weight is 1."""
        cols, rows = self.size
        at_x, at_y = sample2.x * cols, sample2.y * rows
        column, row = dr.floor(at_x), dr.floor(at_y)
        du, dv = self.displacement(at_x - column, at_y - row)
        ray, weight = self._ray(column + self.offset[0] + du, row + self.offset[1] + dv, sample3, DESIGN_WAVELENGTH_UM)
        ray.time = time
        return ray, mi.Spectrum(weight)

    def pixel_ray(
        self,
        column: mi.Float,
        row: mi.Float,
        within: mi.Point2f,
        sample: mi.Point2f,
        wavelength_um: mi.Float | float = DESIGN_WAVELENGTH_UM,
    ) -> tuple[mi.Ray3f, mi.Float]:
        """A ray of the pixel (column, row) of the film and its weight, for samples of its area and of the pupil.

        Without diffraction the area is the pixel. With it, it is a tent two pixels wide: ``diffract`` does the rest.
        """
        spread = _tent if self.diffraction else _box
        return self._ray(column + spread(within.x), row + spread(within.y), sample, wavelength_um)

    def diffract(self, picture: np.ndarray) -> np.ndarray:
        """Pixels and Airy pattern from a picture, (rows, cols) float32, that was taken with ``pixel_ray``.

        The picture is taken for periodic, so that it needs a border. The tent lets so little through of what is too
        fine for the pixels that the transfer function can be applied to them.
        """
        if self.diffraction is None:
            return picture
        spectrum = cv2.dft(picture)
        spectrum *= _transfer(picture.shape, self.diffraction)
        return cv2.dft(spectrum, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)

    def _ray(
        self, x: mi.Float, y: mi.Float, sample: mi.Point2f, wavelength_um: mi.Float | float
    ) -> tuple[mi.Ray3f, mi.Float]:
        """A ray of (x, y), in pixels of the film, from a sample of the pupil, and its weight."""
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        scale = self.focus / self.focal
        at_x, at_y = (x - self.centre[0]) * scale, (y - self.centre[1]) * scale
        if self.glass is None:
            pupil = disk * self.aperture
            origin = mi.Point3f(pupil.x, pupil.y, 0)
            direction = mi.Vector3f(dr.normalize(mi.Point3f(-at_x, -at_y, mi.Float(self.focus)) - origin))
            weight = mi.Float(1)
        else:
            disk *= float(self.aperture > 0)
            origin, direction, weight = self.glass.ray(at_x, at_y, disk, wavelength_um)
        ray = mi.Ray3f()
        ray.time = 0.0
        ray.o = self.to_world @ origin
        ray.d = self.to_world @ direction
        ray.maxt = dr.largest(mi.Float)
        return ray, weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        """As ``sample_ray``; the differentials are rays of the neighbouring pixels."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        out = mi.RayDifferential3f(ray)
        cols, rows = self.size
        right, _ = self.sample_ray(time, sample1, sample2 + mi.Vector2f(1 / cols, 0), sample3, active)
        below, _ = self.sample_ray(time, sample1, sample2 + mi.Vector2f(0, 1 / rows), sample3, active)
        out.o_x, out.d_x, out.o_y, out.d_y = right.o, right.d, below.o, below.d
        out.has_differentials = True
        return out, weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f(self.origin)

    def to_string(self) -> str:
        return f"LensSensor[focal_length_px={self.focal}, focus={self.focus}, aperture={self.aperture}]"


@lru_cache(maxsize=8)
def _transfer(shape: tuple[int, ...], diffraction: tuple[float, float, float]) -> np.ndarray:
    """What every number of a spectrum that OpenCV has packed is multiplied by, (rows, cols) float32.

    The response is even, so that its spectrum is real: imaginary parts take the factor of the real part before them.
    Packed, they are every second number of a row, and of the columns of zero and of the highest frequency.
    """
    transfer = cv2.dft(response_after_tent(shape, *diffraction))
    rows, cols = shape
    transfer[:, 2::2] = transfer[:, 1 : cols - 1 : 2]
    for column in (0, cols - 1) if cols % 2 == 0 else (0,):
        transfer[2::2, column] = transfer[1 : rows - 1 : 2, column]
    return transfer


def _box(u: mi.Float) -> mi.Float:
    """A uniform sample as a position in a pixel."""
    return u - 0.5


def _tent(u: mi.Float) -> mi.Float:
    """A uniform sample as a position under a tent that falls to zero at -1 and 1."""
    t = 2 * u - 1
    return dr.copysign(1 - dr.sqrt(1 - dr.abs(t)), t)


def _read(table: mi.Float, u: mi.Float, n: int, offset: mi.UInt32 | int = 0) -> mi.Float:
    """Linear interpolation in ``n`` entries of ``table`` from ``offset``, at u in [0, 1]."""
    at = u * (n - 1)
    k = dr.minimum(mi.UInt32(at), n - 2)
    low = dr.gather(mi.Float, table, k + offset)
    high = dr.gather(mi.Float, table, k + 1 + offset)
    return dr.lerp(low, high, at - k)
