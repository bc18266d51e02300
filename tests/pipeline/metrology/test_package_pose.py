"""Packages of analytic balls on a plane, laid anywhere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.package_pose import BallGridDrawing, find_package, rigid_motion, turn_by

DRAWING = BallGridDrawing.rectangular(4, 6, 0.8, 0.5, 0.4, 0.05)


def package(rng: np.random.Generator, missing: tuple[int, ...] = (), spacing: float = 0.03) -> np.ndarray:
    """Points (n, 3) of a package in its drawing's frame as seen from above, with 2 um of noise."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(-2.6, 2.6, spacing), np.arange(-1.9, 1.9, spacing)))
    z = np.zeros_like(x)
    for k, place in enumerate(DRAWING.places):
        aside = np.hypot(x - place[0], y - place[1])
        on_ball = (aside < 0.25) & (k not in missing)
        z[on_ball] = 0.15 + np.sqrt(0.0625 - aside[on_ball] ** 2)
    return np.column_stack([x, y, z]) + 2e-3 * rng.standard_normal((len(x), 3))


def test_places_are_numbered_from_the_top_left_row_by_row():
    np.testing.assert_allclose(DRAWING.places[[0, 5, 6, 23]], [[-2, 1.2], [2, 1.2], [-2, 0.4], [2, -1.2]])
    assert DRAWING.pitch == pytest.approx(0.8)


@settings(max_examples=12)
@given(
    turn_deg=st.floats(-40, 40), tilt=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    shift=st.tuples(*[st.floats(-20, 20)] * 3), lost=st.integers(0, 8), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_a_package_is_found_wherever_it_lies_with_balls_missing(turn_deg, tilt, shift, lost, seed):
    """The true pose puts every point back to within 0.01 mm, a third of the points' spacing."""
    rng = np.random.default_rng(seed)
    inner_and_some_outer = np.array([1, 3, 6, 7, 8, 9, 10, 13, 14, 15, 16, 17, 19, 21])
    drawn = package(rng, tuple(rng.choice(inner_and_some_outer, lost, replace=False).tolist()))
    lies = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_euler("z", turn_deg, degrees=True)
    pose = find_package(lies.apply(drawn) + shift, DRAWING)
    back = pose.in_drawing(lies.apply(drawn) + shift)
    assert pose.balls_matched == 24 - lost
    np.testing.assert_allclose(back, drawn, atol=0.01)
    rotation = pose.drawing_from_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_the_substrate_is_found_where_balls_are_seen_better_than_it():
    """Nine in ten points of the substrate lack."""
    rng = np.random.default_rng(2)
    points = package(rng)
    points = points[(points[:, 2] > 0.1) | (rng.uniform(size=len(points)) < 0.1)]
    assert np.mean(points[:, 2] < 0.1) < 0.3
    pose = find_package(points, DRAWING)
    np.testing.assert_allclose(pose.substrate.normal, [0, 0, 1], atol=2e-3)
    assert abs(pose.substrate.distances(np.zeros(3))) < 2e-3


def test_a_package_with_an_outer_row_out_of_sight_is_refused_and_not_taken_for_shifted():
    points = package(np.random.default_rng(3))
    with pytest.raises(InputError, match="more than one place"):
        find_package(points[points[:, 0] < 0.9], DRAWING)
    not_these = tuple(k for k in range(6, 12)) + tuple(range(13, 17))  # inner ones missing do not matter
    assert find_package(package(np.random.default_rng(3), not_these), DRAWING).balls_matched == 14


def test_a_rigid_motion_is_recovered():
    places = DRAWING.places
    turn, shift = rigid_motion(places, places @ turn_by(0.4).T + [1, 2])
    np.testing.assert_allclose(turn, turn_by(0.4), atol=1e-12)
    np.testing.assert_allclose(shift, [1, 2], atol=1e-12)


def test_what_is_no_package_is_told():
    rng = np.random.default_rng(4)
    flat = np.column_stack([rng.uniform(-2, 2, (2000, 2)), np.zeros(2000)])
    for points, told in (
        (flat, "0 of the drawing's 24 balls"),
        (flat[:50], "at least 100"),
        (np.linspace(0, 1, 500)[:, None] * np.ones(3), "line"),
        (rng.uniform(-50, 50, (3000, 3)), "substrate|not found"),
    ):
        with pytest.raises(InputError, match=told):
            find_package(points, DRAWING)
