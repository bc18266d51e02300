"""Renders the images of all patterns of the lens projectors in one pass over one set of light paths.

.. pluginparameters::

 * - nodes: integer
     Light paths per pixel, a power of two (default: 16); ``spp`` of mi.render overrides it.
 * - bounces: integer
     Surface interactions of a path: 1 is direct light only, 2 adds one interreflection (default: 2).
 * - shift_per_pixel: boolean
     Shift the nodes by a random vector in each pixel, seeded by ``seed`` (default: false). The fixed nodes make an
     error that is smooth and part of the optics; shifted ones are unbiased and noisy, and serve to show so.

The result of ``mi.render`` is a tensor (rows, cols, N), a channel per pattern. The light of other emitters is the same
in all channels. Glossy surfaces are met by sampling the emitters, so that mirror-like ones need an emitter with an
extent that rays can hit.
"""

import drjit as dr
import mitsuba as mi

from ..quadrature import nodes
from .lens_projector import LensProjector

DIMENSIONS_CAMERA = 4  # pixel, camera pupil
DIMENSIONS_LIGHT = 2  # pupil of an emitter
DIMENSIONS_BOUNCE = 3  # lobe and direction


class FringeIntegrator(mi.SamplingIntegrator):
    """See the module for the parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.nodes = int(props.get("nodes", 16))
        self.bounces = int(props.get("bounces", 2))
        self.shift_per_pixel = bool(props.get("shift_per_pixel", False))

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The stack of all patterns, mi.TensorXf (rows, cols, N)."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        size = sensor.film().crop_size()
        channels = self.render_channels(scene, sensor, int(seed), int(spp) or self.nodes)
        flat = dr.empty(mi.Float, len(channels) * dr.prod(size))
        pixel = dr.arange(mi.UInt32, dr.prod(size))
        for k, channel in enumerate(channels):
            dr.scatter(flat, channel, pixel * len(channels) + k)
        return mi.TensorXf(flat, (int(size[1]), int(size[0]), len(channels)))

    def render_channels(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, count: int) -> list[mi.Float]:
        """The images of all patterns, N arrays of rows * cols pixels each, evaluated."""
        with dr.suspend_grad():
            channels = self._accumulate(scene, sensor, seed, count)
            dr.eval(channels)
        return channels

    @dr.syntax
    def _accumulate(self, scene, sensor, seed, count):
        size = sensor.film().crop_size()
        offset = sensor.film().crop_offset()
        cols, rows = int(size[0]), int(size[1])
        dimensions = DIMENSIONS_CAMERA + DIMENSIONS_LIGHT + DIMENSIONS_BOUNCE * (self.bounces - 1)
        table = mi.Float(nodes(count, dimensions).ravel())
        pixel = dr.arange(mi.UInt32, rows * cols)
        column, row = mi.Float(pixel % cols), mi.Float(pixel // cols)
        if dr.hint(self.shift_per_pixel, mode="scalar"):
            rng = mi.PCG32(rows * cols, initstate=seed)
            shift = [rng.next_float32() for _ in range(dimensions)]
        else:
            shift = [mi.Float(0) for _ in range(dimensions)]

        projectors = [e for e in scene.emitters() if isinstance(e, LensProjector)]
        others = [e for e in scene.emitters() if not isinstance(e, LensProjector)]
        n = max((p.n_patterns for p in projectors), default=1)
        total = [mi.Float(0) for _ in range(n)]
        i = mi.UInt32(0)
        while i < count:
            u = []
            for j in range(dimensions):
                at = dr.gather(mi.Float, table, i * dimensions + j) + shift[j]
                u.append(at - dr.floor(at))
            film = mi.Point2f((column + offset.x + u[0]) / cols, (row + offset.y + u[1]) / rows)
            ray, weight = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(u[2], u[3]))
            path = self._trace(scene, ray, weight, u[DIMENSIONS_CAMERA:], projectors, others, n)
            for k in range(n):
                total[k] += path[k]
            i += 1
        return [t / count for t in total]

    def _trace(self, scene, ray, weight, u, projectors, others, n):
        """Radiance of all patterns along one ray, N values, with the samples ``u`` of light and bounces."""
        throughput = mi.Float(weight[0])
        pupil = mi.Point2f(u[0], u[1])
        ray = mi.Ray3f(ray)
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        active = si.is_valid()
        result = self._direct(scene, si, ray, throughput, active, pupil, projectors, others, n)
        glow = throughput * si.emitter(scene).eval(si)[0]
        result = [r + glow for r in result]
        for bounce in range(1, self.bounces):
            lobe = u[DIMENSIONS_LIGHT + DIMENSIONS_BOUNCE * (bounce - 1) :]
            sample, factor = si.bsdf(ray).sample(mi.BSDFContext(), si, lobe[0], mi.Point2f(lobe[1], lobe[2]), active)
            throughput *= factor[0]
            ray = si.spawn_ray(si.to_world(sample.wo))
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active & (throughput > 0))
            active = si.is_valid()
            # Most paths leave the specimen here: whole vectors of lanes skip the look-up of the patterns.
            light = dr.if_stmt(
                args=(si, ray, throughput, active),
                cond=active,
                true_fn=lambda si, ray, throughput, active: self._direct(
                    scene, si, ray, throughput, active, pupil, projectors, others, n
                ),
                false_fn=lambda si, ray, throughput, active: [mi.Float(0) for _ in range(n)],
            )
            result = [r + light[k] for k, r in enumerate(result)]
        return result

    def _direct(self, scene, si, ray, throughput, active, pupil, projectors, others, n):
        """Light of all emitters reflected at one surface point, N values."""
        context = mi.BSDFContext()
        bsdf = si.bsdf(ray)
        result = [mi.Float(0) for _ in range(n)]
        for projector in projectors:
            point, column, row, white = projector.aim(si.p, pupil)
            direction = dr.normalize(mi.Vector3f(point - si.p))
            facing = active & (dr.dot(si.n, direction) > 0)
            reflected = bsdf.eval(context, si, si.to_local(direction), facing)[0]
            facing &= ~scene.ray_test(si.spawn_ray_to(point), coherent=True, active=facing)
            share = dr.select(facing, throughput * white * reflected, 0.0)
            light = projector.light(column, row, facing)
            result = [r + share * light[k % projector.n_patterns] for k, r in enumerate(result)]
        for emitter in others:
            ds, radiance = emitter.sample_direction(si, pupil, active)
            reflected = bsdf.eval(context, si, si.to_local(ds.d), active)[0]
            seen = active & (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), active=active)
            glow = dr.select(seen, throughput * radiance[0] * reflected, 0.0)
            result = [r + glow for r in result]
        return result

    def to_string(self) -> str:
        return f"FringeIntegrator[nodes={self.nodes}, bounces={self.bounces}]"
