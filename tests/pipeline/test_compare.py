import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.pipeline.compare import Surface, compare, signed_distances, vertical_errors
from greenough.pipeline.point_cloud import Mesh, PointCloud


def height_field(height, size=(10.0, 6.0), n=161):
    """Mesh of z = height(x, y), faces counter-clockwise seen from above."""
    x, y = np.meshgrid(np.linspace(-size[0] / 2, size[0] / 2, n), np.linspace(-size[1] / 2, size[1] / 2, n))
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    return Mesh(vertices, faces.astype(np.int32))


def cube(half=1.0):
    vertices = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    return Mesh(vertices, np.array(faces, dtype=np.int32))


def bumps(x, y):
    return 0.3 * np.sin(1.3 * x) * np.cos(1.7 * y + 0.4) + 0.02 * x


def points_on(height, n=5000, seed=2):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4.5, 4.5, n), rng.uniform(-2.5, 2.5, n)
    return np.stack([x, y, height(x, y)], axis=-1)


def test_a_lifted_plane_reads_its_lift_and_a_tilted_one_its_cosine():
    slope = 0.2
    mesh = height_field(lambda x, y: slope * x)
    cloud = PointCloud(points_on(lambda x, y: slope * x + 0.004))
    result = compare(cloud, mesh)
    vertical, distance = result.row("vertical"), result.row("signed_distance")
    assert (vertical.n, distance.n) == (5000, 5000)
    assert vertical.bias_um == pytest.approx(4.0, abs=1e-6)
    assert vertical.rmse_um == pytest.approx(4.0, abs=1e-6)
    assert distance.bias_um == pytest.approx(4.0 / np.sqrt(1 + slope**2), abs=1e-6)


def test_statistics_are_those_of_the_errors():
    # |error| of 1 ... 100 µm, alternating in sign: known bias, RMS, 95 % quantile and maximum.
    sizes = np.arange(1, 101)
    errors = sizes * np.where(sizes % 2, 1, -1)
    xyz = points_on(lambda x, y: 0 * x, n=100)
    xyz[:, 2] = errors * 1e-3
    row = compare(PointCloud(xyz), height_field(lambda x, y: 0 * x)).row("vertical")
    assert row.bias_um == pytest.approx(-0.5)
    assert row.rmse_um == pytest.approx(np.sqrt(101 * 201 / 6))
    assert 95 <= row.p95_um <= 96
    assert row.max_um == pytest.approx(100)


def test_the_distance_is_positive_outside_and_exact_at_faces_edges_and_corners():
    points = np.array([[0, 0, 1.5], [0, 0, 0.75], [2.0, 0, 2.0], [2.0, 2.0, 2.0], [-1.5, 0.3, 0.2]])
    expected = [0.5, -0.25, np.sqrt(2), np.sqrt(3), 0.5]
    np.testing.assert_allclose(signed_distances(points, Surface.of(cube())), expected, atol=1e-12)


@pytest.mark.parametrize("shape", ["cone", "star"])
def test_the_sign_agrees_with_the_winding_number_at_sharp_edges(shape):
    # A needle and a star have edges and corners where the normal of a single closest face gives the wrong sign.
    if shape == "cone":
        solid = trimesh.creation.cone(radius=0.15, height=2.0, sections=7)
    else:
        solid = trimesh.creation.icosphere(subdivisions=1)
        solid.vertices *= np.where(np.arange(len(solid.vertices)) % 3, 1.0, 2.5)[:, None]
    vertices, faces = np.asarray(solid.vertices, dtype=float), np.asarray(solid.faces, dtype=np.int64)
    rng = np.random.default_rng(12)
    xyz = rng.uniform(vertices.min(axis=0) - 0.5, vertices.max(axis=0) + 0.5, (20_000, 3))
    inside = igl.winding_number(vertices, faces, xyz) > 0.5
    signed = signed_distances(xyz, Surface.of(Mesh(vertices, faces.astype(np.int32))))
    np.testing.assert_array_equal(signed < 0, inside)


def test_the_sign_survives_a_mesh_whose_triangles_share_no_vertices():
    mesh = cube()
    loose = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(12, 3))
    rng = np.random.default_rng(7)
    xyz = rng.uniform(-2, 2, (4000, 3))
    box = np.abs(xyz) - 1
    expected = np.linalg.norm(np.maximum(box, 0), axis=1) + np.minimum(box.max(axis=1), 0)
    row = compare(PointCloud(xyz), loose).row("signed_distance")
    assert row.bias_um == pytest.approx(1e3 * expected.mean(), rel=1e-9)


