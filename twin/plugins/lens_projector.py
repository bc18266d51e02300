"""A pattern projector behind an ideal lens of finite aperture or behind glass, with mirrors' shape and diffraction.

.. pluginparameters::

 * - to_world: transform
     Projector to world: it shines along +z with the pattern's columns running along -x and its rows along -y, as
     Mitsuba's own ``projector`` does; the origin is the centre of the pupil towards the scene.
 * - patterns: tensor (N, rows, cols)
     Grey values 0-255.
 * - pattern_shift: tensor (N, 2)
     Columns and rows by which each pattern has moved against its place towards lower ones (default: 0); only with a
     band limit.
 * - pattern: integer
     Which pattern integrators other than ``fringe`` see (default: 0).
 * - column_pitch, row_pitch: float
     Size of a mirror's column and row step in the focused plane, in scene units.
 * - focus_distance: float
     Distance from the pupil to the plane in focus, in scene units.
 * - aperture_radius: float
     Radius of that pupil in scene units; 0 is a pinhole (default).
 * - wavelength, diffraction_na: float
     Wavelength in scene units and numerical aperture of the band limit; a wavelength of 0 shows square pixels without
     any (default), and ``diffraction_na`` defaults to aperture_radius / focus_distance.
 * - fill, off_state, gamma: float
     Share of a diamond's area that reflects (default: 0.92), light of a dark mirror (default: 0), and exponent of a
     mirror's light over its grey value (default: 1); only with a band limit.
 * - irradiance: float
     Irradiance of a white pattern in the focused plane, on a surface perpendicular to the axis (default: 1).
 * - prescription, glass_errors, pupil_nodes:
     Glass in place of the ideal lens, as with ``lens_sensor`` (default: none).
 * - wavelength_um, bandwidth_um: float
     Middle and full width at half maximum of the light that passes the glass (default: 0.525 and 0).

The light of a white pattern on planes perpendicular to the axis is constant over the field, as it is with Mitsuba's
``projector``: an ideal lens has no natural vignetting. Through glass it is that of a uniformly bright array.
"""

import numpy as np

from greenough.instrument.packets import packed

from ..dmd import Mirrors, band_limited, square_pixels
from ..glass.mounting import mount
from ..glass.paraxial import DESIGN_WAVELENGTH_UM
from ..glass.spectrum import Spectrum
from ..renderer import dr, mi

PACKET = 4  # values that one gather reads


