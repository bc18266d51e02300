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
 * - bounces: integer
     Surface interactions of a path: 1 is direct light only, 2 adds one interreflection (default: 2).
 * - shift_per_pixel: boolean
     Shift the nodes by a random vector in each pixel, seeded by ``seed`` (default: false). The fixed nodes make an
     error that is smooth and part of the optics; shifted ones are unbiased and noisy, and serve to show so.

The result of ``mi.render`` is a tensor (rows, cols, N), a channel per pattern. The light of other emitters is the same
in all channels. Glossy surfaces are met by sampling the emitters, so that mirror-like ones need an emitter with an
extent that rays can hit.
"""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from ..quadrature import nodes
from ..renderer import dr, mi
from .lens_projector import LensProjector
from .lens_sensor import BORDER, LensSensor

DIMENSIONS_CAMERA = 4  # pixel, camera pupil
DIMENSIONS_LIGHT = 2  # pupil of an emitter
DIMENSIONS_BOUNCE = 3  # lobe and direction
FAST_MULTIPLE = 16  # of pixels: lengths with more factors of five take half as long again to transform


class FringeIntegrator(mi.SamplingIntegrator):
    """See the module for the parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.node_table = np.array(props["node_table"]) if "node_table" in props else None
        self.nodes = int(props.get("nodes", 16))
        if self.node_table is not None:
            self.nodes = len(self.node_table)
        self.nodes_indirect = int(props.get("nodes_indirect", self.nodes))
        self.bounces = int(props.get("bounces", 2))
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
        self, scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32 | int = 0, spp: int = 0
    ) -> list[mi.Float]:
        """The images of all patterns, N arrays of rows * cols pixels each, evaluated."""
        nodes_direct = spp or self.nodes
        nodes_indirect = max(2, self.nodes_indirect * nodes_direct // self.nodes)
        with dr.suspend_grad():
            channels = self._accumulate(scene, sensor, seed, nodes_direct, indirect=False)
            if self.bounces > 1:
                dr.eval(channels)
                more = self._accumulate(scene, sensor, seed, nodes_indirect, indirect=True)
                channels = [c + m for c, m in zip(channels, more, strict=True)]
            lit = sum(dr.abs(channel) for channel in channels) > 0
            dr.eval(channels, lit)
        return _diffracted(channels, lit, sensor) if _border(sensor) else channels

    @dr.syntax
    def _accumulate(self, scene, sensor, seed, count, indirect):
        """Mean over ``count`` nodes of the direct or of the indirect light, N arrays."""
        size = sensor.film().crop_size()
        offset = sensor.film().crop_offset()
        border = _border(sensor)
        cols, rows = int(size[0]) + 2 * border, int(size[1]) + 2 * border
        bounces = self.bounces - 1 if indirect else 0
        dimensions = DIMENSIONS_CAMERA + DIMENSIONS_LIGHT + DIMENSIONS_BOUNCE * bounces
        designed = self.node_table is not None and count == self.nodes and not indirect
        table = mi.Float((self.node_table if designed else nodes(count, dimensions)).ravel().astype(np.float32))
        pixel = dr.arange(mi.UInt32, rows * cols)
        column, row = mi.Float(pixel % cols), mi.Float(pixel // cols)
        if dr.hint(self.shift_per_pixel, mode="scalar"):
            # Hashed: streams that are numbered one by one are correlated between neighbouring pixels.
            key = 2 * mi.UInt32(seed) + int(indirect)
            dr.make_opaque(key)
            state, stream = mi.sample_tea_32(pixel, key)
            rng = mi.PCG32(rows * cols, state, stream)
            shift = [rng.next_float32() for _ in range(dimensions)]
        else:
            shift = [mi.Float(0) for _ in range(dimensions)]

        total = [mi.Float(0) for _ in range(_channels(scene))]
        i, end = mi.UInt32(0), dr.opaque(mi.UInt32, count)
        while i < end:
            u = []
            for j in range(dimensions):
                at = dr.gather(mi.Float, table, i * dimensions + j) + shift[j]
                u.append(at - dr.floor(at))
            if dr.hint(isinstance(sensor, LensSensor), mode="scalar"):
                weight = mi.Spectrum(1.0)
                ray = sensor.pixel_ray(
                    column + offset.x - border, row + offset.y - border, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3])
                )
            else:
                film = mi.Point2f((column + u[0]) / cols, (row + u[1]) / rows)
                ray, weight = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(u[2], u[3]))
            pupil = mi.Point2f(u[4], u[5])
            if dr.hint(indirect, mode="scalar"):
                path = self._indirect(scene, mi.Ray3f(ray), mi.Float(weight[0]), pupil, u[6:])
            else:
                path = self._visible(scene, mi.Ray3f(ray), mi.Float(weight[0]), pupil)
            for k in range(len(total)):
                total[k] += path[k]
            i += 1
        return [t / count for t in total]

    def _visible(self, scene, ray, throughput, pupil):
        """Radiance of what a ray sees, lit directly, and of emitters it hits: N values."""
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        glow = throughput * si.emitter(scene).eval(si)[0]
        return [light + glow for light in _direct(scene, si, ray, throughput, si.is_valid(), pupil)]

    def _indirect(self, scene, ray, throughput, pupil, u):
        """Radiance that reaches the first surface by way of others: N values."""
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        active = si.is_valid()
        result = [mi.Float(0) for _ in range(_channels(scene))]
        for bounce in range(self.bounces - 1):
            lobe, x, y = u[DIMENSIONS_BOUNCE * bounce : DIMENSIONS_BOUNCE * (bounce + 1)]
            sample, factor = si.bsdf(ray).sample(mi.BSDFContext(), si, lobe, mi.Point2f(x, y), active)
            throughput *= factor[0]
            ray = si.spawn_ray(si.to_world(sample.wo))
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active & (throughput > 0))
            active = si.is_valid()
            # Most paths leave the specimen here: whole vectors of lanes skip the look-up of the patterns.
            light = dr.if_stmt(
                args=(si, ray, throughput, active),
                cond=active,
                true_fn=lambda si, ray, throughput, active: _direct(scene, si, ray, throughput, active, pupil),
                false_fn=lambda si, ray, throughput, active: [mi.Float(0) for _ in range(_channels(scene))],
            )
            result = [r + light[k] for k, r in enumerate(result)]
        return result

    def to_string(self) -> str:
        return f"FringeIntegrator[nodes={self.nodes}, bounces={self.bounces}]"


