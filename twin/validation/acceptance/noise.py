"""Measurement noise on the material itself, over what the pipeline states of every point.

Twice: on the instrument without flicker and vibration, which move whole pictures and are in no point's stated noise,
where the ratio must be 1; and as the instrument is, where it is reported.
"""

from collections.abc import Callable, Iterator

from ..measured_noise import RATIO_TOLERANCE, SPECIMENS, Repeated, noise_ratio, phase_pair, treated
from ..setup import Setup
from .rows import Row, row

STEADY_SUFFIX, AS_IT_IS_SUFFIX = "", "_all_effects"
PAIRS = 2 * len(SPECIMENS)

NAMES = tuple(
    f"noise_{name}{suffix}{ending}"
    for ending in (STEADY_SUFFIX, AS_IT_IS_SUFFIX)
    for name in SPECIMENS
    for suffix in ("", "_filtered")
)


def noise_rows(setup: Setup, steady: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Measure plane, coin and solder twice each, on the steady instrument and on the one as it is."""
    for ending, instrument in ((STEADY_SUFFIX, steady), (AS_IT_IS_SUFFIX, setup)):
        for name in SPECIMENS:
            for repeated in treated(instrument, name, phase_pair(instrument, name)):
                yield row_of_pair(instrument, repeated, ending)
            advance(1)


def row_of_pair(setup: Setup, repeated: Repeated, ending: str) -> Row:
    """Noise of two maps of one place."""
    found = noise_ratio(repeated, repeated.inside)
    judged = ending == STEADY_SUFFIX
    limit = "; what must keep to the limit, a chosen tolerance without flicker and vibration, is the ratio less 1"
    return row(
        setup, f"noise_{repeated.specimen}{repeated.suffix}{ending}", 1e3 * found.measured, "um", found.n,
        "N_M: two maps subtracted, over √2; peer: stated of the same points" + (limit if judged else ""),
        limit=RATIO_TOLERANCE if judged else None, judged=found.ratio - 1, peer=1e3 * found.stated,
        u=1e3 * found.stated * found.sd, filter=setup.filter_name if repeated.suffix else "none",
    )  # fmt: skip
