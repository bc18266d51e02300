"""Pictures of a lens path: its surfaces with rays, its spots, and its aberrations over the field."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from greenough.instrument.files import atomic_path
from greenough.instrument.packets import packed

from ..diffraction import airy_radius
from ..renderer import dr
from .aberrations import (
    astigmatic_foci,
    best_focus,
    chief_rays,
    distortion,
    image_points,
    lateral_colour,
    pencils,
    rms_radius,
    stop_points,
)
from .aiming import aim_exactly
from .paraxial import DESIGN_WAVELENGTH_UM, paraxial
from .placed import PlacedPath, PlacedSurface
from .trace import Double, image_point, land, trace

STRETCH = 5  # across the axis, in the drawing of surfaces
X_SHOWN = (-11.0, 8.5)
FIELDS = (0.0, 0.5, 0.7, 0.85, 1.0)  # of the half diagonal
DEPTHS = (-1.5, -0.75, 0.0, 0.75, 1.5)
COLOURS = {0.510: "tab:blue", 0.525: "tab:green", 0.540: "tab:red"}  # by wavelength in µm


def draw_path(path: PlacedPath, folder: Path) -> list[Path]:
    """Write the three pictures of a path as PNG into ``folder`` and return their names."""
    name = path.prescription.name
    figures = {"layout": layout(path), "spots": spots(path), "field": over_field(path)}
    files = []
    for kind, figure in figures.items():
        files.append(folder / f"{name}-{kind}.png")
        with atomic_path(files[-1]) as temporary:
            FigureCanvasAgg(figure).print_figure(temporary, dpi=150)
    return files


def layout(path: PlacedPath) -> Figure:
    """The section y = 0 with the pencils of three field points, stretched across the axis."""
    prescription = path.prescription
    width = 14.0
    height = 1.2 + (X_SHOWN[1] - X_SHOWN[0]) * STRETCH * 0.9 * width / prescription.vertices[-1]
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    field = prescription.image.width / 2 / abs(paraxial(prescription).magnification)
    for x, colour in zip((0.0, 0.7 * field, field), ("tab:blue", "tab:green", "tab:red"), strict=True):
        for z, height in _drawn_rays(path, x):
            axes.plot(z, height, color=colour, linewidth=0.6)
    surfaces = path.surfaces
    for k, surface in enumerate(surfaces):
        if k == prescription.stop:
            radius, z = surface.semi_diameter, surface.vertex[2]
            for sign in (1, -1):
                axes.plot([z, z], [sign * radius, sign * 1.8 * radius], color="black", linewidth=2.5)
            axes.annotate("stop", (z, 1.9 * radius), ha="center", fontsize=8)
            continue
        z, x = _profile(surface)
        axes.plot(z, x, color="black", linewidth=0.9)
        if surface.glass_behind != "air":  # the edges of the lens between this surface and the next
            far_z, far_x = _profile(surfaces[k + 1])
            for end in (0, -1):
                axes.plot([z[end], far_z[end]], [x[end], far_x[end]], color="black", linewidth=0.9)
    for element, numbers in prescription.elements.items():
        middle = np.mean([surfaces[k].vertex[2] for k in numbers])
        axes.annotate(element.replace(" ", "\n", 1), (float(middle), -7.6), ha="center", va="top", fontsize=8)
    for half, z, text in (
        (field, 0.0, "specimen"),
        (prescription.image.width / 2, float(prescription.vertices[-1]), "sensor" if _is_camera(path) else "mirrors"),
    ):
        axes.plot([z, z], [-half, half], color="black", linewidth=2)
        axes.annotate(text, (z, -7.6), ha="center", va="top", fontsize=8)
    axes.set(xlabel="z (mm)", ylabel="x (mm)", title=f"{prescription.name} path, x stretched {STRETCH} times")
    axes.set_aspect(STRETCH)
    axes.set_ylim(*X_SHOWN)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def spots(path: PlacedPath) -> Figure:
    """Spots on the specimen over field and depth at three wavelengths, and the Airy disc around the chief ray."""
    summary = paraxial(path.prescription)
    airy_um = airy_radius(summary.na, DESIGN_WAVELENGTH_UM)
    radii = _half_diagonal(path) * np.array(FIELDS)
    points = image_points(path, _diagonal(path, radii))
    disk = stop_points(8)
    chief = chief_rays(path, points)
    bundles = {colour: pencils(path, points, disk, wavelength) for wavelength, colour in COLOURS.items()}
    figure = Figure(figsize=(11, 12), layout="constrained")
    grid = figure.subplots(len(radii), len(DEPTHS), sharex=True, sharey=True, squeeze=False)
    for column, z in enumerate(DEPTHS):
        middle = chief.crossing(z)
        rms_um = 1e3 * rms_radius(pencils(path, points, disk), z)
        for row, axes in enumerate(grid[:, column]):
            for colour, bundle in bundles.items():
                seen = bundle.passed[row] > 0
                shown = 1e3 * (bundle.crossing(z)[row] - middle[row])[seen]
                axes.plot(*shown.T, ".", color=colour, markersize=1.5)
            circle = airy_um * np.exp(1j * np.linspace(0, 2 * np.pi, 100))
            axes.plot(circle.real, circle.imag, color="0.6", linewidth=0.8)
            axes.set(aspect="equal", xlim=(-32, 32), ylim=(-30, 34))
            axes.text(0.03, 0.97, f"RMS {rms_um[row]:.1f} µm", transform=axes.transAxes, va="top", fontsize=8)
            if row == 0:
                axes.set_title(f"z = {z:g} mm", fontsize=10)
            if column == 0:
                axes.set_ylabel(f"field {radii[row]:.2f} mm\ny (µm)", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("x (µm)", fontsize=9)
    handles = [Line2D([], [], color=c, marker=".", linestyle="", label=f"{1e3 * w:.0f} nm") for w, c in COLOURS.items()]
    handles.append(Line2D([], [], color="0.6", label=f"Airy radius {airy_um:.1f} µm"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    figure.suptitle(
        f"{path.prescription.name} path: spots on the specimen; RMS at {1e3 * DESIGN_WAVELENGTH_UM:.0f} nm without rims"
    )
    return figure


def over_field(path: PlacedPath) -> Figure:
    """Distortion, field curvature, vignetting, colour and spot size against the field's radius."""
    radii = _half_diagonal(path) * np.linspace(0.02, 1.0, 50)
    points = image_points(path, _diagonal(path, radii))
    field, distorted = distortion(path, points)
    x = np.linalg.norm(field, axis=1)
    tangential, sagittal = astigmatic_foci(path, points)
    bundle = pencils(path, points, stop_points(40))
    focus = best_focus(bundle)
    airy_um = airy_radius(paraxial(path.prescription).na, DESIGN_WAVELENGTH_UM)
    colours = [wavelength for wavelength in COLOURS if wavelength != DESIGN_WAVELENGTH_UM]

    figure = Figure(figsize=(12, 7), layout="constrained")
    first, second, third, fourth, fifth, sixth = figure.subplots(2, 3, sharex=True).ravel()
    _curves(first, x, {"": 100 * distorted}, "distortion (%)")
    _curves(second, x, {"tangential": tangential, "sagittal": sagittal, "best": focus}, "sharp at z (mm)")
    _curves(third, x, {"": 100 * bundle.passed.mean(axis=1)}, "light past the rims (%)")
    third.set_ylim(0, 105)
    shifts = 1e3 * lateral_colour(path, points, np.array(colours))
    for wavelength, shift in zip(colours, shifts, strict=True):
        fourth.plot(x, shift, color=COLOURS[wavelength], label=f"{1e3 * wavelength:.0f} nm")
    _curves(fourth, x, {}, f"lateral colour against {1e3 * DESIGN_WAVELENGTH_UM:.0f} nm (µm)")
    fourth.legend(fontsize=9)
    _curves(
        fifth,
        x,
        {"best focus": 1e3 * rms_radius(bundle, focus), "z = 0": 1e3 * rms_radius(bundle, 0.0)},
        "RMS spot radius (µm)",
    )
    fifth.axhline(airy_um, color="0.6", linewidth=0.8)
    fifth.annotate("Airy radius", (x[0], airy_um), va="bottom", fontsize=9, color="0.4")
    outward = field / x[:, None]
    for z in (DEPTHS[0], 0.0, DEPTHS[-1]):
        light = bundle.passed[..., None] / bundle.passed.sum(axis=1)[:, None, None]
        offset = (light * bundle.crossing(z)).sum(axis=1) - chief_rays(path, points).crossing(z)[:, 0]
        sixth.plot(x, 1e3 * np.sum(offset * outward, axis=1), label=f"z = {z:g} mm")
    _curves(sixth, x, {}, "centroid past the rims − chief ray (µm)")
    sixth.legend(fontsize=9)
    for axes in (fourth, fifth, sixth):
        axes.set_xlabel("field radius on the specimen (mm)")
    figure.suptitle(f"{path.prescription.name} path, {1e3 * DESIGN_WAVELENGTH_UM:.0f} nm, along the image's diagonal")
    return figure


