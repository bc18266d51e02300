"""What is exported opens in programs that are not ours, and their figures are ours.

Gwyddion and surfalize read the height maps, CloudCompare points and meshes, and so does MeshLab's library. All run
without a screen.
"""

from pathlib import Path

import gwyfile
import numpy as np
import pytest

from greenough.pipeline.compare import Surface, signed_distances
from greenough.pipeline.export import export_cloud
from greenough.pipeline.height_map import height_map
from greenough.pipeline.point_cloud import Mesh, PointCloud, read_cloud, write_mesh
from greenough.pipeline.surface_mesh import surface_mesh
from peers import need_module, need_program, run_headless

pytestmark = pytest.mark.peers

PITCH = 0.05


def surface_height(x, y):
    return 0.1 * np.sin(2 * x) + 0.05 * y


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    """A noisy part with a step, a large void and scattered ones; no mirror image of itself."""
    rng = np.random.default_rng(1)
    row, col = np.mgrid[:60, :80]
    x, y = PITCH * (col - 40) + 0.002 * row, -PITCH * (row - 30)
    z = surface_height(x, y) + 0.7 * (x > 1.52) + rng.normal(0, 0.003, x.shape)
    kept = rng.random(x.shape) > 0.02
    kept[10:20, 20:35] = False
    return PointCloud(
        np.stack([x, y, z], axis=-1)[kept],
        np.argwhere(kept).astype(np.int32),
        noise_mm=rng.uniform(0.001, 0.002, (kept.sum(), 3)).astype(np.float32),
        intensity=rng.uniform(0, 200, kept.sum()).astype(np.float32),
        facts={"rig": "a <rig> & more", "sample": "µ"},
    )


@pytest.mark.parametrize(("ending", "eps"), [("x3p", 1e-12), ("gwy", 1e-12), ("gsf", 1e-6)])
def test_gwyddion_opens_a_height_map_and_its_statistics_are_ours(tmp_path, cloud, ending, eps):
    need_program("gwyddion", "gwyddion")
    export_cloud(cloud, tmp_path / f"map.{ending}")
    heights = height_map(cloud)
    said = run_headless("gwyddion", f"--convert-to-gwy={tmp_path / 'theirs.gwy'}", tmp_path / f"map.{ending}")
    assert said.strip() == ""
    theirs = gwyfile.load(str(tmp_path / "theirs.gwy"))
    field, mask = theirs["/0/data"], theirs["/0/mask"].data > 0
    rows_up = ending == "x3p"  # it is shown as it is stored, with the lowest row first
    z = 1e-3 * (heights.z[::-1] if rows_up else heights.z)
    np.testing.assert_array_equal(mask, np.isnan(z))
    assert mask.sum() > 100
    for statistic in (np.min, np.max, np.mean, np.std):
        assert statistic(field.data[~mask]) == pytest.approx(statistic(z[~mask]), rel=eps)
    np.testing.assert_allclose(field.data[~mask], z[~mask], rtol=eps)
    size = 1e-3 * heights.pitch * np.array(z.shape)
    assert (field.yreal, field.xreal) == pytest.approx(tuple(size), rel=1e-9)
    assert field.si_unit_xy.unitstr == field.si_unit_z.unitstr == "m"
    assert any("a <rig> & more" in value for value in theirs["/0/meta"].values())


@pytest.mark.parametrize("ending", ["x3p", "gwy"])
def test_surfalize_opens_a_height_map_and_its_roughness_is_ours(tmp_path, cloud, ending):
    surfalize = need_module("surfalize")
    export_cloud(cloud, tmp_path / f"map.{ending}")
    theirs = surfalize.Surface.load(tmp_path / f"map.{ending}")
    heights = height_map(cloud)
    z = 1e3 * (heights.z[::-1] if ending == "x3p" else heights.z)  # µm
    assert (theirs.step_x, theirs.step_y) == pytest.approx((1e3 * heights.pitch,) * 2)
    assert theirs.data.shape == z.shape
    if ending == "x3p":  # of a gwy file it does not read the mask
        np.testing.assert_array_equal(np.isnan(theirs.data), np.isnan(z))
    np.testing.assert_allclose(theirs.data[~np.isnan(z)], z[~np.isnan(z)], rtol=1e-9)


def mesh_of_the_part() -> Mesh:
    x, y = np.meshgrid(np.linspace(-3, 3, 201), np.linspace(-3, 3, 201))
    number = np.arange(x.size).reshape(x.shape)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([corners[:, :3], corners[:, [0, 2, 3]]]).astype(np.int32)
    return Mesh(np.stack([x, y, surface_height(x, y)], axis=-1).reshape(-1, 3), faces)


