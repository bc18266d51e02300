"""Whether the sets of fringes agree on which fringe is which."""

import numpy as np

from .finding import Finding, Yardstick
from .sequence import Sequence

LEAST_SHARE = 0.01
"""Of the pixels with sound fringes: rims and steps, where a pixel sees two heights, have some."""


def check_orders(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Pixels whose modulation would let a wrong order pass once in a million, and whose sets disagree all the same."""
    if not sequence.tells_orders:
        return []
    sound = sequence.orders_safe & sequence.fringed & ~sequence.saturated
    if not sound.any():
        return []
    doubtful = sound & ~sequence.decoded.valid
    share = float(doubtful.sum() / sound.sum())
    if share < LEAST_SHARE:
        return []
    residual = np.abs(sequence.decoded.residual[sound])
    effect = float(2 * np.pi * np.sqrt(share))
    return [
        Finding(
            name="fringe orders",
            where=sequence.where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="the sets disagree on the fringes' order by more than noise: periods or steps are not those of the "
            "patterns, or sets belong to different scenes",
            remedy="check --periods, --steps, --sign and the order of the sets; keep everything at rest meanwhile",
            evidence={"doubtful_share": share, "residual_rad": float(np.median(residual))},
        )
    ]
