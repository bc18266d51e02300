"""Others' regression tests in one line: as pytest runs them, with the plugin as it is installed."""

import subprocess
import sys
from importlib.metadata import entry_points

import numpy as np
import pytest
import trimesh
from PIL import Image

pytest_plugins = ["pytester"]

HEAVY = ("numpy", "matplotlib", "drjit", "mitsuba", "trimesh", "scipy", "h5py", "igl", "PIL")

TESTS = """
import pytest
from greenough.pipeline import assert_matches_mesh as plain

def test_good(assert_matches_mesh):
    assert_matches_mesh("good.ply", "nominal.stl", tolerance_um=4)

@pytest.mark.parametrize("cloud", ["bad.ply"])
def test_bad(assert_matches_mesh, cloud):
    assert_matches_mesh(cloud, "nominal.stl", tolerance_um=4)

def test_good_by_function():
    plain("good.ply", "nominal.stl")

def test_bad_by_function():
    plain("bad.ply", "nominal.stl")
"""


@pytest.fixture
def project(pytester):
    """Somebody's tests, with a plane and two clouds on it: one right, one with a corner 20 µm too high."""
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-3, 3, 60), np.linspace(-2, 2, 40)))
    corners = np.array([[-5.0, -4, 0], [5, -4, 0], [5, 4, 0], [-5, 4, 0]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(pytester.path / "nominal.stl")
    noise = np.random.default_rng(1).normal(0, 1e-3, x.size)
    for name, bump in (("good", 0.0), ("bad", 0.02)):
        z = noise + bump * ((x > 1) & (y > 0.5))
        trimesh.PointCloud(np.column_stack([x, y, z])).export(pytester.path / f"{name}.ply")
    pytester.makepyfile(TESTS)
    return pytester


@pytest.mark.slow
def test_tests_pass_and_fail_with_a_picture_each(project):
    result = project.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=2, failed=2)
    pictures = sorted((project.path / "greenough-failures").iterdir())
    assert len(pictures) == 2
    for picture in pictures:
        result.stdout.fnmatch_lines([f"E * error map: {picture}"])
        with Image.open(picture) as drawn:
            assert drawn.width > 800
    result.stdout.fnmatch_lines(["E *bad.ply does not match nominal.stl: 95 % of the vertical errors are within *"])
    result.stdout.fnmatch_lines(["E *worst: +2* µm at (*) mm"])
    result.stdout.fnmatch_lines(["E *what to do: the shape differs*"])
    assert "test_bad-bad.ply" in pictures[0].name + pictures[1].name


@pytest.mark.slow
def test_the_failing_line_is_the_users_own(project):
    result = project.runpytest_subprocess("-p", "no:cacheprovider", "-k", "test_bad_by_function")
    result.stdout.fnmatch_lines([">*plain(*bad.ply*nominal.stl*)"])
    assert "def assert_matches_mesh" not in result.stdout.str()


@pytest.mark.slow
def test_pictures_go_where_they_are_asked_to(project):
    options = ("-p", "no:cacheprovider", "-k", "test_bad and not function", "--greenough-pictures", "seen/here")
    project.runpytest_subprocess(*options).assert_outcomes(failed=1, deselected=3)
    (picture,) = (project.path / "seen" / "here").iterdir()
    assert picture.suffix == ".png"
    assert not (project.path / "greenough-failures").exists()


def test_the_plugin_is_installed_and_loads_nothing_heavy():
    (plugin,) = (entry for entry in entry_points(group="pytest11") if entry.name == "greenough")
    assert plugin.value == "greenough.pipeline.pytest_plugin"
    program = f"import sys, pytest, {plugin.value}; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
