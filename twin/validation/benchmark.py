"""How long the costly steps take: medians of several runs, compared within one run of the benchmark."""

import time
from collections.abc import Callable
from typing import cast

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import fit_phase_height
from greenough.pipeline.spots import detect_spots

from ..plugins import FringeIntegrator
from ..renderer import dr, mi
from ..rig import open as open_twin
from ..rig import scene_dict
from .benchmarks.rows import Row

REPEATS = 5


def benchmark(rig_name: str, overrides: list[str], advance: Callable[[float], None]) -> list[Row]:
    """Time rendering, decoding, spot detection and the phase-height fit of one twin; ``advance`` is called 5 times."""
    rig, _ = open_twin(rig_name, overrides, run="benchmark")
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    patterns = np.ascontiguousarray(fringes.patterns(*rig.projector.shape))
    n = len(patterns)
    # Interleaved, so that a machine whose speed drifts slows both alike.
    scenes = [mi.load_dict(scene_dict(rig, "plane", chosen)) for chosen in (patterns, patterns[:1])]
    times = np.array([[_seconds(lambda s=scene: _render(s)) for scene in scenes] for _ in range(REPEATS + 1)])[1:]
    all_patterns, one_pattern = np.median(times, axis=0)
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    rows = [
        Row(f"render a plane, {n} patterns", all_patterns, "s", "the same, one pattern", ratio, 1.5, ratio <= 1.5),
        Row("render a plane, one pattern", one_pattern, "s"),
    ]
    advance(1)
    for placement, name in ((Placement("board", posture=0), "board"), (Placement("coin"), "coin")):
        scene = mi.load_dict(scene_dict(rig, placement, patterns))
        rows.append(Row(f"render the {name}, {n} patterns", _median(lambda s=scene: _render(s), 2), "s"))
    advance(1)
    rig.operator.place(Placement("board"))
    rig.camera.exposure_us = 60_000
    frames = rig.capture(patterns)
    rows.append(Row(f"capture {n} frames of the board", _median(lambda: rig.capture(patterns), REPEATS), "s"))
    phase_map = decode(frames, fringes, rig.camera.noise)
    rows.append(Row(f"decode {n} frames", _median(lambda: decode(frames, fringes, rig.camera.noise), 20), "s"))
    advance(1)
    rows.append(Row("find the spots", _median(lambda: detect_spots(phase_map.background, rig.board), REPEATS), "s"))
    advance(1)
    planes = rig.procedure.planes
    heights = (np.arange(planes) - (planes - 1) / 2) * rig.procedure.plane_step_mm
    column = np.arange(rig.camera.shape[1]) / rig.camera.shape[1]
    tilt = np.broadcast_to(150 + 40 * column, rig.camera.shape)
    phases = np.stack([tilt + 6.2 * z / (1 + 0.004 * z) for z in heights]).astype(np.float32)
    rows.append(Row(f"fit {planes} planes in every pixel", _median(lambda: fit_phase_height(phases, heights), 2), "s"))
    advance(1)
    return rows


def _render(scene: mi.Scene) -> None:
    cast(FringeIntegrator, scene.integrator()).render_channels(scene, scene.sensors()[0])
    dr.sync_thread()


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _median(work: Callable[[], object], repeats: int) -> float:
    work()  # compiles
    return float(np.median([_seconds(work) for _ in range(repeats)]))
