"""Renders the images of all patterns of the lens projectors in one pass over one set of light paths.

.. pluginparameters::

 * - nodes: integer
     Light paths per pixel, a power of two (default: 16); ``spp`` of mi.render overrides it.
 * - nodes_indirect: integer
     How many more paths per pixel carry the interreflections (default: as many as ``nodes``, scaled with ``spp``).
     They are incoherent and slow, and interreflections are faint and smooth.
 * - node_table: tensor (nodes, 6)
     The nodes of the direct light themselves, in the unit cube: pixel, sensor's pupil, projector's pupil. It replaces
     the low-discrepancy ones unless ``spp`` asks for another number.
 * - edge_table: tensor (nodes, 6)
     Nodes for pixels whose blur may hold more than one shape, instead of ``node_table`` (default: none). With ``spp``
     all pixels have the same. Steps within one shape, and changes of its colour, are not looked for.
 * - bounces: integer
     Surface interactions of a path: 1 is direct light only, 2 adds one interreflection (default: 2).
 * - shadows: boolean
     Whether surfaces may lie in the way of light (default: true). A single flat one cannot.
 * - guided: boolean
     Draw half of the paths of the interreflections from a map of the light around each part of the picture, see
     ``greenough.twin.plugins.guiding`` (default: true).
 * - smoothing: integer
     Radius in pixels within which the interreflections are averaged along smooth surfaces of one material, see
     ``greenough.twin.plugins.smoothing``; 0 is none (default), which is unbiased.
 * - shift_per_pixel: boolean
     Shift the nodes by a random vector in each pixel, seeded by ``seed`` (default: false). The fixed nodes make an
     error that is smooth and part of the optics; shifted ones are unbiased and noisy, and serve to show so. The nodes
     of the interreflections are always shifted, without this by the same vectors whatever the seed.

The result of ``mi.render`` is a tensor (rows, cols, N), a channel per pattern. The light of other emitters is the same
in all channels. Glossy surfaces are met by sampling the emitters, so that mirror-like ones need an emitter with an
extent that rays can hit.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np

from greenough.instrument.packets import packed

from ..glass.paraxial import DESIGN_WAVELENGTH_UM
from ..glass.spectrum import Spectrum
from ..quadrature import nodes
from ..renderer import dr, mi
from .guiding import Guide, look_around
from .lens_projector import LensProjector
from .lens_sensor import BORDER, LensSensor
from .smoothing import smoothed
from .survey import blocks, survey

DIMENSIONS_DIRECT = 6  # pixel, camera pupil, pupil of an emitter: two each
DIMENSIONS_BOUNCE = 3  # lobe and direction
DIMENSIONS_GUIDE = 2  # direction
FAST_MULTIPLE = 16  # of pixels: lengths with more factors of five take half as long again to transform


class FringeIntegrator(mi.SamplingIntegrator):
    """See the module for the parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.node_table, self.edge_table = (
            np.array(props[name]) if name in props else None for name in ("node_table", "edge_table")
        )
        for table in (self.node_table, self.edge_table):
            if table is not None and (table.ndim != 2 or table.shape[1] != DIMENSIONS_DIRECT):
                raise ValueError(
                    f"a table of nodes has the shape {table.shape}; it must be (nodes, {DIMENSIONS_DIRECT})"
                )
        self.nodes = int(props.get("nodes", 16))
        if self.node_table is not None:
            self.nodes = len(self.node_table)
        self.nodes_indirect = int(props.get("nodes_indirect", self.nodes))
        self.bounces = int(props.get("bounces", 2))
        self.shadows = bool(props.get("shadows", True))
        self.guided = bool(props.get("guided", True))
        self.smoothing = int(props.get("smoothing", 0))
        self.shift_per_pixel = bool(props.get("shift_per_pixel", False))

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The stack of all patterns, mi.TensorXf (rows, cols, N)."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        size = sensor.film().crop_size()
        channels = self.render_channels(scene, sensor, seed, int(spp))
        flat = dr.empty(mi.Float, len(channels) * dr.prod(size))
        pixel = dr.arange(mi.UInt32, dr.prod(size))
        for k, channel in enumerate(channels):
            dr.scatter(flat, channel, pixel * len(channels) + k)
        return mi.TensorXf(flat, (int(size[1]), int(size[0]), len(channels)))

    def render_channels(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: mi.UInt32 | int = 0,
        spp: int = 0,
        interreflections: list[mi.Float] | None = None,
    ) -> list[mi.Float]:
        """The images of all patterns, N arrays of rows * cols pixels each, evaluated.

        ``interreflections`` of the same scene, or one that differs by less than they can show, are not rendered again.
        """
        with dr.suspend_grad():
            channels = self._direct_light(scene, sensor, seed, spp)
            if self.bounces > 1:
                dr.eval(channels)
                more = interreflections or self.render_interreflections(scene, sensor, seed, spp)
                channels = [c + m for c, m in zip(channels, more, strict=True)]
            lit = sum(dr.abs(channel) for channel in channels) > 0
            dr.eval(channels, lit)
        return _diffracted(channels, lit, sensor) if _border(sensor) else channels

    def _direct_light(self, scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32 | int, spp: int) -> list[mi.Float]:
        count, table = spp or self.nodes, self.node_table
        if table is None or count != len(table):
            table = nodes(count, DIMENSIONS_DIRECT)
        edge_table = None if spp else self.edge_table
        centre_um = _spectrum(scene).centre_um
        ray = partial(_camera_ray, sensor, colour=centre_um)
        seen = survey(scene, _size(sensor), ray, centre_um, find_edges=edge_table is not None)
        channels = [dr.zeros(mi.Float, dr.prod(_size(sensor))) for _ in range(_channels(scene))]
        parts = [(seen.lit, table)] if edge_table is None else [(seen.lit, table), (seen.edges, edge_table)]
        for pixel, table in parts:
            if dr.width(pixel):
                light = self._accumulate(scene, sensor, pixel, seed, table, False, partial(self._visible, scene))
                for channel, value in zip(channels, light, strict=True):
                    dr.scatter(channel, value, pixel)
                dr.eval(channels)
        return channels

    def render_interreflections(
        self, scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32 | int = 0, spp: int = 0
    ) -> list[mi.Float]:
        """What ``render_channels`` adds to the direct light before the diffraction, with its border, evaluated."""
        count = max(2, self.nodes_indirect * (spp or self.nodes) // self.nodes)
        with dr.suspend_grad():
            guide = self._guide(scene, sensor) if self.guided else None
            cols, rows = _size(sensor)
            pixel = mi.UInt32(packed(blocks((rows, cols)), aligned=True))
            table = nodes(count, DIMENSIONS_DIRECT + DIMENSIONS_BOUNCE * (self.bounces - 1) + DIMENSIONS_GUIDE)
            light = self._accumulate(scene, sensor, pixel, seed, table, True, partial(self._indirect, scene, guide))
            channels = [dr.empty(mi.Float, rows * cols) for _ in light]
            for channel, value in zip(channels, light, strict=True):
                dr.scatter(channel, value, pixel)
            if self.smoothing:
                channels = self._smoothed(channels, scene, sensor)
            dr.eval(channels)
        return channels

    @dr.syntax
    def _accumulate(self, scene, sensor, pixel, seed, table, indirect, trace):
        """Mean of ``trace`` over the nodes of ``table``, (nodes, dimensions), in each ``pixel``: N arrays."""
        count, dimensions = table.shape
        table = mi.Float(table.ravel().astype(np.float32))
        if dr.hint(indirect or self.shift_per_pixel, mode="scalar"):
            # Hashed: streams that are numbered one by one are correlated between neighbouring pixels.
            key = (2 * mi.UInt32(seed) if self.shift_per_pixel else mi.UInt32(0)) + int(indirect)
            dr.make_opaque(key)
            state, stream = mi.sample_tea_32(pixel, key)
            rng = mi.PCG32(1, state, stream)  # numbered by pixel, not by lane
            shift = [rng.next_float32() for _ in range(dimensions)]
        else:
            shift = [mi.Float(0) for _ in range(dimensions)]
        shift_of_colour = rng.next_float32() if self.shift_per_pixel else 0.0

        total = [mi.Float(0) for _ in range(_channels(scene))]
        i, end = mi.UInt32(0), dr.opaque(mi.UInt32, count)
        while i < end:
            u = []
            for j in range(dimensions):
                at = dr.gather(mi.Float, table, i * dimensions + j) + shift[j]
                u.append(at - dr.floor(at))
            colour = _colour(scene, i, count, shift_of_colour)
            ray, weight = _camera_ray(sensor, pixel, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]), colour)
            path = trace(ray, weight, pixel, mi.Point2f(u[4], u[5]), colour, u[6:])
            for k in range(len(total)):
                total[k] += path[k]
            i += 1
        return [t / count for t in total]

    def _guide(self, scene: mi.Scene, sensor: mi.Sensor) -> Guide:
        middle, colour = mi.Point2f(0.5), _spectrum(scene).centre_um
        return look_around(
            scene,
            _size(sensor),
            lambda pixel: _camera_ray(sensor, pixel, middle, middle)[0],
            lambda si, ray, active: _direct(scene, si, ray, mi.Float(1), active, middle, colour, white=True)[0],
        )

    def _smoothed(self, channels: list[mi.Float], scene: mi.Scene, sensor: mi.Sensor) -> list[mi.Float]:
        size, middle = _size(sensor), mi.Point2f(0.5)
        ray, _ = _camera_ray(sensor, dr.arange(mi.UInt32, dr.prod(size)), middle, middle)
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        dr.eval(channels, si)
        return smoothed(channels, si, size, self.smoothing)

    def _visible(self, scene, ray, throughput, pixel, pupil, colour, u):
        """Radiance of what a ray sees, lit directly, and of emitters it hits: N values."""
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        glow = throughput * si.emitter(scene).eval(si)[0]
        lit = _direct(scene, si, ray, throughput, si.is_valid(), pupil, colour, shadows=self.shadows)
        return [light + glow for light in lit]

    def _indirect(self, scene, guide, ray, throughput, pixel, pupil, colour, u):
        """Radiance that reaches the first surface by way of others: N values."""
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        active = si.is_valid()
        result = [mi.Float(0) for _ in range(_channels(scene))]
        if guide is not None:
            tile = guide.tile(pixel)
            direction = mi.Point2f(u[-2], u[-1])
            result = _guided(scene, guide, tile, si, ray, throughput, active, pupil, colour, direction)
        for bounce in range(self.bounces - 1):
            lobe, x, y = u[DIMENSIONS_BOUNCE * bounce : DIMENSIONS_BOUNCE * (bounce + 1)]
            sample, factor = si.bsdf(ray).sample(mi.BSDFContext(), si, lobe, mi.Point2f(x, y), active)
            throughput *= factor[0]
            ray = si.spawn_ray(si.to_world(sample.wo))
            seen_from = si.p
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active & (throughput > 0))
            active = si.is_valid()
            delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)

            def light(si, ray, throughput, active, seen_from, pdf, delta, first=bounce == 0):
                if guide is not None and first:  # the other paths find this light, too
                    density = guide.density(tile, seen_from, si, active & ~delta)
                    density = dr.select(guide.sees(scene, tile, si, density > 0), density, 0.0)
                    throughput = throughput * pdf / (pdf + density)
                return _direct(scene, si, ray, throughput, active, pupil, colour)

            # Most paths leave the specimen here: whole vectors of lanes skip the look-up of the patterns.
            arriving = dr.if_stmt(
                args=(si, ray, throughput, active, seen_from, sample.pdf, delta),
                cond=active,
                true_fn=light,
                false_fn=lambda *_: [mi.Float(0) for _ in range(_channels(scene))],
            )
            result = [r + arriving[k] for k, r in enumerate(result)]
        return result

    def to_string(self) -> str:
        return f"FringeIntegrator[nodes={self.nodes}, bounces={self.bounces}]"


