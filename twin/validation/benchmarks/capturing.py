"""Captures as a calibration makes them: all patterns in one pass, the camera's noise on them, and the spots found."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.spots import detect_spots

from ...plugins import FringeIntegrator
from ...renderer import dr, mi
from ...rig import TwinRig, fringe_patterns, scene_dict
from ...rig import open as open_twin
from .rows import Row, interleaved, limited

ONE_PASS_LIMIT = 1.5
"""Of the time that one pattern takes."""

EXPOSURE_US = 60_000.0
REPEATS = 5


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """All patterns beside one, a whole capture, and the search for the board's spots in it."""
    rig, _ = open_twin(rig_name, overrides, run="benchmark")
    return [*one_pass_rows(rig), *capture_rows(rig)]


def one_pass_rows(rig: TwinRig) -> list[Row]:
    """What more patterns cost, which are all looked up on the same light paths."""
    patterns = fringe_patterns(rig)
    works = {name: _rendering(rig, chosen) for name, chosen in (("all", patterns), ("one", patterns[:1]))}
    times = interleaved(works, REPEATS)
    one = "render a plane, one pattern"
    return [
        limited(
            "render a plane, all patterns", times["all"], "s", one, times["all"] / times["one"], limit=ONE_PASS_LIMIT
        ),
        Row(one, times["one"], "s"),
    ]


def capture_rows(rig: TwinRig) -> list[Row]:
    """Frames of the board with everything that the twin does to them, and its spots."""
    patterns = fringe_patterns(rig)
    rig.operator.place(Placement("board"))
    rig.camera.exposure_us = EXPOSURE_US
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    background = decode(rig.capture(patterns), fringes, rig.camera.noise).background
    works = {
        "capture the board, all patterns": lambda: rig.capture(patterns),
        "find the board's spots": lambda: detect_spots(background, rig.board),
    }
    return [Row(name, seconds, "s") for name, seconds in interleaved(works, REPEATS).items()]


def _rendering(rig: TwinRig, patterns: np.ndarray) -> Callable[[], None]:
    scene = mi.load_dict(scene_dict(rig, "plane", patterns))

    def render() -> None:
        cast(FringeIntegrator, scene.integrator()).render_channels(scene, scene.sensors()[0])
        dr.sync_thread()

    return render
