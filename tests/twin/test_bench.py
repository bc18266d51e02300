"""Claims about the truth, against geometry that is computed here by other means."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from greenough.instrument.contract import Placement, SpotBoard
from greenough.twin import Truth
from greenough.twin.rig import fringe_patterns
from notebook_page import Page

DISTANCE, HALF_ANGLE = 224.56, np.radians(6.0)
SINE, COSINE = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
CAMERA = DISTANCE * np.array([-SINE, 0.0, COSINE])
PROJECTOR = DISTANCE * np.array([SINE, 0.0, COSINE])
MIRROR_ROWS, MIRROR_COLS, COLUMN_PITCH, ROW_PITCH = 684, 608, 17.835e-3, 8.923e-3


def seen_on_plane(shape: tuple[int, int], focal_px: float, height: float) -> np.ndarray:
    """Where a pinhole camera's pixels meet the plane z = height, (rows, cols, 3)."""
    rows, cols = shape
    u, v = np.meshgrid(np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    forward, right, up = -CAMERA / DISTANCE, np.array([COSINE, 0, SINE]), np.array([0.0, 1.0, 0.0])
    direction = forward * focal_px + right * u[..., None] - up * v[..., None]
    return CAMERA + direction * ((height - CAMERA[2]) / direction[..., 2:])


def mirror_of(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of points (..., 3) through a pinhole projector."""
    q = xyz - PROJECTOR
    depth = -(q @ PROJECTOR) / DISTANCE
    right = q @ np.array([COSINE, 0, -SINE])
    # The array of staggered rows is half a column wider than its columns.
    column = (MIRROR_COLS - 0.5) / 2 - 0.25 + 0.25 + right * DISTANCE / depth / COLUMN_PITCH
    row = (MIRROR_ROWS - 1) / 2 - q[..., 1] * DISTANCE / depth / ROW_PITCH
    return column, row


@pytest.mark.parametrize("height", [-1.45, 0.0, 0.83])
def test_points_and_mirrors_of_a_plane_are_those_of_pinhole_geometry(small, height):
    rig, bench = small(perfect=True)
    rig.operator.place(Placement("plane"))
    rig.stage.move_to_mm(height)
    truth = bench.truth()
    expected = seen_on_plane((60, 80), 1417.6875, height)
    hit = np.isfinite(truth.xyz[..., 0])
    assert hit[15:45, 15:65].all()
    # Float32 at 224 mm: the ray's direction is right to 1e-7 of that, the point's height exactly.
    assert_allclose(truth.xyz[hit], expected[hit], atol=5e-5)
    assert_allclose(truth.xyz[hit][:, 2], height, atol=1e-6)
    assert_allclose(truth.normal[hit], np.tile([0.0, 0, 1], (hit.sum(), 1)), atol=1e-6)
    column, row = mirror_of(truth.xyz)
    assert_allclose(truth.column[hit], column[hit], atol=5e-3)
    assert_allclose(truth.row[hit], row[hit], atol=1e-2)
    inside = (column >= 0) & (column <= MIRROR_COLS - 0.5) & (row >= 0) & (row <= MIRROR_ROWS - 1)
    border = (np.abs(column) < 0.02) | (np.abs(column - MIRROR_COLS + 0.5) < 0.02)
    border |= (np.abs(row) < 0.02) | (np.abs(row - MIRROR_ROWS + 1) < 0.02)
    assert (truth.lit_and_seen == (hit & inside))[~border].all()
    assert truth.lit_and_seen.any()
    assert not truth.lit_and_seen.all()


def test_x_is_to_the_right_and_y_up_in_the_picture_and_columns_grow_to_the_right(small):
    rig, bench = small()
    rig.operator.place(Placement("plane"))
    truth = bench.truth()
    middle = truth.xyz[20:40, 20:60]
    assert (np.diff(middle[..., 0], axis=1) > 0).all()
    assert (np.diff(middle[..., 1], axis=0) < 0).all()
    assert (np.diff(truth.column[20:40, 20:60], axis=1) > 0).all()
    assert (np.diff(truth.row[20:40, 20:60], axis=0) > 0).all()


def test_the_rendered_fringes_carry_the_true_column(small):
    focused = ("camera.rows=40", "camera.cols=60", "twin.optics.camera_focal_px=22683")
    rig, bench = small(*focused, perfect=True, pinholes=True)
    rig.operator.place(Placement("plane"))
    for height in (-1.2, 0.4):
        rig.stage.move_to_mm(height)
        lines = rig.irradiance(fringe_patterns(rig)[-12:]).astype(float)
        n = np.arange(12)[:, None, None]
        phase = np.arctan2(
            -(lines * np.sin(2 * np.pi * n / 12)).sum(axis=0), (lines * np.cos(2 * np.pi * n / 12)).sum(axis=0)
        )
        truth = bench.truth()
        # A column's mirrors stand a quarter of a column further on, on the mean over even and odd rows.
        expected = 2 * np.pi * (truth.column - 0.25) / 12
        difference = np.angle(np.exp(1j * (phase - expected)))
        # Whole grey values and linear interpolation between four cells a column are each wrong by up to some 1e-4 rad;
        # half a column would be 0.26 rad.
        assert np.abs(difference).max() < 2e-3
        assert np.abs(difference.mean()) < 5e-4


def step_file(folder: Path, top: float, floor: float) -> Path:
    """A block of 1.2 x 8 mm on a floor, both as one mesh."""
    block = trimesh.creation.box(bounds=[[-0.6, -4, floor], [0.6, 4, top]])
    ground = trimesh.Trimesh(
        [[-6, -4.5, floor], [6, -4.5, floor], [6, 4.5, floor], [-6, 4.5, floor]], [[0, 1, 2], [0, 2, 3]]
    )
    path = folder / "step.ply"
    trimesh.util.concatenate([block, ground]).export(path)
    return path


def test_a_step_casts_the_shadow_of_its_edge(small, tmp_path):
    top, floor = 0.8, -0.6
    zoomed = ("camera.rows=50", "camera.cols=160", "twin.optics.camera_focal_px=11341")
    rig, bench = small(*zoomed, perfect=True)
    rig.operator.place(Placement(str(step_file(tmp_path, top, floor))))
    truth = bench.truth()
    x, z = truth.xyz[..., 0], truth.xyz[..., 2]
    on_floor, on_top = np.abs(z - floor) < 1e-4, np.abs(z - top) < 1e-4
    # The ray from the projector past the edge at x = -0.6 meets the floor further left.
    edge = np.array([-0.6, top])
    shadow = edge[0] - (edge[1] - floor) * (PROJECTOR[0] - edge[0]) / (PROJECTOR[2] - edge[1])
    assert 0.1 < edge[0] - shadow < 0.2
    dark = on_floor & (x > shadow + 1e-3) & (x < -0.6 - 1e-3)
    assert dark.sum() > 100
    assert not truth.lit_and_seen[dark].any()
    lit = (on_floor & (x < shadow - 1e-3)) | on_top
    assert lit.sum() > 1000
    assert truth.lit_and_seen[lit].all()
    # The camera looks from the left: it sees the wall on its side, which the projector does not reach.
    wall = np.abs(truth.normal[..., 0] + 1) < 1e-6
    assert wall.any()
    assert not truth.lit_and_seen[wall].any()
    assert_allclose(x[wall], -0.6, atol=1e-5)


def test_what_is_dark_by_truth_is_dark_in_the_picture(small, tmp_path):
    zoomed = ("camera.rows=50", "camera.cols=160", "twin.optics.camera_focal_px=11341", "twin.render.bounces=1")
    rig, bench = small(*zoomed, perfect=True, pinholes=True)
    rig.operator.place(Placement(str(step_file(tmp_path, 0.8, -0.6))))
    white = np.full((1, *rig.projector.shape), 255, np.uint8)
    picture, lit = rig.irradiance(white)[0], bench.truth().lit_and_seen
    # A pixel whose neighbours agree with it does not lie on a boundary.
    same = np.ones_like(lit)
    for axis in (0, 1):
        for step in (-1, 1):
            same &= np.roll(lit, step, axis) == lit
    same[[0, -1]] = same[:, [0, -1]] = False
    assert (picture[same & lit] > 0.1).all()
    assert (picture[same & ~lit] < 1e-6).all()
    assert (same & ~lit).sum() > 50


def test_beside_the_part_there_is_nothing(small, tmp_path):
    trimesh.creation.box((4.0, 3.0, 0.2)).export(tmp_path / "block.ply")
    rig, bench = small(perfect=True)
    rig.operator.place(Placement(str(tmp_path / "block.ply")))
    truth = bench.truth()
    beside = np.isnan(truth.xyz[..., 0])
    assert beside[0].all()
    for values in (truth.xyz, truth.normal, truth.column[..., None], truth.row[..., None]):
        assert np.isnan(values[beside]).all()
        assert np.isfinite(values[~beside]).all()
    assert not truth.lit_and_seen[beside].any()


def on_spots(truth: Truth, board: SpotBoard) -> np.ndarray:
    """Pixels well inside a spot, by where their points lie in the world."""
    offset = truth.xyz_world[:, :, None, :2] - board.centres()
    return (np.linalg.norm(offset, axis=-1) < board.diameters() / 2 - 0.02).any(axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_world_has_the_spots_of_the_flat_board_at_height_zero(small, seed):
    zoomed = ("camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75")
    rig, bench = small(f"twin.seed={seed}", "twin.board.bow_sd_um=0", *zoomed)
    rig.operator.place(Placement("board"))
    truth = bench.truth()
    spots = on_spots(truth, rig.board)
    assert spots.sum() > 1000
    height = truth.xyz_world[..., 2]
    assert_allclose(height[spots], 0, atol=1e-5)  # float32 leaves less than that of heights up to 4 mm away
    neither = ~spots & np.isfinite(height)
    assert np.median(height[neither]) == pytest.approx(1e-3, abs=1e-5)  # the ink
    assert not np.allclose(truth.world_from_twin, np.eye(4), atol=1e-4)  # there was something to undo


def test_a_perfect_board_lying_flat_is_only_turned_and_shifted_by_hand(small):
    _, bench = small(perfect=True)
    motion = np.linalg.inv(bench.world_from_twin)
    assert_allclose(motion[2], [0, 0, 1, 0], atol=1e-12)
    assert 0 < np.hypot(*motion[:2, 3]) < 1


def test_the_printed_centres_are_where_the_drawing_says_within_print_errors(small):
    rig, bench = small()
    rig.operator.place(Placement("board"))
    assert_allclose(bench.world_from_part, np.eye(4), atol=1e-12)
    spots = bench.parts_in_world()[0]
    assert spots.material == "ceramic"
    centres = bench.specimen.as_built["centres_mm"]
    # The origin and the x axis are best-fitted: neither a shift nor a rotation is left.
    error = centres[:, :2] - rig.board.centres()
    assert 1e-4 < error.std() < 2e-3
    assert_allclose(error.mean(axis=0), 0, atol=1e-12)
    drawn = rig.board.centres()
    assert abs(np.sum(drawn[:, 0] * error[:, 1] - drawn[:, 1] * error[:, 0])) < 1e-9


def test_the_blank_face_is_parallel_to_the_printed_one_up_to_the_wedge(small):
    for wedge, limit in ((0, 2e-7), (400, 400e-6 * 2 * 5)):
        rig, bench = small(f"twin.board.wedge_sd_urad={wedge}", "twin.board.bow_sd_um=0", "twin.stage.position_sd_um=0")
        rig.operator.place(Placement("board", face="blank"))
        truth = bench.truth()
        normal = truth.normal_world[truth.lit_and_seen]
        tilt = np.hypot(normal[:, 0], normal[:, 1])
        assert tilt.max() < limit + 3e-7
        if wedge:
            assert tilt.max() > 1e-5
        # The ink lifts it by its thickness.
        middle = truth.xyz_world[30, 40, 2]
        assert middle == pytest.approx(1e-3, abs=1e-4 + limit)


@pytest.mark.parametrize("reading", [-1.4, 0.0, 0.3])
def test_the_blank_face_is_as_high_as_its_rays_find_it(small, reading):
    rig, bench = small()
    rig.operator.place(Placement("board", face="blank"))
    rig.stage.move_to_mm(reading)
    truth = bench.truth()
    met = truth.xyz_world[truth.lit_and_seen]
    assert len(met) > 500
    # Bow and wedge in facets of 0.65 mm: their sagitta is a hundredth of a micrometre, and so is float32's rounding.
    assert_allclose(bench.blank_face_height(reading, met[:, :2]), met[:, 2], atol=4e-5)
    assert np.ptp(met[:, 2]) > 1e-3  # there is something to find


def test_a_tilted_posture_is_seen_tilted(small):
    rig, bench = small("twin.board.bow_sd_um=0")
    for posture in range(3):
        rig.operator.place(Placement("board", posture=posture))
        truth = bench.truth()
        normal = bench.world_from_part[:3, 2]
        assert 5 < np.degrees(np.arccos(normal[2])) < 21
        seen = truth.normal_world[truth.lit_and_seen & (truth.normal_world[..., 2] > 0.9)]
        # Float32 vertices tilt triangles of some micrometres by some 1e-4; walls of the ink, 1 um high, are hardly met.
        assert np.mean(np.abs(seen - normal).max(axis=-1) < 1e-3) > 0.99
        heights = (bench.world_from_part[:3, :3] @ bench.specimen.as_built["centres_mm"].T).T[:, 2]
        assert np.abs(heights).max() < 1.4 + 0.01


def test_a_sample_lies_as_it_is_posed(small):
    """Held at 12 degrees about x and lifted by 0.2 mm, on a table that a hand has turned by a degree or so."""
    rig, bench = small(perfect=True)
    rig.operator.place(Placement("plane"))
    turn = bench.world_from_part[:3, :3]
    rig.operator.place(Placement("plane", pose_mm_deg=(0, 0, 0.2, 12, 0, 0)))
    normal, origin = bench.world_from_part[:3, 2], bench.world_from_part[:3, 3]
    assert_allclose(turn.T @ normal, [0, -np.sin(np.radians(12)), np.cos(np.radians(12))], atol=1e-12)
    assert origin[2] == pytest.approx(0.2, abs=1e-12)
    truth = bench.truth()
    on_plane = (truth.xyz_world[truth.lit_and_seen] - origin) @ normal
    assert truth.lit_and_seen.mean() > 0.4
    assert_allclose(on_plane, 0, atol=1e-4)  # float32


@pytest.mark.slow
def test_postures_come_from_the_seed(small):
    def poses(seed: int) -> np.ndarray:
        rig, bench = small(f"twin.seed={seed}")
        motions = []
        for placement in (Placement("board", posture=0), Placement("board", posture=7), Placement("coin")):
            rig.operator.place(placement)
            motions.append(bench.world_from_part)
        return np.stack(motions)

    first = poses(5)
    np.testing.assert_array_equal(first, poses(5))
    for mine, other in zip(first, poses(6), strict=True):
        assert not np.allclose(mine, other, atol=1e-5)


def test_the_stages_errors_move_the_part_and_not_its_reading(small):
    rig, bench = small("twin.stage.position_sd_um=50", perfect=False)
    rig.operator.place(Placement("plane"))
    errors = []
    for z in np.linspace(-1.4, 1.4, 15):
        rig.stage.move_to_mm(z)
        assert rig.stage.position_mm == z
        errors.append(bench.truth().xyz[30, 40, 2] - z)
    # 15 independent normal errors of 50 um, to which the axis (0.2 deg at the middle) adds little.
    assert 0.015 < np.std(errors) < 0.1


@pytest.mark.slow
def test_the_meshes_in_the_world_are_what_the_rays_meet(small):
    rig, bench = small("twin.stage.position_sd_um=20")
    rig.operator.place(Placement("diaphragm-raised"))
    rig.stage.move_to_mm(0.2)
    truth = bench.truth()
    xyz = truth.xyz_world[truth.lit_and_seen][::7]
    parts = bench.parts_in_world()
    vertices = np.concatenate([part.vertices for part in parts])
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    _, distance, _ = trimesh.Trimesh(vertices, faces, process=False).nearest.on_surface(xyz[:40])
    assert np.max(distance) < 1e-5


@pytest.mark.slow
def test_the_truth_shows_itself_in_a_notebook(small):
    rig, bench = small(perfect=True)
    rig.operator.place(Placement("coin"))
    truth = bench.truth()
    page = Page(truth._repr_html_())
    assert len(page.pictures) == 1
    count = truth.lit_and_seen.sum()
    assert page.facts["pixels lit and seen"] == f"{count:,} of 4,800 ({count / 4800:.1%})"