def _channels(scene: mi.Scene) -> int:
    return max((e.n_patterns for e in scene.emitters() if isinstance(e, LensProjector)), default=1)


def _size(sensor: mi.Sensor) -> tuple[int, int]:
    """(cols, rows) of what is rendered: the picture and its border."""
    size, border = sensor.film().crop_size(), _border(sensor)
    return int(size[0]) + 2 * border, int(size[1]) + 2 * border


def _camera_ray(
    sensor: mi.Sensor,
    pixel: mi.UInt32,
    within: mi.Point2f,
    pupil: mi.Point2f,
    colour: mi.Float | float = DESIGN_WAVELENGTH_UM,
) -> tuple[mi.Ray3f, mi.Float]:
    """The ray of a pixel of what is rendered, counted along rows, and its weight."""
    cols, rows = _size(sensor)
    column, row = mi.Float(pixel % cols), mi.Float(pixel // cols)
    if isinstance(sensor, LensSensor):
        offset, border = sensor.film().crop_offset(), _border(sensor)
        return sensor.pixel_ray(column + offset.x - border, row + offset.y - border, within, pupil, colour)
    film = mi.Point2f((column + within.x) / cols, (row + within.y) / rows)
    ray, weight = sensor.sample_ray(0.0, 0.5, film, pupil)
    return mi.Ray3f(ray), mi.Float(weight[0])


def _border(sensor: mi.Sensor) -> int:
    """Pixels around the picture that are rendered because their light is diffracted into it."""
    return BORDER if isinstance(sensor, LensSensor) and sensor.diffraction else 0


def _diffracted(channels: list[mi.Float], lit: mi.Bool, sensor: LensSensor) -> list[mi.Float]:
    """The channels with their border through the diffraction, and without their border.

    Only the rectangle that light falls on, and as far around it as the border is wide, has anything to diffract.
    """
    border = _border(sensor)
    cols, rows = sensor.size
    shape = rows + 2 * border, cols + 2 * border
    pictures = [channel.numpy().reshape(shape) for channel in channels]  # views: nothing is copied on a CPU
    where = lit.numpy().reshape(shape)
    if not where.any():
        return [dr.zeros(mi.Float, rows * cols) for _ in channels]
    box = tuple(_stretch(where.any(axis=1 - axis), border) for axis in (0, 1))
    # The part of the box that lies in the picture, as the picture and as the box count.
    inside = tuple(
        slice(max(0, s.start - border), min(n, s.stop - border)) for s, n in zip(box, (rows, cols), strict=True)
    )
    kept = tuple(slice(i.start + border - s.start, i.stop + border - s.start) for i, s in zip(inside, box, strict=True))

    def one(picture: np.ndarray) -> np.ndarray:
        out = np.zeros((rows, cols), np.float32)
        out[inside] = sensor.diffract(picture[box])[kept]
        return packed(out, aligned=True)

    with ThreadPoolExecutor(dr.thread_count()) as pool:
        return [mi.Float(picture) for picture in pool.map(one, pictures)]


def _stretch(lit: np.ndarray, border: int) -> slice:
    """Where ``lit`` (n,) is true and ``border`` around it, of a length that transforms fast if there is room."""
    where = np.flatnonzero(lit)
    first, end = max(0, where[0] - border), min(len(lit), where[-1] + 1 + border)
    length = end - first
    while length % FAST_MULTIPLE or cv2.getOptimalDFTSize(int(length)) != length:
        length += 1
    length = min(len(lit), length)
    first = min(first, len(lit) - length)
    return slice(first, first + length)


def _guided(scene, guide, tile, si, ray, throughput, active, pupil, colour, u):
    """Light by way of a surface that the guide proposes, N values: its share in that of one interreflection."""
    bsdf = si.bsdf(ray)
    proposed = guide.sample(tile, u, active)
    other = scene.ray_intersect(proposed, mi.RayFlags.All, coherent=False, active=active)
    active = other.is_valid()

    def light(si, other, throughput, active):
        to = si.spawn_ray_to(other.p)
        reflected, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(to.d), active)
        density = guide.density(tile, si.p, other, active)
        active = active & (reflected[0] > 0) & (density > 0)
        active &= ~scene.ray_test(to, coherent=False, active=active)
        other.wi = other.to_local(-to.d)
        share = dr.select(active, throughput * reflected[0] / (density + pdf), 0.0)
        return _direct(scene, other, to, share, active, pupil, colour)

    return dr.if_stmt(
        args=(si, other, throughput, active),
        cond=active,
        true_fn=light,
        false_fn=lambda *_: [mi.Float(0) for _ in range(_channels(scene))],
    )


