"""What `greenough check` finds out about a rig: a few frames and, if it may, a few moves, each judged by a figure.

The white side of the calibration board lies under the lenses. Frames of black and white set the exposure and show
light, ambient light and saturation; four steps of the finest fringes show modulation; stripes of a width of their own
in every frame show whether each frame holds the pattern that it was exposed for.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from .contract import BLANK, Frames, Placement, Rig, Stage
from .device_errors import DeviceError
from .errors import InputError
from .frame_figures import (
    BRIGHTEST_PERCENTILE,
    bright_part,
    dropped_frames,
    fringe_patterns,
    lit_pixels,
    median_contrast,
    modulation_maps,
    saturated,
    shown_patterns,
    stripe_patterns,
)
from .journal import describe

LARGEST_AMBIENT = 0.05
"""Ambient light over white light. It adds noise and no modulation: 5 % of it are 5 % more noise of phase, because the
mean of fringes is half of white and noise grows with the root of light: √(1 + 2 · 0.05)."""

LEAST_LIGHT = 0.5
"""White light over what the exposure aims at. The board's white side is among the brightest parts there are: where half
of the aim is all that the longest exposure gives, parts to be measured have no light to spare."""

LARGEST_SATURATED_SHARE = 1 - BRIGHTEST_PERCENTILE / 100
"""What the aimed exposure leaves above the bright part."""

LEAST_MODULATION = 0.5
"""Median modulation of the finest fringes over their mean. At half of the ideal 1 heights have twice the noise, as from
a quarter of the light."""

LARGEST_MISS_UM = 10.0
"""A stage's reading from where it was sent: what the drivers take for arrived."""

_RETRIES = 6  # lead from any exposure to any other, of limits that are 1 : 1000
_LARGEST_STEP = 16.0
_CLIPPED = 0.98  # of full scale: brighter parts may have lost light
_TOLERANCE = 0.05  # of the aimed grey value
_NO_LIGHT = 0.05  # of the aim
_NAMED = 3  # frames in a remedy
_HOME = "home the stage, which moves it through its whole travel: greenough check RIG --move"


@dataclass(frozen=True)
class Check:
    """One row of what was found.

    Parameters
    ----------
    check : str
    figure : float or None
        None where it could not be taken.
    unit, limit : str
        The limit is in the same unit, with the sign that says on which side of it the figure must be.
    holds : bool or None
        None where it cannot be judged before another check holds.
    remedy : str
        What is wrong and what to do; empty where the check holds.
    """

    check: str
    figure: float | None
    unit: str
    limit: str
    holds: bool | None
    remedy: str


def describe_as_it_stands(rig: Rig) -> dict[str, Any]:
    """All that a rig tells about itself; not-a-number for the position of a stage that does not vouch for it."""
    try:
        return asdict(describe(rig))
    except DeviceError:
        stage = SimpleNamespace(limits_mm=rig.stage.limits_mm, position_mm=math.nan)
        same = ("identity", "board", "procedure", "uncertainty", "camera", "projector")
        known = SimpleNamespace(stage=stage, **{name: getattr(rig, name) for name in same})
        return asdict(describe(cast(Rig, known)))


def check_rig(rig: Rig, move: bool = False, as_it_lies: bool = False) -> tuple[Check, ...]:
    """Check a rig that is open. Frames are taken in any case; the exposure stays as it was set for them.

    Parameters
    ----------
    rig : Rig
    move : bool
        Home the stage if need be and drive it to both ends, before anything is placed.
    as_it_lies : bool
        Look at what lies under the lenses, in place of the white side of the board.

    Raises
    ------
    InputError
        As the operator does, and when nothing can be captured for another reason than a device's.
    """
    homed = check_homed(rig.stage, move)
    rows = [homed, check_moves(rig.stage, bool(homed.holds))] if move else [homed]
    if not as_it_lies:
        rig.operator.place(Placement("board", face=BLANK))
    return (*rows, *check_frames(rig))


def check_homed(stage: Stage, move: bool) -> Check:
    """Whether the stage vouches for its position; where it ``move``s, it is homed before if it can be and must."""

    def row(homed: bool, remedy: str) -> Check:
        return Check("stage_homed", float(homed), "", "≥ 1", homed, remedy)

    try:
        if move and not _is_homed(stage) and hasattr(stage, "home"):
            cast(Any, stage).home()
        if not _is_homed(stage):
            return row(False, f"the stage does not know where it is: {_HOME}")
        _ = stage.position_mm  # raises what else keeps the stage from vouching for it
    except DeviceError as error:
        return row(False, str(error))
    return row(True, "")


def _is_homed(stage: Stage) -> bool:
    """A stage that cannot say so is always homed."""
    return bool(getattr(stage, "homed", True))


