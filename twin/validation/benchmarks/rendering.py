"""Rendering: all patterns of the ball grid array beside Mitsuba's own plugins, and what lenses and glass cost.

Both renderers show the same meshes and materials to the same pinholes with as many bounces, ours all patterns in one
pass, theirs frame by frame, each frame from the same random numbers: what they have in common cancels in the phase.
They are compared in the middle of the rig's picture, in its own pixels: whole frames of theirs would take too long.

Sampling error. It is the root mean square error of the phase of the densest fringe set over the pixels that have
fringes. Of their independent paths it is the difference of two renders over the square root of two; of our nodes, which
are fixed, the difference from the mean of two renders of many paths each, shifted at random in every pixel, without the
smoothing of interreflections. What this reference has itself counts as ours. How many paths of theirs have the same
error follows from their errors at three numbers of paths: between them by a straight line of the logarithms, beyond by
the square root law, than which no independent paths do better; how long those take, from the times of two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, cast

import numpy as np

from greenough.instrument.contract import BLANK, Placement

from ...plugins import FringeIntegrator
from ...renderer import dr, mi
from ...rig import TwinRig, fringe_patterns, scene_dict
from ...rig import open as open_twin
from .own_plugins import PINHOLES, OwnPlugins, own_plugins
from .rows import Row, interleaved, limited

CROP = (160, 120)
"""Columns and rows of the picture's middle that are compared."""

EQUAL_SAMPLES = 16
SAMPLES = (16, 64, 256)
REFERENCE_SAMPLES = 512
FRINGES = 0.05
"""Least contrast of a pixel that has fringes, relative to a white Lambertian surface's."""

REPEATS = 3
SIGMAS = 4.0
"""Most standard errors between two means that are equal: more come by chance once in 16 000 times."""

EQUAL_SAMPLES_LIMIT = 1 / 15
EQUAL_ERROR_LIMIT = 1 / 50

PARTS: dict[str, Placement] = {
    "the blank plane": Placement("board", face=BLANK),
    "the board": Placement("board", posture=0),
    "the coin": Placement("coin"),
    "the BGA": Placement("bga"),
}
LENSES: dict[str, tuple[str, ...]] = {"pinholes": PINHOLES, "thin lenses": PINHOLES[:1], "glass": ()}
COARSER = 2
"""Times as large pixels of the same field in which parts are compared behind several lenses."""


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """All rows of this section."""
    return [
        *own_plugin_rows(rig_name, overrides),
        *lens_rows(rig_name, overrides),
        *calibration_rows(rig_name, overrides),
    ]