def cloudcompare_reads(path: Path) -> dict[str, np.ndarray]:
    """The columns of an ASCII file by CloudCompare."""
    with open(path) as file:
        names = file.readline().strip("/ \n").split()
        return dict(zip(names, np.loadtxt(file, ndmin=2).T, strict=True))


def test_cloudcompare_finds_the_same_distances_from_cloud_to_mesh(tmp_path, cloud):
    need_program("CloudCompare", "cloudcompare")
    export_cloud(cloud, tmp_path / "cloud.ply")
    write_mesh(tmp_path / "mesh.ply", mesh_of_the_part())
    run_headless(
        *("CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "12", "-ADD_HEADER"),
        *("-O", tmp_path / "cloud.ply", "-O", tmp_path / "mesh.ply"),
        *("-C2M_DIST", "-SAVE_CLOUDS", "FILE", tmp_path / "theirs.asc"),
    )
    theirs = cloudcompare_reads(tmp_path / "theirs.asc")
    ours = signed_distances(cloud.xyz, Surface.of(mesh_of_the_part()))
    assert np.ptp(ours) > 0.5
    np.testing.assert_allclose(theirs["C2M_signed_distances"], ours, atol=1e-6)  # 1 nm: it keeps single precision
    np.testing.assert_allclose(np.stack([theirs[axis] for axis in "XYZ"], axis=-1), cloud.xyz, atol=2e-7)
    np.testing.assert_array_equal(theirs["intensity"].astype(np.float32), cloud.intensity)
    normals = read_cloud(tmp_path / "cloud.ply").normals
    assert normals is not None
    # It keeps directions to a degree or so.
    cosine = np.einsum("nk,nk->n", np.stack([theirs[f"N{axis}"] for axis in "xyz"], axis=-1), normals)
    assert cosine[np.abs(normals).any(axis=1)].min() > np.cos(np.radians(2))


@pytest.mark.parametrize("ending", ["xyz", "asc"])
def test_cloudcompare_opens_lines(tmp_path, cloud, ending):
    need_program("CloudCompare", "cloudcompare")
    export_cloud(cloud, tmp_path / f"cloud.{ending}")
    run_headless(
        *("CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "9", "-ADD_HEADER"),
        *("-O", tmp_path / f"cloud.{ending}", "-SAVE_CLOUDS", "FILE", tmp_path / "theirs.asc"),
    )
    theirs = cloudcompare_reads(tmp_path / "theirs.asc")
    np.testing.assert_allclose(np.stack([theirs[axis] for axis in "XYZ"], axis=-1), cloud.xyz, atol=7e-7)


@pytest.mark.parametrize("ending", ["stl", "obj"])
def test_meshlabs_library_opens_a_surface_and_measures_the_same_area(tmp_path, cloud, ending):
    pymeshlab = need_module("pymeshlab")
    export_cloud(cloud, tmp_path / f"surface.{ending}")
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / f"surface.{ending}"))
    theirs, ours = meshes.current_mesh(), surface_mesh(cloud)
    corners = ours.vertices[ours.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert theirs.face_number() == len(ours.faces)
    assert meshes.apply_filter("get_geometric_measures")["surface_area"] == pytest.approx(areas.sum(), rel=1e-6)
    used = ours.vertices[np.unique(ours.faces)]
    box = theirs.bounding_box()
    np.testing.assert_allclose([box.min(), box.max()], [used.min(axis=0), used.max(axis=0)], atol=1e-6)
    assert theirs.face_normal_matrix()[:, 2].min() > 0
    sides = np.sort(np.stack([ours.faces, np.roll(ours.faces, 1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    open_sides = np.count_nonzero(np.unique(sides, axis=0, return_counts=True)[1] == 1)
    assert meshes.apply_filter("get_topological_measures")["boundary_edges"] == open_sides > 2 * (60 + 80)


def test_meshlabs_library_opens_points_with_their_normals(tmp_path, cloud):
    pymeshlab = need_module("pymeshlab")
    export_cloud(cloud, tmp_path / "cloud.ply")
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "cloud.ply"))
    theirs, ours = meshes.current_mesh(), read_cloud(tmp_path / "cloud.ply")
    assert (theirs.vertex_number(), theirs.face_number()) == (len(cloud.xyz), 0)
    np.testing.assert_allclose(theirs.vertex_matrix(), cloud.xyz, atol=1e-12)
    np.testing.assert_allclose(theirs.vertex_normal_matrix(), ours.normals, atol=1e-6)