def check_moves(stage: Stage, homed: bool) -> Check:
    """Drive a stage that is ``homed`` to 0 mm, to both its ends and back; what it reads must be where it was sent."""
    name, unit, limit = "stage_moves", "um", f"≤ {LARGEST_MISS_UM:g}"
    if not homed:
        return _unjudged(name, unit, limit, "stage_homed")
    low, high = stage.limits_mm
    missed_um = []
    try:
        for target in (0.0, low, high, 0.0):
            stage.move_to_mm(target)
            missed_um.append(1e3 * abs(stage.position_mm - target))
    except InputError as error:
        return Check(name, None, unit, limit, False, str(error))
    holds = max(missed_um) <= LARGEST_MISS_UM
    remedy = (
        f"the stage stands {max(missed_um):.3g} um from where it was sent: clear the way of the table, and compare the "
        "microstep in the rig file with the stage's data sheet"
    )
    return Check(name, max(missed_um), unit, limit, holds, "" if holds else remedy)


def check_frames(rig: Rig) -> tuple[Check, ...]:
    """Take frames and judge them: ambient light, light, saturation, modulation, order, dropped frames."""
    captured: list[Frames] = []
    errors: list[DeviceError] = []

    def capture(patterns: np.ndarray) -> Frames | DeviceError:
        try:
            captured.append(rig.capture(patterns))
        except DeviceError as error:  # the next capture may well succeed
            errors.append(error)
            return error
        return captured[-1]

    shape, procedure = rig.projector.shape, rig.procedure
    pair = _set_exposure(rig, capture)
    levels = check_levels(pair, _aim_dn(rig), rig.camera.exposure_limits_us)
    lit = isinstance(pair, DeviceError) or bool(levels[1].holds)
    light = None if isinstance(pair, DeviceError) else pair.stack[1].astype(np.float32) - pair.stack[0]
    modulation = check_modulation(capture(fringe_patterns(shape, procedure.periods_px[-1], 4)), light, lit)
    order = check_order(capture(stripe_patterns(shape)), lit, modulation.holds is not False)
    return (*levels, modulation, order, check_dropped(captured, errors))


def _aim_dn(rig: Rig) -> float:
    """Grey value above black that the exposure aims at for the bright part."""
    camera, noise = rig.camera, rig.camera.noise
    full_scale = camera.full_scale_dn - camera.black_level_dn
    if noise is not None:
        full_scale = min(full_scale, noise.full_well_e / noise.electrons_per_dn)
    return rig.procedure.exposure_share * full_scale


def _set_exposure(rig: Rig, capture: Callable[[np.ndarray], Frames | DeviceError]) -> Frames | DeviceError:
    """Bring the bright part of a white frame to the aim, and return the last pair of frames: black, white."""
    camera, aim = rig.camera, _aim_dn(rig)
    full_scale = aim / rig.procedure.exposure_share
    shortest, longest = camera.exposure_limits_us
    patterns = np.zeros((2, *rig.projector.shape), dtype=np.uint8)
    patterns[1] = 255
    try:
        if not shortest <= camera.exposure_us <= longest:
            camera.exposure_us = min(max(camera.exposure_us, shortest), longest)
        pair = capture(patterns)
        for _ in range(_RETRIES):
            if isinstance(pair, DeviceError):
                break
            bright = bright_part(pair.stack[1]) - pair.black_level_dn
            clipped = bright >= _CLIPPED * full_scale
            step = 1 / _LARGEST_STEP if clipped else aim / max(bright, aim / _LARGEST_STEP)
            exposure_us = min(max(camera.exposure_us * step, shortest), longest)
            if abs(step - 1) <= _TOLERANCE or exposure_us == camera.exposure_us:
                break
            camera.exposure_us = exposure_us
            pair = capture(patterns)
    except DeviceError as error:  # of the camera while it was set
        return error
    return pair


def check_levels(
    pair: Frames | DeviceError, aim_dn: float, exposure_limits_us: tuple[float, float]
) -> tuple[Check, Check, Check]:
    """Ambient light, light and saturation of a black and a white frame.

    Parameters
    ----------
    pair : Frames or DeviceError
        Of two frames, black and white, or why there are none.
    aim_dn : float
        What the bright part should have above black.
    exposure_limits_us : (float, float)
        The camera's.
    """
    ambient, least = LARGEST_AMBIENT * aim_dn, LEAST_LIGHT * aim_dn
    heads = (
        ("dark_level", "DN", f"≤ {ambient:.3g}"),
        ("light", "DN", f"≥ {least:.3g}"),
        ("saturation", "", f"≤ {LARGEST_SATURATED_SHARE:.3g}"),
    )
    if isinstance(pair, DeviceError):
        dark, light, clipped = (_failed(*head, pair) for head in heads)
        return dark, light, clipped
    at = f"{pair.exposure_us:g} us"
    black, white = pair.stack.astype(np.float32)
    dark_dn = bright_part(black) - pair.black_level_dn
    light_dn = bright_part(white - black)
    share = float((white >= pair.full_scale_dn).mean())
    if light_dn < _NO_LIGHT * aim_dn:
        no_light = (
            f"there is no light: white is {light_dn:.3g} DN brighter than black at {at}; take off the lens caps, "
            "switch the projector's light on, open the diaphragms and lay the white side of the board into the field"
        )
    else:
        no_light = (
            f"there is too little light: white is {light_dn:.3g} DN brighter than black at {at}; raise the light of "
            f"the projector, open the diaphragms, or allow exposures longer than {exposure_limits_us[1]:g} us in the "
            "rig file"
        )
    too_bright = (
        f"{share:.2%} of the pixels are saturated at {at}, of at least {exposure_limits_us[0]:g} us: dim the light of "
        "the projector, close the diaphragms, or turn away what glints"
    )
    ambient_light = (
        f"a black pattern leaves {dark_dn:.3g} DN above the camera's black at {at}: keep the light of the room off, "
        "and look whether black_level_dn in the rig file is what the camera has"
    )
    return (
        _judged(*heads[0], dark_dn, dark_dn <= ambient, ambient_light),
        _judged(*heads[1], light_dn, light_dn >= least, no_light),
        _judged(*heads[2], share, share <= LARGEST_SATURATED_SHARE, too_bright),
    )


