"""Everything that one fringe sequence says about itself."""

from .finding import Finding, Yardstick
from .focus import check_focus_map
from .frame_shifts import check_frames
from .fringe_orders import check_orders
from .light import check_light, check_saturation
from .response import check_response
from .sequence import Sequence
from .swapped_frames import Order, find_order, order_finding, rearranged

_CHECKS = (check_saturation, check_light, check_response, check_frames, check_focus_map)
_PUTS_ORDERS_IN_DOUBT = {"vibration", "flicker", "response"}


def diagnose_sequence(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Findings of one capture, in no order."""
    return findings_of(sequence, find_order(sequence), yardstick)


def findings_of(sequence: Sequence, order: Order | None, yardstick: Yardstick) -> list[Finding]:
    """The same where the order of its frames was looked for already.

    Frames are put in order first, so that what a wrong order did is not found again under other names. Where a pattern
    is missing, nothing else is looked for. Orders in doubt are named only where nothing was found that puts them there.
    """
    findings = [] if order is None else [order_finding(sequence, order, yardstick)]
    sound = rearranged(sequence, order)
    if sound is None:
        return findings
    for check in _CHECKS:
        findings += check(sound, yardstick)
    if _PUTS_ORDERS_IN_DOUBT.isdisjoint(finding.name for finding in findings):
        findings += check_orders(sound, yardstick)
    return findings