def own_plugin_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Both render the same light; the times for as many paths, and for the same error."""
    both = both_renderers(rig_name, overrides)
    samples, theirs = np.array(SAMPLES), [[both.theirs(n, seed) for seed in (1, 2)] for n in SAMPLES]
    reference = [both.reference(seed) for seed in (1, 2)]
    mean = (reference[0] + reference[1]) / 2
    lit = both.has_fringes(mean)
    error = phase_rms(both.ours(), mean, lit)
    errors = [phase_rms(a, b, lit) / sqrt(2) for a, b in theirs]
    needed = samples_for(error, samples, errors)

    works = {
        "ours": both.ours,
        "ours, equal": both.ours_equal,
        **{f"theirs, {n}": lambda n=n: both.own.render(n, range(both.frames)) for n in SAMPLES[:2]},
    }
    times = interleaved(works, REPEATS)
    few, more = (times[f"theirs, {n}"] for n in SAMPLES[:2])
    per_sample = (more - few) / (SAMPLES[1] - SAMPLES[0])
    at_equal_error = few + per_sample * (needed - SAMPLES[0])
    peer = "Mitsuba's own plugins"
    size = f"{CROP[0]} x {CROP[1]} px"
    n = EQUAL_SAMPLES
    return [
        *same_light_rows(theirs[-1], reference, lit, peer),
        limited(
            f"BGA, all patterns, {n} paths, {size}",
            times["ours, equal"], "s", f"{peer}, {n} paths, one by one", times["ours, equal"] / few,
            EQUAL_SAMPLES_LIMIT,
        ),
        limited(
            f"BGA, all patterns, as the rig renders it, {size}",
            times["ours"], "s", f"{peer}, the same error, one by one", times["ours"] / at_equal_error,
            EQUAL_ERROR_LIMIT,
        ),
        Row("sampling error of the BGA's densest fringes", error, "rad", f"{peer}, {SAMPLES[-1]} paths",
            error / errors[-1]),
        *(Row(f"sampling error of {peer}, {k} paths", e, "rad") for k, e in zip(SAMPLES, errors, strict=True)),
        Row(f"paths of {peer} for the same error", needed, "1"),
    ]  # fmt: skip


def same_light_rows(theirs: Sequence[np.ndarray], ours: Sequence[np.ndarray], lit: np.ndarray, peer: str) -> list[Row]:
    """How far mean light and mean phase of the two renderers, two stacks of independent paths each, differ."""
    light = [[stack.mean(axis=-1) for stack in pair] for pair in (ours, theirs)]
    z_light = standard_errors([a - b for a, b in zip(*light, strict=True)])
    phasors = [[densest(stack)[lit] for stack in pair] for pair in (ours, theirs)]
    z_phase = standard_errors([np.angle(a * b.conj()) for a, b in zip(*phasors, strict=True)])
    return [
        limited(f"{what}, ours against {peer}", z, "standard errors", None, None, SIGMAS)
        for what, z in (("mean light", z_light), ("mean phase", z_phase))
    ]


def standard_errors(differences: Sequence[np.ndarray]) -> float:
    """How many of its standard errors the mean of two independent pictures of ``differences`` is from zero."""
    first, second = differences
    scatter = np.sqrt(np.sum((first - second) ** 2)) / (2 * first.size)
    return float(abs(first.mean() + second.mean()) / 2 / scatter)


def samples_for(error: float, samples: np.ndarray, errors: Sequence[float]) -> float:
    """Number of paths that has ``error``, from the ``errors`` of increasing numbers of ``samples``; see the module.

    NaN where it would be less than the first of them.
    """
    if error < errors[-1]:
        return float(samples[-1] * (errors[-1] / error) ** 2)
    return float(np.exp(np.interp(-np.log(error), -np.log(errors), np.log(samples), left=np.nan)))


def densest(stack: np.ndarray) -> np.ndarray:
    """Phasors (rows, cols) of the last fringe set of a ``stack``, (rows, cols, steps) of that set alone."""
    steps = stack.shape[-1]
    return stack @ np.exp(-2j * np.pi * np.arange(steps) / steps)


def phase_rms(stack: np.ndarray, other: np.ndarray, where: np.ndarray) -> float:
    """Root mean square difference of two stacks' phases, rad."""
    difference = np.angle(densest(stack) * densest(other).conj())[where]
    return float(np.sqrt(np.mean(difference**2)))


@dataclass(frozen=True, eq=False)
class BothRenderers:
    """One scene in both renderers. Stacks are (rows, cols, steps) of the densest fringe set."""

    scene: dict[str, Any]  # ours
    as_the_rig: mi.Scene
    equal: mi.Scene
    own: OwnPlugins
    frames: int
    steps: int

    def ours(self) -> np.ndarray:
        """As the rig renders it."""
        return self._densest(self.as_the_rig)

    def ours_equal(self) -> np.ndarray:
        """With as many paths as theirs, one for direct light and one for interreflections to each of theirs."""
        return self._densest(self.equal)

    def reference(self, seed: int) -> np.ndarray:
        """Many paths, shifted at random in every pixel."""
        integrator = self.scene["integrator"]
        unbiased = {"nodes_indirect": len(integrator["node_table"]), "smoothing": 0, "shift_per_pixel": True}
        scene = mi.load_dict(self.scene | {"integrator": integrator | unbiased})
        return self._densest(scene, seed, REFERENCE_SAMPLES)

    def theirs(self, samples: int, seed: int) -> np.ndarray:
        """Of so many paths."""
        dense = range(self.frames - self.steps, self.frames)
        return np.concatenate([np.array(frame) for frame in self.own.render(samples, dense, seed)], axis=-1)

    def has_fringes(self, stack: np.ndarray) -> np.ndarray:
        """Where the fringes are strong enough to count, (rows, cols)."""
        white = self.steps / (4 * np.pi)  # half the radiance of 1/pi, and half the steps' number
        return np.abs(densest(stack)) > FRINGES * white

    def _densest(self, scene: mi.Scene, seed: int = 0, spp: int = 0) -> np.ndarray:
        integrator = cast(FringeIntegrator, scene.integrator())
        channels = integrator.render_channels(scene, scene.sensors()[0], seed, spp)[-self.steps :]
        cols, rows = CROP
        return np.stack([channel.numpy().reshape(rows, cols) for channel in channels], axis=-1)