class LensProjector(mi.Emitter):
    """See the module for the parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.DeltaPosition
        self.m_needs_sample_3 = False
        world_from_local = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
        self.to_world = mi.AffineTransform4f(world_from_local.astype(np.float32))
        self.to_local = mi.AffineTransform4f(np.linalg.inv(world_from_local).astype(np.float32))
        dr.make_opaque(self.to_world, self.to_local)
        self.pitch = (float(props["column_pitch"]), float(props["row_pitch"]))
        self.focus = float(props["focus_distance"])
        self.aperture = float(props.get("aperture_radius", 0.0))
        self.irradiance = float(props.get("irradiance", 1.0))
        self.pattern = int(props.get("pattern", 0))
        self.wavelength = float(props.get("wavelength", 0.0))
        self.na = float(props.get("diffraction_na", self.aperture / self.focus))
        self.mirrors = Mirrors(
            *self.pitch,
            fill=float(props.get("fill", 0.92)),
            off_state=float(props.get("off_state", 0.0)),
            gamma=float(props.get("gamma", 1.0)),
        )
        shift = np.array(props["pattern_shift"]) if "pattern_shift" in props else None
        self.spectrum = Spectrum(
            float(props.get("wavelength_um", DESIGN_WAVELENGTH_UM)), float(props.get("bandwidth_um", 0.0))
        )
        self.glass = None
        if "prescription" in props:
            errors = props.get("glass_errors", "")
            self.glass = mount(props["prescription"], errors, outwards=True, nodes=int(props.get("pupil_nodes", 16)))
        self.set_patterns(np.array(props["patterns"]).astype(np.uint8), shift)

    def set_patterns(self, patterns: np.ndarray, shift: np.ndarray | None = None) -> None:
        """Show other ``patterns``, (N, rows, cols) uint8, each moved by ``shift`` (N, 2), see the module."""
        self.n_patterns, rows, cols = patterns.shape
        # A diamond array is half a column wider than its columns: its middle is that of even and odd rows together.
        stagger = 0.25 if self.wavelength > 0 else 0.0
        self.middle = ((cols - 1) / 2 + stagger, (rows - 1) / 2)
        if self.wavelength > 0:
            table = band_limited(patterns, self.mirrors, self.na, self.wavelength, shift)
        else:
            table = square_pixels(patterns)
        self.table_shape = table.values.shape[:2]  # (table_rows, table_cols)
        self.padded = -(-self.n_patterns // PACKET) * PACKET
        padding = ((0, 0), (0, 0), (0, self.padded - self.n_patterns))
        # A cell of 24 patterns then lies in two cache lines, and a stack renders in three quarters of the time.
        self.values = mi.Float(packed(np.pad(table.values, padding), aligned=True))
        self.row_profile = mi.Float(table.row_profile)
        self.origin, self.cells, self.interpolate = table.origin, table.cells, table.interpolate

    def aim(
        self, p: mi.Point3f, sample: mi.Point2f, wavelength_um: mi.Float | float = DESIGN_WAVELENGTH_UM
    ) -> tuple[mi.Point3f, mi.Float, mi.Float, mi.Float]:
        """Trace the scene point ``p`` back through a point of the pupil to the mirrors.

        Returns the pupil point in the world, the column and row on the array, and the irradiance at ``p`` of a white
        pattern on a surface that faces that pupil point.
        """
        local = self.to_local @ p
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        if self.glass is not None:
            disk *= float(self.aperture > 0)
            pupil, at_x, at_y, white = self.glass.look_up(local, disk, wavelength_um)
            column, row = self.middle[0] + at_x / self.pitch[0], self.middle[1] + at_y / self.pitch[1]
            return self.to_world @ pupil, column, row, dr.select(local.z > 0, self.irradiance * white, 0.0)
        disk *= self.aperture
        pupil = mi.Point3f(disk.x, disk.y, 0)
        reach = self.focus / local.z
        at_x = dr.fma(local.x - pupil.x, reach, pupil.x)
        at_y = dr.fma(local.y - pupil.y, reach, pupil.y)
        column = self.middle[0] - at_x / self.pitch[0]
        row = self.middle[1] - at_y / self.pitch[1]
        # Constant irradiance on the focused plane needs 1 / cos; the inverse square is taken along the axis.
        distance = dr.norm(local - pupil)
        white = self.irradiance * dr.square(reach) * distance / local.z
        return self.to_world @ pupil, column, row, dr.select(local.z > 0, white, 0.0)

    def reaches(self, column: mi.Float, row: mi.Float, across: mi.Float, down: mi.Float) -> mi.Bool:
        """Whether any pattern has light within so many columns and rows of (column, row)."""
        rows, cols = self.table_shape
        if self.interpolate and rows == 1:
            rows = dr.width(self.row_profile)
        x, y = (column - self.origin[0]) * self.cells[0], (row - self.origin[1]) * self.cells[1]
        dx, dy = across * self.cells[0] + 1, down * self.cells[1] + 1
        return (x > -dx) & (x < cols - 1 + dx) & (y > -dy) & (y < rows - 1 + dy)

    @dr.syntax
    def light(self, column: mi.Float, row: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Relative light of every pattern at (column, row): a list of N."""
        x = (column - self.origin[0]) * self.cells[0]
        y = (row - self.origin[1]) * self.cells[1]
        rows, cols = self.table_shape
        if dr.hint(not self.interpolate, mode="scalar"):
            i, j = mi.Int32(dr.floor(y + 0.5)), mi.Int32(dr.floor(x + 0.5))
            inside = active & (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
            return self._cell(mi.UInt32(i * cols + j), inside)
        i, j = mi.Int32(dr.floor(y)), mi.Int32(dr.floor(x))
        s, t = y - i, x - j
        inside = active & (j >= 0) & (j < cols - 1) & (i >= 0)
        if dr.hint(rows == 1, mode="scalar"):
            inside &= i < dr.width(self.row_profile) - 1
            above = dr.gather(mi.Float, self.row_profile, mi.UInt32(i), inside)
            below = dr.gather(mi.Float, self.row_profile, mi.UInt32(i + 1), inside)
            share = dr.lerp(above, below, s)
            return [share * value for value in self._between_columns(mi.UInt32(j), t, inside)]
        inside &= i < rows - 1
        upper = self._between_columns(mi.UInt32(i * cols + j), t, inside)
        lower = self._between_columns(mi.UInt32((i + 1) * cols + j), t, inside)
        return [dr.lerp(upper[k], lower[k], s) for k in range(self.n_patterns)]

    def _between_columns(self, cell: mi.UInt32, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        left, right = self._cell(cell, active), self._cell(cell + 1, active)
        return [dr.lerp(left[k], right[k], t) for k in range(self.n_patterns)]

    def _cell(self, cell: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        """All patterns in one cell, read four at a time: they lie side by side."""
        packets = self.padded // PACKET
        read = [dr.gather(mi.Vector4f, self.values, cell * packets + k, active) for k in range(packets)]
        return [read[k // PACKET][k % PACKET] for k in range(self.n_patterns)]

    def sample_direction(self, it, sample, active=True):
        """A point of the pupil, drawn uniformly, and the light that ``it.p`` gets from there through one pattern."""
        pupil, column, row, white = self.aim(it.p, sample)
        ds = mi.DirectionSample3f()
        ds.p = pupil
        ds.n = self.to_world @ mi.Vector3f(0, 0, 1)
        ds.uv = mi.Point2f(0.5)
        ds.time = it.time
        ds.pdf = 1.0
        ds.delta = True
        ds.emitter = mi.EmitterPtr(self)
        ds.d = mi.Vector3f(pupil - it.p)
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        active = mi.Bool(active)
        light = self.light(column, row, active)[self.pattern]
        return ds, mi.Spectrum(dr.select(active, light * white, 0.0))

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(0)

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def sample_wavelengths(self, si, sample, active=True):
        return si.wavelengths, mi.Spectrum(1.0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return f"LensProjector[{self.n_patterns} patterns, focus={self.focus}, aperture={self.aperture}]"
