"""Exported clouds come back as they went, and surfaces have triangles where points are neighbours and nowhere else."""

import json

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from greenough.instrument.errors import InputError
from greenough.pipeline.commands import app
from greenough.pipeline.export import export_cloud
from greenough.pipeline.point_cloud import PointCloud, read_cloud, write_cloud
from greenough.pipeline.surface_mesh import surface_mesh, surface_normals

PITCH = 0.01


def cloud(rows=12, cols=17, height=lambda x, y: 0.1 * x + 0.0 * y, void=()):
    """Points of a height map, without the pixels in ``void``; pixels begin at (100, 200), and y falls with the row."""
    row, col = np.mgrid[:rows, :cols]
    x, y = PITCH * col, -PITCH * row
    kept = np.ones((rows, cols), bool)
    for pixel in void:
        kept[pixel] = False
    xyz = np.stack([x, y, height(x, y)], axis=-1)[kept]
    sigma = np.full(xyz.shape, 1e-3, np.float32)
    pixels = np.argwhere(kept).astype(np.int32) + np.array([100, 200], np.int32)
    return PointCloud(xyz, pixels, noise_mm=sigma, intensity=np.arange(len(xyz), dtype=np.float32))


def test_a_whole_map_is_a_surface_of_all_its_squares_that_looks_up():
    mesh = surface_mesh(cloud(12, 17))
    assert len(mesh.faces) == 2 * 11 * 16
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    np.testing.assert_allclose(surface.face_normals, np.array([[-0.1, 0, 1]] / np.sqrt(1.01)).repeat(352, 0), atol=1e-9)
    assert surface.area == pytest.approx(11 * 16 * PITCH**2 * np.sqrt(1.01))


def test_voids_and_steps_stay_open():
    mesh = surface_mesh(cloud(12, 17, void=[(5, 6)]))
    assert len(mesh.faces) == 352 - 8 + 4
    assert (trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals[:, 2] > 0.9).all()
    stepped = surface_mesh(cloud(12, 17, height=lambda x, y: 0.3 * (x > 0.085)))
    assert len(stepped.faces) == 352 - 2 * 11


def test_normals_are_the_surfaces_and_zero_where_a_point_has_no_neighbours():
    lonely = [(3, 4), (3, 5), (3, 6), (4, 4), (4, 6), (5, 4), (5, 5), (5, 6)]
    points = cloud(12, 17, height=lambda x, y: 0.1 * x - 0.2 * y, void=lonely)
    normals = surface_normals(points)
    alone = (points.pixels == [104, 205]).all(axis=1)
    np.testing.assert_allclose(
        normals[~alone], np.tile([-0.1, 0.2, 1] / np.sqrt(1.05), (len(normals) - 1, 1)), atol=1e-6
    )
    np.testing.assert_array_equal(normals[alone], [[0, 0, 0]])


def test_normals_of_a_ball_point_away_from_its_middle():
    radius = 0.3
    points = cloud(41, 41, height=lambda x, y: np.sqrt(radius**2 - (x - 0.2) ** 2 - (y + 0.2) ** 2))
    outwards = (points.xyz - [0.2, -0.2, 0]) / radius
    inner = ((points.pixels > [100, 200]) & (points.pixels < [140, 240])).all(axis=1)
    np.testing.assert_allclose(surface_normals(points)[inner], outwards[inner], atol=0.02)


def test_every_format_holds_the_same_points_in_mm(tmp_path):
    points = cloud(void=[(3, 4)])
    for name in ("c.xyz", "c.asc", "c.npz", "c.ply", "c.stl", "c.obj"):
        export_cloud(points, tmp_path / name)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "c.xyz"), points.xyz, atol=5e-7)
    assert (tmp_path / "c.asc").read_bytes() == (tmp_path / "c.xyz").read_bytes()
    with np.load(tmp_path / "c.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["xyz"], points.xyz)
        np.testing.assert_array_equal(arrays["pixels"], points.pixels)
        np.testing.assert_array_equal(arrays["sigma_noise"], points.noise_mm)
        np.testing.assert_array_equal(arrays["intensity"], points.intensity)
        assert str(arrays["units"]) == "mm"
    back = read_cloud(tmp_path / "c.ply")
    np.testing.assert_array_equal(back.xyz, points.xyz)
    np.testing.assert_array_equal(back.normals, surface_normals(points))
    np.testing.assert_array_equal(back.intensity, points.intensity)
    for name in ("c.stl", "c.obj"):
        mesh = trimesh.load(tmp_path / name, process=False)
        np.testing.assert_allclose(mesh.bounds, [points.xyz.min(axis=0), points.xyz.max(axis=0)], atol=1e-6)
        assert len(mesh.faces) == len(surface_mesh(points).faces)


def test_what_cannot_be_exported_is_one_sentence_and_leaves_no_file(tmp_path):
    points = cloud()
    with pytest.raises(InputError, match="must end in one of"):
        export_cloud(points, tmp_path / "c.docx")
    for bare, says in (
        (PointCloud(points.xyz), "which pixels"),
        (PointCloud(points.xyz[::18], points.pixels[::18]), "no surface"),
        (PointCloud(0 * points.xyz, points.pixels), "no surface"),
        (PointCloud(points.xyz[:2], np.array([[0, 0], [2**20, 2**20]], np.int32)), "claims a camera"),
    ):
        for ending in ("stl", "obj", "gwy", "gsf", "x3p"):
            with pytest.raises(InputError, match=says):
                export_cloud(bare, tmp_path / f"c.{ending}")
    with pytest.raises(InputError, match="no height map"):
        export_cloud(points, tmp_path / "c.stl", pitch_mm=0.01)
    with pytest.raises(InputError, match="pitch of 1000 µm"):
        export_cloud(points, tmp_path / "c.gwy", pitch_mm=1.0)
    assert list(tmp_path.iterdir()) == []


def test_points_that_are_no_surface_are_exported_without_normals(tmp_path):
    points = cloud()
    for few in (PointCloud(points.xyz), PointCloud(points.xyz[:1], points.pixels[:1])):
        export_cloud(few, tmp_path / "c.ply")
        back = read_cloud(tmp_path / "c.ply")
        assert back.normals is None
        np.testing.assert_array_equal(back.xyz, few.xyz)


def test_the_verb_writes_what_its_name_says(tmp_path):
    write_cloud(tmp_path / "c.ply", cloud())
    result = CliRunner().invoke(app, ["export", str(tmp_path / "c.ply"), "--out", str(tmp_path / "c.stl"), "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["points"] == 12 * 17
    assert answer["bytes"] == (tmp_path / "c.stl").stat().st_size == 84 + 50 * 352


def test_the_verb_writes_height_maps_with_the_pitch_that_is_asked_for(tmp_path):
    write_cloud(tmp_path / "c.ply", cloud(void=[(5, 6)]))
    for ending in ("gwy", "gsf", "x3p"):
        out = ["--out", str(tmp_path / f"c.{ending}"), "--pitch-um", "5", "--json"]
        result = CliRunner().invoke(app, ["export", str(tmp_path / "c.ply"), *out])
        assert result.exit_code == 0, result.output
        answer = json.loads(result.stdout)
        assert (answer["rows"], answer["cols"], answer["pitch_um"]) == (23, 33, 5)
        assert answer["voids"] == 5  # the missing pixel's, and of the nodes around it those beyond the cut corners
        assert answer["unit"] == "m"
