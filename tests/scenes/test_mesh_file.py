"""Claims about meshes from files."""

import numpy as np
import pytest
import trimesh

from greenough.instrument.errors import InputError
from greenough.scenes.mesh_file import load_mesh

HEADER = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
TRIANGLE = HEADER + FACE + "end_header\n0 0 {z}\n1 0 0\n0 1 0\n3 {face}\n"


@pytest.fixture
def box():
    return trimesh.creation.box((4.0, 3.0, 1.0))


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "STL"])
@pytest.mark.parametrize(("unit", "mm"), [("mm", 1.0), ("um", 1e-3), ("m", 1e3), ("inch", 25.4)])
def test_every_format_and_unit_gives_the_same_body(tmp_path, box, suffix, unit, mm):
    path = tmp_path / f"box.{suffix}"
    box.apply_scale(1 / mm)
    box.export(path, file_type=suffix.lower())
    specimen = load_mesh(path, unit)
    (part,) = specimen.parts
    assert specimen.name == "box"
    assert part.faces.shape == (12, 3)
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), [4, 3, 1], rtol=1e-6)
    volume = np.linalg.det(part.vertices[part.faces]).sum() / 6
    np.testing.assert_allclose(volume, 12, rtol=1e-6)  # positive: still seen from outside


def test_a_pose_turns_about_x_then_y_then_z_and_then_moves(tmp_path):
    path = tmp_path / "triangle.ply"
    path.write_text(TRIANGLE.format(z=0, face="0 1 2"))
    vertices = load_mesh(path, pose_mm_deg=(1, 2, 0.5, 90, 0, 90)).parts[0].vertices
    # x -> x -> y; y -> z -> z.
    np.testing.assert_allclose(vertices - [1, 2, 0.5], [[0, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)


def test_a_mesh_is_of_the_material_that_it_is_said_to_be_and_matte_otherwise(tmp_path, box):
    path = tmp_path / "box.stl"
    path.write_bytes(box.export(file_type="stl"))
    assert [load_mesh(path, **said).parts[0].material for said in ({}, {"material": "solder"})] == ["matte", "solder"]


def test_larger_polygons_and_several_objects_are_read_as_triangles(tmp_path):
    path = tmp_path / "objects.obj"
    square = "o a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl q\nf 1 2 3 4\n"
    path.write_text(f"mtllib no.mtl\n{square}o b\nv 2 0 0\nf 2 5 3\n")
    (part,) = load_mesh(path).parts
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    assert len(part.faces) == 3
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2].sum() / 2, 1.5)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("cloud.ply", HEADER + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "has no faces"),
        ("cloud.obj", "v 0 0 0\nv 1 0 0\n", "has no faces"),
        ("empty.stl", "", "has no faces"),
        ("garbage.ply", "garbage", "cannot be read as PLY"),
        ("wrong.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", "cannot be read as OBJ"),
        ("nan.ply", TRIANGLE.format(z="nan", face="0 1 2"), "vertex 0 of .*nan.ply is not finite"),
        ("inf.ply", TRIANGLE.format(z="inf", face="0 1 2"), "vertex 0 of .*inf.ply is not finite"),
        ("index.ply", TRIANGLE.format(z="0", face="0 1 7"), "vertex 7, but its vertices are 0 to 2"),
        ("mesh.step", "", r"give one of \.stl, \.ply, \.obj"),
    ],
)
def test_a_file_that_is_no_usable_mesh_is_refused(tmp_path, name, content, sentence):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=sentence):
        load_mesh(path)


def test_a_truncated_file_is_refused(tmp_path, box):
    for suffix in ("stl", "ply"):
        path = tmp_path / f"cut.{suffix}"
        path.write_bytes(box.export(file_type=suffix)[:300])
        with pytest.raises(InputError, match="damaged"):
            load_mesh(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_mesh(tmp_path / "none.stl")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"unit": "m"}, "measures 4000 x 3000 x 1000 mm"),
        ({"unit": "um"}, "measures 0.004 x 0.003 x 0.001 mm"),
        ({"unit": "cm"}, "choose one of um, mm, m, inch"),
        ({"material": "cheese"}, "'cheese'; choose one of ceramic, ink, matte, metal, solder, substrate, film"),
        ({"pose_mm_deg": (0, 0, 3, 0, 0, 0)}, r"around \(0, 0, 3\) mm"),
        ({"pose_mm_deg": (0, 0, 0, 0, 90, 0)}, "measures 1 x 3 x 4 mm"),
        ({"pose_mm_deg": (0, 0, float("nan"), 0, 0, 0)}, "six finite numbers"),
        ({"pose_mm_deg": (0, 0, 0)}, "six finite numbers"),
    ],
)
def test_a_wrong_unit_pose_or_material_is_refused_with_what_would_do(tmp_path, box, arguments, sentence):
    path = tmp_path / "box.stl"
    path.write_bytes(box.export(file_type="stl"))
    with pytest.raises(InputError, match=sentence):
        load_mesh(path, **arguments)