def _spectrum(scene: mi.Scene) -> Spectrum:
    """Of the projector's light."""
    found = [emitter.spectrum for emitter in scene.emitters() if isinstance(emitter, LensProjector)]
    return found[0] if found else Spectrum(DESIGN_WAVELENGTH_UM, 0.0)


def _colour(scene: mi.Scene, i: mi.UInt32, count: int, shift: mi.Float | float) -> mi.Float | float:
    """Wavelength in µm of node ``i``: of equal shares of the projector's spectrum a node and its mirror image take one.

    So colour goes with no direction, and what a lens does to either does not shift the picture. Without a shift, the
    shares' middles are parted until they have the spectrum's variance.
    """
    spectrum = _spectrum(scene)
    if spectrum.fwhm_um == 0:
        return spectrum.centre_um
    shares = max(1, count // 2)
    u = mi.Float(dr.brev(i % shares)) * 2.0**-32 + 0.5 / shares + shift
    return spectrum.wavelength_um(u - dr.floor(u), spectrum.parting(shares))


def _direct(scene, si, ray, throughput, active, pupil, colour, white=False, shadows=True):
    """Light of all emitters reflected at one surface point, N values; projectors may show ``white`` instead."""
    context = mi.BSDFContext()
    bsdf = si.bsdf(ray)
    result = [mi.Float(0) for _ in range(_channels(scene))]
    for emitter in scene.emitters():
        if isinstance(emitter, LensProjector):
            point, column, row, irradiance = emitter.aim(si.p, pupil, colour)
            direction = dr.normalize(mi.Vector3f(point - si.p))
            facing = active & (dr.dot(si.n, direction) > 0)
            reflected = bsdf.eval(context, si, si.to_local(direction), facing)[0]
            if shadows:
                facing &= ~scene.ray_test(si.spawn_ray_to(point), coherent=True, active=facing)
            share = dr.select(facing, throughput * irradiance * reflected, 0.0)
            if white:
                x, y = emitter.middle
                light = [dr.select((dr.abs(column - x) < x + 1) & (dr.abs(row - y) < y + 1), 1.0, 0.0)]
            else:
                light = emitter.light(column, row, facing)
            result = [r + share * light[k % len(light)] for k, r in enumerate(result)]
        else:
            ds, radiance = emitter.sample_direction(si, pupil, active)
            reflected = bsdf.eval(context, si, si.to_local(ds.d), active)[0]
            seen = active & (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), active=active)
            glow = dr.select(seen, throughput * radiance[0] * reflected, 0.0)
            result = [r + glow for r in result]
    return result