def test_the_vertical_error_is_to_the_uppermost_surface():
    errors = vertical_errors(np.array([[0.3, 0.2, 0.0], [0.3, 0.2, 1.25], [1.7, 0.0, 0.0]]), Surface.of(cube()))
    np.testing.assert_allclose(errors[:2], [-1.0, 0.25], atol=1e-12)
    assert np.isnan(errors[2])


def test_points_beside_the_mesh_have_no_vertical_error_and_are_not_counted():
    xyz = points_on(bumps, n=1000)
    xyz[:10, 0] += 100
    result = compare(PointCloud(xyz), height_field(bumps))
    assert result.row("vertical").n == 990
    assert result.row("signed_distance").n == 1000


def test_heights_are_evaluated_in_double_precision():
    # Facets of 0.06 mm under single-precision rays: the planes they lie in must not lose digits.
    mesh = height_field(lambda x, y: 0.3 * x - 0.1 * y + 1.0)
    xyz = points_on(lambda x, y: 0.3 * x - 0.1 * y + 1.0)
    assert np.abs(vertical_errors(xyz, Surface.of(mesh))).max() < 1e-12


@pytest.mark.parametrize("align", ["rigid", "similarity"])
def test_an_alignment_finds_the_motion_that_was_applied(align):
    rng = np.random.default_rng(4)
    mesh = height_field(bumps, n=401)
    on_mesh = mesh.vertices[rng.choice(len(mesh.vertices), 20_000)]
    on_mesh = on_mesh[(np.abs(on_mesh[:, 0]) < 4.5) & (np.abs(on_mesh[:, 1]) < 2.6)]
    rotation = Rotation.from_rotvec([0.002, -0.003, 0.004]).as_matrix()
    factor = 1.001 if align == "similarity" else 1.0
    moved = factor * on_mesh @ rotation.T + [0.01, -0.02, 0.015]
    result = compare(PointCloud(moved), mesh, align)
    assert result.alignment == align
    assert result.row("signed_distance").rmse_um < 0.01
    back = moved @ result.transform[:3, :3].T + result.transform[:3, 3]
    assert np.abs(back - on_mesh).max() < 1e-4


def test_no_alignment_is_applied_unless_asked():
    result = compare(PointCloud(points_on(lambda x, y: bumps(x, y) + 0.01)), height_field(bumps, n=401))
    assert result.alignment == "none"
    np.testing.assert_array_equal(result.transform, np.eye(4))
    assert result.row("vertical").bias_um == pytest.approx(10, abs=0.2)


@pytest.mark.slow
def test_a_rigid_alignment_leaves_scale_in_and_similarity_takes_it_out():
    mesh = height_field(bumps, n=401)
    xyz = points_on(bumps) * 1.002
    assert compare(PointCloud(xyz), mesh, "rigid").row("signed_distance").rmse_um > 1.0
    assert compare(PointCloud(xyz), mesh, "similarity").row("signed_distance").rmse_um < 0.2


def test_what_the_surface_does_not_resist_stays_at_zero():
    xyz = points_on(lambda x, y: 0 * x + 0.02)
    transform = compare(PointCloud(xyz), height_field(lambda x, y: 0 * x), "similarity").transform
    expected = np.eye(4)
    expected[2, 3] = -0.02
    np.testing.assert_allclose(transform, expected, atol=1e-9)


def test_smooth_points_have_rows_of_their_own():
    xyz = points_on(lambda x, y: 0 * x, n=100)
    smooth = np.arange(100) < 60
    xyz[~smooth, 2] += 0.1
    result = compare(PointCloud(xyz, smooth=smooth), height_field(lambda x, y: 0 * x))
    assert result.row("vertical", "smooth").n == 60
    assert result.row("vertical", "smooth").max_um == pytest.approx(0, abs=1e-9)
    assert result.row("vertical", "all").max_um == pytest.approx(100)


def test_the_valid_share_needs_the_count_of_lit_and_seen_pixels():
    mesh = height_field(lambda x, y: 0 * x)
    xyz = points_on(lambda x, y: 0 * x, n=90)
    assert compare(PointCloud(xyz), mesh).valid_share is None
    assert compare(PointCloud(xyz, facts={"lit_and_seen": "120"}), mesh).valid_share == 0.75
    with pytest.raises(InputError, match="lit_and_seen=none"):
        compare(PointCloud(xyz, facts={"lit_and_seen": "none"}), mesh)


def test_a_mesh_of_no_area_is_refused():
    line = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]], dtype=np.int32))
    with pytest.raises(InputError, match="positive area"):
        compare(PointCloud(np.zeros((1, 3))), line)
