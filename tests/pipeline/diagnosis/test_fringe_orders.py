"""Claims about fringe orders: sets that do not belong together are noticed."""

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.fringe_orders import check_orders
from greenough.pipeline.fringes import FringeSet

SCALE = Yardstick(163.0, 0.5)


def test_sets_that_agree_are_no_finding(taken):
    assert [check_orders(taken(seed=seed), SCALE) for seed in range(5)] == [[]] * 5


def test_a_period_that_was_not_projected_is_noticed(taken, paint):
    projected = FringeSet((608, 152, 40, 13.5), (4, 4, 4, 12))
    (finding,) = check_orders(taken(paint(projected)), SCALE)
    assert finding.name == "fringe orders"
    assert finding.evidence["doubtful_share"] > 0.2


def test_orders_that_a_gray_code_must_tell_are_not_judged(taken):
    assert check_orders(taken(fringes=FringeSet((12,), (12,), field=600)), SCALE) == []