def both_renderers(rig_name: str, overrides: Sequence[str]) -> BothRenderers:
    """The ball grid array under a rig's pinholes, in the middle of its picture."""
    rig, bench = open_twin(rig_name, [*overrides, *PINHOLES], run="benchmark")
    patterns = fringe_patterns(rig)
    scene = scene_dict(rig, "bga", patterns)
    scene["sensor"] |= {"film": _cropped(scene["sensor"]["film"])}
    counts = {"nodes": EQUAL_SAMPLES, "nodes_indirect": EQUAL_SAMPLES, "guided": False, "smoothing": 0}
    integrator = {name: value for name, value in scene["integrator"].items() if name != "node_table"}
    return BothRenderers(
        scene,
        mi.load_dict(scene),
        mi.load_dict(scene | {"integrator": integrator | counts}),
        own_plugins(scene, bench.settings, patterns),
        len(patterns),
        rig.procedure.steps[-1],
    )


def _cropped(film: dict[str, Any]) -> dict[str, Any]:
    cols, rows = CROP
    offset = {"crop_offset_x": (film["width"] - cols) // 2, "crop_offset_y": (film["height"] - rows) // 2}
    return film | {"crop_width": cols, "crop_height": rows} | offset


def lens_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """What lenses and glass add to pinholes, in coarser pixels of the whole field; nothing of it has a limit."""
    rig, bench = open_twin(rig_name, overrides, run="benchmark")
    rows, cols = rig.camera.shape
    pixels = [
        f"camera.rows={rows // COARSER}",
        f"camera.cols={cols // COARSER}",
        f"twin.optics.camera_focal_px={bench.settings.optics.camera_focal_px / COARSER}",
    ]
    found = []
    for part, placement in PARTS.items():
        works = {}
        for lenses, settings in LENSES.items():
            rig, _ = open_twin(rig_name, [*overrides, *pixels, *settings], run="benchmark")
            works[lenses] = rendering(rig, placement)
        times = interleaved(works, 1)
        pinholes = next(iter(LENSES))
        for lenses, seconds in times.items():
            name = f"render {part} in coarser pixels, all patterns, {lenses}"
            found.append(Row(name, seconds, "s", f"the same, {pinholes}", seconds / times[pinholes]))
    return found


def rendering(rig: TwinRig, placement: Placement) -> Callable[[], None]:
    """A work that renders all patterns of a rig's procedure on one part."""
    scene = mi.load_dict(scene_dict(rig, placement, fringe_patterns(rig)))

    def render() -> None:
        cast(FringeIntegrator, scene.integrator()).render_channels(scene, scene.sensors()[0])
        dr.sync_thread()

    return render


def calibration_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Captures as a calibration makes them, each of a scene that was not rendered before, and of all of them."""
    rig, _ = open_twin(rig_name, overrides, run="benchmark")
    patterns, procedure = fringe_patterns(rig), rig.procedure
    rig.camera.exposure_us = rig.camera.exposure_limits_us[0]
    postures = iter(range(REPEATS + 1))
    heights = iter(0.1 * np.arange(REPEATS + 1))

    def posture() -> None:
        rig.operator.place(Placement("board", posture=next(postures)))
        rig.stage.move_to_mm(0.0)
        rig.capture(patterns)

    def plane() -> None:
        rig.operator.place(Placement("board", face=BLANK))
        rig.stage.move_to_mm(float(next(heights)))
        rig.capture(patterns)

    times = interleaved({"posture": posture, "plane": plane}, REPEATS)
    captures = procedure.postures * times["posture"] + (procedure.planes + 1) * times["plane"]
    return [
        Row("place and capture a posture, all patterns", times["posture"], "s"),
        Row("move and capture a plane, all patterns", times["plane"], "s"),
        Row("captures of a whole calibration", captures, "s"),
    ]