def _curves(axes: Axes, x: np.ndarray, curves: dict[str, np.ndarray], label: str) -> None:
    for name, y in curves.items():
        axes.plot(x, y, label=name)
    if len(curves) > 1:
        axes.legend(fontsize=9)
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)


def _drawn_rays(path: PlacedPath, field_x: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """(z, x) of rays from the specimen's (field_x, 0, 0) through five points of the stop, surface by surface."""
    heights = Double(packed(np.linspace(-1, 1, 5) * path.prescription.stop_radius))
    zero = dr.zeros(Double, 5)
    rays = aim_exactly(path, (zero + field_x, zero, zero), heights, zero, DESIGN_WAVELENGTH_UM, outwards=True)
    z, x = [np.zeros(5)], [np.full(5, field_x)]
    for k in range(len(path.surfaces)):
        rays, _ = trace(path, rays, DESIGN_WAVELENGTH_UM, outwards=True, surfaces=[k])
        z.append(np.array(rays.z))
        x.append(np.array(rays.x))
    _, _, z_image = image_point(path.image, *land(path.image, rays))
    x.append(np.array(land(path.image, rays)[0]))
    z.append(np.array(z_image))
    return list(zip(np.transpose(z), np.transpose(x), strict=True))


def _profile(surface: PlacedSurface) -> tuple[np.ndarray, np.ndarray]:
    """(z, x) of a surface's section within its rim."""
    x = np.linspace(-surface.semi_diameter, surface.semi_diameter, 41)
    sag = surface.curvature * x**2 / (1 + np.sqrt(1 - (surface.curvature * x) ** 2))
    lean = surface.axis[0] / surface.axis[2]
    return surface.vertex[2] + sag - lean * x, surface.vertex[0] + x


def _is_camera(path: PlacedPath) -> bool:
    return path.prescription.name == "camera"


def _half_diagonal(path: PlacedPath) -> float:
    """On the specimen."""
    image = path.prescription.image
    return float(np.hypot(image.width, image.height) / 2 / abs(paraxial(path.prescription).magnification))


def _diagonal(path: PlacedPath, radii: np.ndarray) -> np.ndarray:
    """Field points (n, 2) on the image's diagonal."""
    image = path.prescription.image
    return np.outer(radii, [image.width, image.height]) / np.hypot(image.width, image.height)
