"""Claims about the step gauge."""

import numpy as np
import pytest
import trimesh

from greenough.scenes.step_gauge import GROOVES_MM, PLATEAU_MM, RIDGES_MM, WIDTH_MM, step_gauge

LEAN = np.tan(np.radians(7.0))  # of a light path: half of the convergence, the field's and the assembly's error


@pytest.fixture(scope="module")
def gauge():
    return step_gauge(seed=3)


@pytest.fixture(scope="module")
def mesh(gauge):
    (part,) = gauge.parts
    return trimesh.Trimesh(part.vertices, part.faces, process=True)


def height(mesh: trimesh.Trimesh, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of what a ray from above meets at (x, y), one for each."""
    origins = np.column_stack([x, y, np.full(len(x), 5.0)])
    points, rays, _ = mesh.ray.intersects_location(origins, np.tile([0.0, 0.0, -1.0], (len(x), 1)), False)
    found = np.full(len(x), -np.inf)
    np.maximum.at(found, rays, points[:, 2])
    return found


def test_steps_have_their_certified_heights_over_their_whole_floors_and_plateaus_beside_them_are_zero(gauge, mesh):
    rng = np.random.default_rng(0)
    for step, ((left, right), (low, high)) in zip(
        gauge.as_built["step_heights_mm"], gauge.as_built["step_boxes_mm"], strict=True
    ):
        y = rng.uniform(low, high, 50)
        np.testing.assert_allclose(height(mesh, rng.uniform(left, right, 50), y), step, atol=1e-9)
        for beside in (left - PLATEAU_MM, right):
            np.testing.assert_allclose(height(mesh, beside + rng.uniform(0, PLATEAU_MM, 50), y), 0, atol=1e-9)


def test_heights_are_not_quite_the_nominal_ones():
    off = np.array([step_gauge(seed).as_built["step_heights_mm"] for seed in range(30)]) - [*RIDGES_MM, *GROOVES_MM]
    assert 0.8e-3 < off.std() < 1.2e-3
    assert step_gauge(0).nominal["step_2_mm"] == RIDGES_MM[2]


def test_at_least_five_steps_go_over_most_of_the_range_and_no_two_are_equal(gauge):
    heights = gauge.as_built["step_heights_mm"]
    assert len(heights) >= 5
    assert np.ptp(heights) > 0.75 * 3.0
    assert np.diff(np.sort(heights)).min() > 0.1


def test_shadows_of_walls_stay_out_of_the_windows(gauge):
    shadow = np.abs(gauge.as_built["step_heights_mm"]).max() * LEAN
    assert shadow < WIDTH_MM / 3  # from there on the plateau counts, and so far the bottom does not
    assert PLATEAU_MM - shadow > WIDTH_MM  # as far as the plateau counts


def test_the_surface_has_no_gaps(mesh):
    """Walls close what the floors leave open: seen from above and aslant, every ray meets the gauge."""
    assert mesh.body_count == 1
    edges = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    open_ends = mesh.vertices[np.unique(mesh.edges_sorted[edges])]
    outline = np.abs(mesh.vertices[:, :2]).max(axis=0)
    on_outline = np.isclose(np.abs(open_ends[:, :2]), outline).any(axis=1)
    assert on_outline.all()
