"""Claims about specimens, on points and surfaces whose errors are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.pipeline.compare import Comparison, ErrorRow
from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation.specimens import RAW, Measured, ball_claims, specimen_claims

RADIUS = 0.25


def measured(xyz: np.ndarray, comparison: Comparison | None = None, seen: np.ndarray | None = None) -> Measured:
    truth = SimpleNamespace(lit_and_seen=np.ones(xyz.shape[:2], bool) if seen is None else seen)
    nothing = np.zeros(xyz.shape[:2])
    return Measured("bga", RAW, nothing, PointMap(xyz), truth, nothing > 0, comparison)


def test_apex_errors_are_those_of_the_balls(analytic):
    """Four balls measured too high by 1, 2, 3 and 4 um, on a package that lies shifted and lower."""
    apexes = np.array([[-0.4, 0.4, 0.3], [0.4, 0.4, 0.3], [-0.4, -0.4, 0.3], [0.4, -0.4, 0.31]])
    shift = np.array([0.05, -0.03, -0.2])
    motion = np.eye(4)
    motion[:3, 3] = shift
    too_high = np.array([1e-3, 2e-3, 3e-3, 4e-3])
    x, y = np.meshgrid(np.arange(-0.8, 0.8, 0.0099), np.arange(-0.8, 0.8, 0.0099))
    z = np.full(x.shape, np.nan)
    for apex, high in zip(apexes + shift, too_high, strict=True):
        r = np.hypot(x - apex[0], y - apex[1])
        ball = r < 0.8 * RADIUS
        z[ball] = apex[2] + high - RADIUS + np.sqrt(RADIUS**2 - r[ball] ** 2)
    built = {"ball_apexes_mm": apexes, "ball_radii_mm": np.full(4, RADIUS)}
    setup = analytic(motion, specimen=SimpleNamespace(as_built=built))
    rows = {row.claim: row for row in ball_claims(setup, measured(np.stack([x, y, z], axis=-1)))}
    # Over 15 degrees a sphere departs from its paraboloid by r sin(15)^4 / 8 = 0.14 um at the rim.
    assert rows["ball_apex_bias"].measured == pytest.approx(2.5, abs=0.1)
    assert rows["ball_apex_sd"].measured == pytest.approx(np.std([1, 2, 3, 4], ddof=1), abs=0.02)
    assert rows["ball_apex_within_tolerance"].measured == pytest.approx(4.0, abs=0.1)
    assert rows["ball_apex_within_tolerance"].holds
    assert {row.n for row in rows.values()} == {4}


def test_specimen_rows_are_the_comparisons_vertical_ones_on_smooth_surface(analytic):
    kinds = [(quantity, points) for points in ("all", "smooth") for quantity in ("signed_distance", "vertical")]
    table = [ErrorRow(*kind, 10 * k, 1.0 + k, 2.0 + k, 3.0 + k, 4.0 + k) for k, kind in enumerate(kinds)]
    comparison = Comparison("none", np.eye(4), table, 5, 0.75)
    rows = {row.claim: row for row in specimen_claims(analytic(), measured(np.zeros((4, 6, 3)), comparison))}
    assert [rows[name].measured for name in ("bias", "rmse", "p95", "valid_share")] == [4.0, 5.0, 6.0, 0.75]
    assert [rows[name].n for name in ("bias", "rmse", "p95", "valid_share")] == [30, 30, 30, 24]
    assert {(row.specimen, row.filter, row.alignment, row.holds) for row in rows.values()} == {
        ("bga", "none", "none", None)
    }
