"""How the operator's hands lay parts on the table: drawn from the instrument's seed, and never told to the pipeline."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError

from .randomness import instrument_rng
from .stage import rigid

TILT_DEG = (8.0, 20.0)
DEPTH_MM = 1.4  # no spot of a tilted board leaves this range of heights: the depth of field
SHIFT_MM = (1.0, 0.6)
REACH_MM = (6.5, 5.0, 1.6)  # of the measuring volume from its middle
GOLDEN = np.pi * (3 - np.sqrt(5))


def tilted(seed: int, posture: int, reach: np.ndarray) -> np.ndarray:
    """``table_from_board`` (4, 4) of the board held tilted for the ``posture``-th time.

    The direction of the slope goes round by the golden angle, so that any number of postures covers all of them; tilt,
    quarter turn, turn and shift are random. ``reach`` (n, 2) are the board's spots, which stay within the depth of
    field.
    """
    rng = instrument_rng(seed, f"posture {posture}")
    slope = instrument_rng(seed, "first slope").uniform(0, 2 * np.pi) + GOLDEN * posture
    tilt = np.radians(rng.uniform(*TILT_DEG))
    turn = np.radians(90.0 * rng.integers(4) + rng.uniform(-12, 12))
    spin = Rotation.from_rotvec([0, 0, turn])
    spots = spin.apply(np.column_stack([reach, np.zeros(len(reach))]))
    extent = np.abs(spots[:, :2] @ [np.cos(slope), np.sin(slope)]).max()
    tilt = min(tilt, np.arcsin(min(1.0, DEPTH_MM / extent)))
    lean = Rotation.from_rotvec(tilt * np.array([-np.sin(slope), np.cos(slope), 0]))
    shift = [rng.uniform(-1, 1) * SHIFT_MM[0], rng.uniform(-1, 1) * SHIFT_MM[1], 0.0]
    return rigid(lean * spin, shift)


def flat(seed: int, what: str) -> np.ndarray:
    """``table_from_part`` (4, 4) of a part that lies flat: a hand's error of 0.1 mm and 1 degree."""
    rng = instrument_rng(seed, f"flat {what}")
    turn = Rotation.from_rotvec([0, 0, np.radians(rng.normal())])
    return rigid(turn, [*rng.normal(0, 0.1, 2), 0.0])


def posed(pose_mm_deg: Sequence[float]) -> np.ndarray:
    """Motion (4, 4) of a part that is put as `greenough.instrument.contract.Placement` says.

    Raises InputError for a pose that is not six finite numbers, or shifts the part out of the measuring volume.
    """
    if len(pose_mm_deg) != 6 or not np.isfinite(pose_mm_deg).all():
        raise InputError(f"the pose {tuple(pose_mm_deg)} must be six finite numbers: x, y, z in mm and three degrees")
    if (np.abs(pose_mm_deg[:3]) > REACH_MM).any():
        reach = " x ".join(f"{r:g}" for r in REACH_MM)
        raise InputError(
            f"the pose {tuple(pose_mm_deg)} shifts the part out of the measuring volume; stay within ±({reach}) mm"
        )
    return rigid(Rotation.from_euler("xyz", pose_mm_deg[3:], degrees=True), list(pose_mm_deg[:3]))


def on_wedge(gradient: np.ndarray) -> np.ndarray:
    """Motion (4, 4) that lays a board, whose thickness has this ``gradient`` (2,), on its blank face."""
    return rigid(Rotation.from_rotvec([gradient[1], -gradient[0], 0.0]), [0, 0, 0])


def lifted(height: float) -> np.ndarray:
    """Motion (4, 4) upwards by ``height`` mm."""
    return rigid(Rotation.identity(), [0, 0, height])
