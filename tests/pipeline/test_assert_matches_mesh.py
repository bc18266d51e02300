"""The one line that compares a cloud with a mesh: what passes, what does not, and what is said then."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from greenough.instrument.errors import InputError
from greenough.pipeline import assert_matches_mesh
from greenough.pipeline.compare import compare
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap

ROWS, COLS = 60, 80


def dome(x, y):
    return 0.3 - (x**2 + y**2) / 60


def mesh():
    x, y = np.meshgrid(np.linspace(-5, 5, 101), np.linspace(-4, 4, 81))
    index = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return Mesh(np.column_stack([x.ravel(), y.ravel(), dome(x, y).ravel()]), faces)


def point_map(lift_um=0.0, spike_um=0.0):
    """Points on the dome but for a lift, and a spike at row 10, column 20."""
    x, y = np.meshgrid(np.linspace(-3, 3, COLS), np.linspace(2, -2, ROWS))
    z = dome(x, y) + 1e-3 * lift_um
    z[10, 20] += 1e-3 * spike_um
    z[30, 40] = np.nan
    return PointMap(np.stack([x, y, z], axis=-1))


def failure(*arguments, **options):
    with pytest.raises(AssertionError) as caught:
        assert_matches_mesh(*arguments, **options)
    message = str(caught.value)
    return message, Path(re.search(r"error map: (.*\.png)", message)[1])


def forms(tmp_path, points):
    """The same points, and the same mesh, in every form that is taken."""
    cloud, surface = PointCloud.from_point_map(points), mesh()
    write_cloud(tmp_path / "cloud.ply", cloud)
    write_mesh(tmp_path / "mesh.ply", surface)
    yield cloud, surface
    yield points, trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    yield points.xyz, tmp_path / "mesh.ply"
    yield cloud.xyz, str(tmp_path / "mesh.ply")
    yield str(tmp_path / "cloud.ply"), surface


def test_every_form_of_cloud_and_mesh_is_judged_alike(tmp_path):
    results = [assert_matches_mesh(cloud, surface).rows for cloud, surface in forms(tmp_path, point_map(lift_um=3.0))]
    assert len(results) == 5
    assert all(rows == results[0] for rows in results)
    assert results[0][1].bias_um == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("lift", [3.2, 4.8])
def test_it_judges_as_compare_does(tmp_path, lift):
    points = point_map(lift_um=lift)
    found = compare(PointCloud.from_point_map(points), mesh())
    p95 = found.row("vertical").p95_um
    assert_matches_mesh(points, mesh(), tolerance_um=p95)
    message, _ = failure(points, mesh(), tolerance_um=np.nextafter(p95, 0), pictures=tmp_path)
    assert f"95 % {p95:.4g}" in message


def test_the_message_has_figures_place_remedy_and_picture(tmp_path):
    message, picture = failure(point_map(lift_um=10.0, spike_um=-200.0), mesh(), pictures=tmp_path)
    row = compare(PointCloud.from_point_map(point_map(10.0, -200.0)), mesh()).row("vertical")
    assert (
        f"bias {row.bias_um:.4g}, rms {row.rmse_um:.4g}, 95 % {row.p95_um:.4g}, largest {row.max_um:.4g} µm" in message
    )
    assert f"n = {ROWS * COLS - 1} of {ROWS * COLS - 1} points" in message
    worst = re.search(r"worst: (\S+) µm at \((.*)\) mm, pixel \(row (\d+), col (\d+)\)", message)
    assert float(worst[1]) == pytest.approx(-190, abs=1)
    assert (int(worst[3]), int(worst[4])) == (10, 20)
    x, y, _ = (float(value) for value in worst[2].split(", "))
    assert (x, y) == pytest.approx((-3 + 6 * 20 / 79, 2 - 4 * 10 / 59), abs=1e-3)
    assert picture.parent == tmp_path


@pytest.mark.parametrize(
    ("points", "options", "remedy"),
    [
        (point_map(lift_um=50.0), {}, 'lies elsewhere: aligned rigidly, 95 % are within .* pass align="rigid"'),
        (PointMap(point_map().xyz * [1, 1, 1.2]), {}, "the shape differs, aligned rigidly"),
        (PointMap(point_map().xyz * [1, 1, 1.2]), {"align": "rigid"}, "the shape differs: see in the map"),
        (PointMap(point_map().xyz * 1000), {}, "save both in mm"),
        (PointMap(point_map().xyz + np.array([20, 0, 0])), {}, "no point lies above or below the mesh"),
    ],
)
def test_the_remedy_fits_what_is_wrong(tmp_path, points, options, remedy):
    message, picture = failure(points, mesh(), pictures=tmp_path, **options)
    assert re.search(f"what to do: .*{remedy}", message)
    with Image.open(picture) as drawn:
        drawn.load()


def test_a_cloud_that_lies_elsewhere_passes_when_it_is_aligned():
    assert assert_matches_mesh(point_map(lift_um=50.0), mesh(), align="rigid", tolerance_um=0.6).alignment == "rigid"


def test_no_picture_and_no_folder_is_made_where_it_matches(tmp_path):
    assert_matches_mesh(point_map(), mesh(), pictures=tmp_path / "none")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_pictures_of_tests_whose_names_differ_in_signs_alone_are_kept_apart(tmp_path, monkeypatch):
    pictures = set()
    for test in ("test_a.py::test[1/2] (call)", "test_a.py::test[1-2] (call)", "test_a.py::test[é (x)] (call)"):
        monkeypatch.setenv("PYTEST_CURRENT_TEST", test)
        pictures.add(failure(point_map(lift_um=9), mesh(), pictures=tmp_path)[1])
    assert {picture.name[:14] for picture in pictures} == {"test_a.py-test"}
    assert len(pictures) == 3


def test_a_name_with_markup_or_mathematics_spoils_no_picture(tmp_path, monkeypatch):
    monkeypatch.delenv("PYTEST_CURRENT_TEST")
    write_cloud(tmp_path / "$x_{<b>.ply", PointCloud.from_point_map(point_map(lift_um=9)))
    _, picture = failure(tmp_path / "$x_{<b>.ply", mesh(), pictures=tmp_path)
    assert re.fullmatch(r"[\w.=-]+\.png", picture.name)
    assert picture.exists()


def test_where_no_picture_can_be_made_the_figures_are_not_lost(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(AssertionError, match=r"(?s)bias 9\..*error map: none \(.*exists"):
        assert_matches_mesh(point_map(lift_um=9), mesh(), pictures=tmp_path / "taken")


@pytest.mark.parametrize(
    ("cloud", "options", "sentence"),
    [
        (np.zeros((5, 2)), {}, r"shape \(5, 2\)"),
        (np.zeros(3), {}, r"shape \(3,\)"),
        (np.full((4, 5, 3), np.nan), {}, "nothing was measured"),
        (PointCloud(np.empty((0, 3))), {}, "nothing was measured"),
        ("missing.ply", {}, "there is no file missing.ply"),
        (np.zeros((5, 3)), {"tolerance_um": 0}, "must be above 0"),
        (np.zeros((5, 3)), {"tolerance_um": float("nan")}, "must be above 0"),
    ],
)
def test_what_cannot_be_judged_is_refused(cloud, options, sentence):
    with pytest.raises(InputError, match=sentence):
        assert_matches_mesh(cloud, mesh(), **options)