def check_modulation(frames: Frames | DeviceError, light: np.ndarray | None, lit: bool) -> Check:
    """Modulation of four steps of the finest fringes, where there is light and they do not clip.

    Parameters
    ----------
    frames : Frames or DeviceError
    light : (rows, cols) float32 or None
        A white frame less a black one; without them the mean of the fringes says where there is light.
    lit : bool
        Whether there is enough of it to judge.
    """
    head = "modulation", "", f"≥ {LEAST_MODULATION:g}"
    if isinstance(frames, DeviceError):
        return _failed(*head, frames)
    if not lit:
        return _unjudged(*head, "light")
    modulation, mean = modulation_maps(frames.stack, frames.black_level_dn)
    counts = lit_pixels(mean if light is None else light) & ~saturated(frames)
    contrast = median_contrast(modulation, mean, counts)
    if contrast is None:
        return _unjudged(*head, "saturation")
    remedy = (
        f"the finest fringes have a modulation of {contrast:.3g} of their mean: bring the part into the focus of "
        "camera and projector, keep the light of the room off, and let the camera expose while one pattern stands"
    )
    return _judged(*head, contrast, contrast >= LEAST_MODULATION, remedy)


def check_order(frames: Frames | DeviceError, lit: bool, modulated: bool) -> Check:
    """Whether each frame of the long sequence shows its own pattern.

    If no frame shows any, ``lit`` and ``modulated`` say whether this is another check's fault.
    """
    head = "pattern_order", "frames", "≤ 0"
    if isinstance(frames, DeviceError):
        return _failed(*head, frames)
    shown = shown_patterns(frames.stack, frames.black_level_dn)
    if (shown < 0).all() and not (lit and modulated):
        return _unjudged(*head, "modulation" if lit else "light")
    wrong = np.flatnonzero(shown != np.arange(len(shown)))
    return _judged(*head, float(len(wrong)), not len(wrong), _order_remedy(shown, wrong))


def _order_remedy(shown: np.ndarray, wrong: np.ndarray) -> str:
    listed = [
        f"frame {k} shows " + (f"pattern {shown[k]}" if shown[k] >= 0 else "none of the patterns")
        for k in wrong[:_NAMED]
    ]
    if len(wrong) > _NAMED:
        listed.append(f"{len(wrong) - _NAMED} more are wrong")
    if any(k > 0 and shown[k] >= 0 and shown[k] == shown[k - 1] for k in wrong):
        remedy = (
            "a frame is older than its trigger: set the camera to its software trigger, or give it more time to settle"
        )
    else:
        remedy = (
            "patterns are out of order: let the camera expose only while its pattern stands, and look whether the "
            "projector takes the sequence in the order in which it was uploaded"
        )
    return f"{', '.join(listed)}; {remedy}"


def check_dropped(captured: Sequence[Frames], errors: Sequence[DeviceError]) -> Check:
    """Whether the camera's counter goes on without a gap through all captures, and time with it.

    A capture that failed has lost its frames: the first of ``errors`` says why.
    """
    head = "frames_dropped", "frames", "≤ 0"
    if errors:
        return _failed(*head, errors[0])
    dropped = dropped_frames([frames.serials for frames in captured], [frames.times_s for frames in captured])
    remedy = (
        f"{dropped} frames are missing in the camera's count, or no later than the one before: give the camera a bus "
        "or network of its own, a shorter cable and larger packets"
    )
    return _judged(*head, float(dropped), not dropped, remedy)


def _judged(check: str, unit: str, limit: str, figure: float, holds: bool, remedy: str) -> Check:
    return Check(check, figure, unit, limit, bool(holds), "" if holds else remedy)


def _unjudged(check: str, unit: str, limit: str, before: str) -> Check:
    return Check(check, None, unit, limit, None, f"cannot be judged before {before} holds")


def _failed(check: str, unit: str, limit: str, error: DeviceError) -> Check:
    return Check(check, None, unit, limit, False, str(error))