def _channels(scene: mi.Scene) -> int:
    return max((e.n_patterns for e in scene.emitters() if isinstance(e, LensProjector)), default=1)


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
        return out.ravel()

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


def _direct(scene, si, ray, throughput, active, pupil):
    """Light of all emitters reflected at one surface point, N values."""
    context = mi.BSDFContext()
    bsdf = si.bsdf(ray)
    result = [mi.Float(0) for _ in range(_channels(scene))]
    for emitter in scene.emitters():
        if isinstance(emitter, LensProjector):
            point, column, row, white = emitter.aim(si.p, pupil)
            direction = dr.normalize(mi.Vector3f(point - si.p))
            facing = active & (dr.dot(si.n, direction) > 0)
            reflected = bsdf.eval(context, si, si.to_local(direction), facing)[0]
            facing &= ~scene.ray_test(si.spawn_ray_to(point), coherent=True, active=facing)
            share = dr.select(facing, throughput * white * reflected, 0.0)
            light = emitter.light(column, row, facing)
            result = [r + share * light[k % emitter.n_patterns] for k, r in enumerate(result)]
        else:
            ds, radiance = emitter.sample_direction(si, pupil, active)
            reflected = bsdf.eval(context, si, si.to_local(ds.d), active)[0]
            seen = active & (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), active=active)
            glow = dr.select(seen, throughput * radiance[0] * reflected, 0.0)
            result = [r + glow for r in result]
    return result
