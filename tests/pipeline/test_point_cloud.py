import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.pipeline.point_cloud import Mesh, PointCloud, read_cloud, read_mesh, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap


def some_cloud(n=50):
    rng = np.random.default_rng(3)
    return PointCloud(
        xyz=rng.normal(size=(n, 3)),
        pixels=rng.integers(0, 1280, (n, 2)).astype(np.int32),
        smooth=rng.random(n) < 0.5,
        noise_mm=rng.random((n, 3)).astype(np.float32),
        calibration_mm=rng.random((n, 3)).astype(np.float32),
        intensity=rng.uniform(0, 255, n).astype(np.float32),
        normals=rng.normal(size=(n, 3)).astype(np.float32),
        facts={"lit_and_seen": "60", "filter": "none"},
    )


def tetrahedron():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1 / 3]])
    return Mesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32))


def test_a_cloud_comes_back_bit_by_bit(tmp_path):
    cloud = some_cloud()
    write_cloud(tmp_path / "cloud.ply", cloud)
    back = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(back.xyz, cloud.xyz)
    np.testing.assert_array_equal(back.pixels, cloud.pixels)
    np.testing.assert_array_equal(back.smooth, cloud.smooth)
    np.testing.assert_array_equal(back.noise_mm, cloud.noise_mm)
    np.testing.assert_array_equal(back.calibration_mm, cloud.calibration_mm)
    np.testing.assert_array_equal(back.intensity, cloud.intensity)
    np.testing.assert_array_equal(back.normals, cloud.normals)
    assert back.facts == cloud.facts


def test_another_program_reads_our_cloud(tmp_path):
    cloud = some_cloud()
    write_cloud(tmp_path / "cloud.ply", cloud)
    loaded = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(loaded.vertices, cloud.xyz)


def test_another_program_reads_our_mesh(tmp_path):
    write_mesh(tmp_path / "mesh.ply", tetrahedron(), {"specimen": "tetrahedron"})
    loaded = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(loaded.vertices, tetrahedron().vertices)
    assert loaded.volume == pytest.approx(1 / 18)  # signed: the faces kept their orientation


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "ascii.ply", "binary.ply"])
def test_meshes_of_other_programs_are_read(tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    mesh = trimesh.Trimesh(tetrahedron().vertices, tetrahedron().faces)
    if suffix == "ascii.ply":
        path.write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="ascii"))
    elif suffix == "ply":
        write_mesh(path, tetrahedron())
    else:
        mesh.export(path)
    back = read_mesh(path)
    triangles = back.vertices[back.faces]
    assert np.einsum("nk,nk->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6 == pytest.approx(
        1 / 18
    )


def test_polygons_are_read_as_triangles(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="<f4")
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    face = b"\x04" + np.arange(4, dtype="<i4").tobytes()
    (tmp_path / "quad.ply").write_bytes(header.encode() + corners.tobytes() + face)
    mesh = read_mesh(tmp_path / "quad.ply")
    assert len(mesh.faces) == 2


def test_only_valid_points_of_a_map_are_kept_with_their_pixels():
    xyz = np.arange(24.0).reshape(2, 4, 3)
    xyz[1, 2] = np.nan
    light = np.arange(8, dtype=np.float32).reshape(2, 4)
    point_map = PointMap(xyz, intensity=light)
    cloud = PointCloud.from_point_map(point_map, smooth=np.eye(2, 4, dtype=bool), facts={"run": 3})
    assert cloud.intensity is not None
    np.testing.assert_array_equal(cloud.intensity, [0, 1, 2, 3, 4, 5, 7])
    assert len(cloud.xyz) == 7
    np.testing.assert_array_equal(cloud.xyz, xyz[cloud.pixels[:, 0], cloud.pixels[:, 1]])
    assert cloud.smooth is not None
    np.testing.assert_array_equal(cloud.pixels[cloud.smooth], [[0, 0], [1, 1]])
    assert cloud.facts == {"run": "3"}


@settings(max_examples=40)
@given(share=st.floats(0, 0.999))
def test_a_truncated_file_is_refused_wherever_it_was_cut(tmp_path_factory, share):
    folder = tmp_path_factory.mktemp("cut")
    for name, write, read in (
        ("cloud.ply", lambda path: write_cloud(path, some_cloud()), read_cloud),
        ("mesh.ply", lambda path: write_mesh(path, tetrahedron()), read_mesh),
    ):
        path = folder / name
        write(path)
        whole = path.read_bytes()
        path.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(InputError, match=name):
            read(path)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (Mesh(tetrahedron().vertices, np.empty((0, 3), dtype=np.int32)), "no faces"),
        (Mesh(np.full((4, 3), np.nan), tetrahedron().faces), "not finite"),
        (Mesh(tetrahedron().vertices, tetrahedron().faces + 1), "vertices it does not have"),
    ],
)
def test_meshes_that_are_no_surface_are_refused(tmp_path, mesh, reason):
    write_mesh(tmp_path / "mesh.ply", mesh)
    with pytest.raises(InputError, match=reason):
        read_mesh(tmp_path / "mesh.ply")


