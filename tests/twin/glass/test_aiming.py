"""Claims about rays that are aimed at the stop."""

import numpy as np
import pytest

from greenough.twin.glass.aiming import aim_exactly, fit_aim
from greenough.twin.glass.as_built import Tolerances, draw_path_errors
from greenough.twin.glass.paraxial import paraxial
from greenough.twin.glass.placed import place
from greenough.twin.glass.prescription import load_prescription
from greenough.twin.glass.trace import Double, image_point, rays_through, trace


def sampled(path, outwards, n, seed):
    """Points of the field and depth, or of the image, and points of the unit disk (2, n)."""
    rng = np.random.default_rng(seed)
    image, scale = path.prescription.image, abs(paraxial(path.prescription).magnification) if outwards else 1.0
    x, y, z = rng.uniform(-0.5, 0.5, (3, n)) * [[image.width / scale], [image.height / scale], [3.0]]
    radius, angle = np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    disk = radius * np.cos(angle), radius * np.sin(angle)
    point = (Double(x), Double(y), Double(z)) if outwards else image_point(path.image, Double(x), Double(y))
    return point, np.array(disk)


def area(polygon):
    """Area within the corners (2, n)."""
    a, b = polygon
    return abs(np.sum(a * np.roll(b, -1) - b * np.roll(a, -1))) / 2


def on_the_stop(path, rays, wavelength_um, outwards):
    stop = path.prescription.stop
    between = range(stop + 1) if outwards else range(stop, len(path.surfaces))
    met, _ = trace(path, rays, wavelength_um, outwards, between)
    return np.array([np.array(met.x), np.array(met.y)])


@pytest.mark.parametrize("outwards", [True, False], ids=["outwards", "inwards"])
def test_newton_hits_the_stop(built, outwards):
    point, disk = sampled(built, outwards, 500, seed=1)
    wanted = disk * built.prescription.stop_radius
    rays = aim_exactly(built, point, Double(wanted[0]), Double(wanted[1]), 0.51, outwards)
    assert on_the_stop(built, rays, 0.51, outwards) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("outwards", [True, False], ids=["outwards", "inwards"])
@pytest.mark.parametrize(("wavelength_um", "miss_um"), [(0.525, 0.2), (0.510, 10.0), (0.540, 10.0)])
def test_polynomials_hit_the_stop(built, outwards, wavelength_um, miss_um):
    """Within a fraction of a micrometre, and within 0.4 % of the stop's radius at the half widths of the spectrum."""
    point, disk = sampled(built, outwards, 2000, seed=2)
    aim = fit_aim(built, outwards)
    x, y, _ = aim(point, Double(disk[0]), Double(disk[1]))
    rays = rays_through(*point, x, y, aim.pupil.z, outwards)
    miss = on_the_stop(built, rays, wavelength_um, outwards) - disk * built.prescription.stop_radius
    assert np.linalg.norm(miss, axis=0).max() * 1e3 < miss_um


def test_weights_of_the_camera_add_up_to_the_solid_angle_of_the_stop():
    """The mean over the stop is the projected solid angle that a pixel sees: the area that the stop's edge encloses in
    the direction cosines along the sensor."""
    prescription = load_prescription("camera")
    tolerances = Tolerances(decentre_mm=0.09, tilt_deg=0.15, image_tilt_deg=0.9)
    path = place(prescription, draw_path_errors(prescription, tolerances, np.random.default_rng(5)))
    aim = fit_aim(path, outwards=False)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    edge = prescription.stop_radius * np.array([np.cos(angle), np.sin(angle)])
    radius = np.sqrt((np.arange(40) + 0.5) / 40)  # rings of equal area
    disk_x, disk_y = (np.outer(radius, c).ravel() for c in (np.cos(angle[::10]), np.sin(angle[::10])))

    def area_of_the_edge(x, y):
        point = image_point(path.image, Double(np.full(720, x)), Double(np.full(720, y)))
        rays = aim_exactly(path, point, Double(edge[0]), Double(edge[1]), 0.525, outwards=False)
        cosines = np.array([np.array(c) for c in rays[3:]])
        return area(np.array([path.image.along_x, path.image.along_y]) @ cosines)

    def mean_weight(x, y):
        point = image_point(path.image, Double(np.full(disk_x.size, x)), Double(np.full(disk_x.size, y)))
        return np.mean(np.array(aim(point, Double(disk_x), Double(disk_y))[2]))

    middle = area_of_the_edge(0.0, 0.0) / mean_weight(0.0, 0.0)
    for x, y in [(2.4, 1.8), (-2.4, 0.9), (1.0, -1.8)]:
        assert area_of_the_edge(x, y) / mean_weight(x, y) == pytest.approx(middle, rel=1e-4)


def test_weights_outwards_are_the_area_that_a_part_of_the_stop_fills_in_the_pupil(built):
    """Green's theorem around a small piece of the stop, aimed by Newton instead of the polynomials."""
    aim = fit_aim(built, outwards=True)
    radius, pupil = built.prescription.stop_radius, paraxial(built.prescription).entrance
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    circle = 0.05 * np.array([np.cos(angle), np.sin(angle)])

    def area_in_the_pupil(x, y, z, middle):
        point = tuple(Double(np.full(400, c)) for c in (x, y, z))
        disk = circle + np.array(middle)[:, None]
        rays = aim_exactly(built, point, Double(radius * disk[0]), Double(radius * disk[1]), 0.525, True)
        t = (pupil.z - np.array(rays.z)) / np.array(rays.n)
        a, b = np.array(rays.x) + t * np.array(rays.l), np.array(rays.y) + t * np.array(rays.m)
        return area(np.array([a, b]))

    def weight(x, y, z, middle):
        return np.array(aim((Double(x), Double(y), Double(z)), Double(middle[0]), Double(middle[1]))[2])[0]

    reference = area_in_the_pupil(0, 0, 0, (0, 0)) / weight(0, 0, 0, (0, 0))
    for where in [(5.0, 2.5, -1.5, (0.6, 0.3)), (-4.0, 2.0, 1.5, (-0.2, 0.9))]:
        assert area_in_the_pupil(*where) / weight(*where) == pytest.approx(reference, rel=3e-4)