@pytest.mark.parametrize("name", ["text.ply", "text.stl", "text.obj", "text.xyz"])
def test_a_foreign_file_is_refused(tmp_path, name):
    (tmp_path / name).write_text("no mesh at all\n")
    with pytest.raises(InputError, match=name):
        read_mesh(tmp_path / name)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_cloud(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="nowhere"):
        read_mesh(tmp_path / "nowhere.stl")


def test_a_cloud_without_points_is_refused(tmp_path):
    write_cloud(tmp_path / "empty.ply", PointCloud(np.full((3, 3), np.nan)))
    with pytest.raises(InputError, match="no points"):
        read_cloud(tmp_path / "empty.ply")


BINARY, ASCII, BIG = (f"ply\nformat {kind} 1.0\n" for kind in ("binary_little_endian", "ascii", "binary_big_endian"))
XYZ = "property double x\nproperty double y\nproperty double z\n"
PIXELS = "property double row\nproperty double col\n"
MANY = 1_000_000_000
POINTS = np.arange(9.0).tobytes()


@pytest.mark.parametrize(
    ("header", "body", "reason"),
    [
        (f"{BINARY}element vertex {MANY}\n{XYZ}", POINTS, "truncated"),
        (f"{BIG}element vertex {MANY}\n{XYZ}", POINTS, "cannot be read"),
        (f"{BINARY}element vertex {MANY}\n{XYZ}property list uchar int more\n", POINTS, "cannot be read"),
        (f"{ASCII}element vertex {MANY}\n{XYZ}", b"0 0 0\n1 1 1\n", "truncated: 2 of 1000000000"),
        (f"{BINARY}element vertex -1\n{XYZ}", POINTS, "cannot be understood"),
        (f"{BINARY}element vertex 1\n{XYZ}property double x\n", POINTS, "cannot be understood"),
        (f"{BINARY}element vertex 3\n", POINTS, "no x, y and z"),
        (f"{BINARY}element vertex 0\n{XYZ}", b"", "no points"),
        (f"{BINARY}element vertex 3\n{XYZ}", np.full(9, np.nan).tobytes(), "no points"),
        (f"{BINARY}element vertex 1\n{XYZ}", np.array([0, 0, 1e300]).tobytes(), "further out"),
        (f"{BINARY}element vertex 1\n{XYZ}{PIXELS}", np.array([0, 0, 0, np.nan, 1]).tobytes(), "no camera has"),
        (f"{BINARY}element vertex 1\n{XYZ}{PIXELS}", np.array([0, 0, 0, 2, -1e30]).tobytes(), "no camera has"),
    ],
)
def test_impossible_points_and_claims_are_one_sentence(tmp_path, header, body, reason):
    (tmp_path / "cloud.ply").write_bytes(f"{header}end_header\n".encode() + body)
    with pytest.raises(InputError, match=reason):
        read_cloud(tmp_path / "cloud.ply")


def test_a_claim_of_faces_is_held_against_the_files_size(tmp_path):
    write_mesh(tmp_path / "mesh.ply", tetrahedron())
    data = (tmp_path / "mesh.ply").read_bytes().replace(b"element face 4", f"element face {1000 * MANY}".encode())
    (tmp_path / "mesh.ply").write_bytes(data)
    with pytest.raises(InputError, match="4 of 1000000000000 faces"):
        read_mesh(tmp_path / "mesh.ply")


@pytest.mark.parametrize("name", ["cloud.ply", "text.ply", "mesh.stl", "lines.xyz"])
def test_a_file_of_20_gb_is_refused_before_it_is_read(tmp_path, name):
    header = f"{ASCII if name == 'text.ply' else BINARY}element vertex 800000000\n{XYZ}end_header\n"
    with open(tmp_path / name, "wb") as file:
        file.write(header.encode() if name.endswith("ply") else b"solid\n")
        file.truncate(20 * 10**9)  # which takes no room on the disk
    for read in (read_cloud, read_mesh):
        with pytest.raises(InputError, match="GiB"):
            read(tmp_path / name)


def test_archives_are_not_unpacked(tmp_path):
    for name in ("cloud.zip", "cloud.3mf", "cloud.glb", "cloud"):
        (tmp_path / name).write_bytes(b"PK")
        for read in (read_cloud, read_mesh):
            with pytest.raises(InputError, match="endings"):
                read(tmp_path / name)
