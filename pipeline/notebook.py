"""How the pipeline's results show themselves in a notebook: `_repr_html_` of each."""

from typing import TYPE_CHECKING

import numpy as np

from greenough.instrument.notebook import Picture, card, map_picture, share, span, table, to_picture

if TYPE_CHECKING:
    from .calibration import Calibration
    from .compare import Comparison
    from .decode import PhaseMap
    from .fringes import FringeSet
    from .point_cloud import PointCloud
    from .reconstruct import PointMap

_SAMPLE = 20_000  # points that medians of uncertainties are found from
_BINS = 240  # at most, along each axis of a cloud's map
_POINTS_PER_BIN = 4
_UNITS = {"um": "µm", "mm": "mm", "px": "px", "rad": "rad", "deg": "°"}  # at the ends of names
_MOST_COLUMNS = 4096  # of a strip of patterns


def fringe_set_html(fringes: "FringeSet") -> str:
    """Every pattern as a strip, from the first to the last."""
    from matplotlib.figure import Figure

    cols = min(int(fringes.field or fringes.periods[0]), _MOST_COLUMNS)
    strips = fringes.patterns(1, cols)[:, 0]  # (frames, cols)
    figure = Figure(figsize=(5.2, min(0.6 + 0.13 * len(strips), 6.0)), layout="constrained")
    axes = figure.subplots()
    axes.imshow(strips, cmap="gray", aspect="auto", interpolation="nearest", vmin=0, vmax=255)
    for part in fringes.slices[:-1]:
        axes.axhline(part.stop - 0.5, color="tab:orange", linewidth=1)
    axes.set_xlabel("projector column, px")
    axes.set_ylabel("frame")
    facts = {
        "frames": fringes.frame_count,
        "periods, px": fringes.periods,
        "steps": fringes.steps,
        "field, px": "spanned by the first period" if fringes.field is None else fringes.field,
        "first phase, rad": fringes.start,
        "sign of the steps": fringes.sign,
    }
    return card("FringeSet", facts, [to_picture(figure, "the patterns, one strip each")])


def phase_map_html(phase_map: "PhaseMap") -> str:
    """Maps of absolute phase and modulation."""
    valid = phase_map.valid
    facts = {
        "rows x columns": " x ".join(str(size) for size in valid.shape),
        "valid pixels": share(int(valid.sum()), valid.size),
        "absolute phase, rad": span(phase_map.absolute[valid]),
        "median modulation where valid, DN": _median(phase_map.modulation[valid]),
        "median background where valid, DN": _median(phase_map.background[valid]),
        "median standard deviation of the phase, mrad": 1e3 * _median(phase_map.sigma[valid]),
        "median size of the fringe order's residual, rad": _median(np.abs(phase_map.residual[valid])),
    }
    pictures = [
        map_picture(phase_map.absolute, "absolute phase, rad"),
        map_picture(phase_map.modulation, "modulation, DN", "gray"),
    ]
    return card("PhaseMap", facts, pictures)


def point_map_html(point_map: "PointMap") -> str:
    """Map of heights, with ranges and uncertainties."""
    valid, xyz = point_map.valid, point_map.xyz
    facts: dict[str, object] = {
        "rows x columns": " x ".join(str(size) for size in valid.shape),
        "points": share(int(valid.sum()), valid.size),
        **{f"{axis}, mm": span(xyz[..., k][valid]) for k, axis in enumerate("xyz")},
    }
    if point_map.noise_mm is not None:
        facts["median standard uncertainty of z by noise, µm"] = 1e3 * _median(np.abs(point_map.noise_mm[valid][:, 2]))
    if point_map.uncertainty is not None:
        v, u = np.nonzero(valid)
        sample = np.s_[:: max(1, len(v) // _SAMPLE)]
        pixels = np.stack([u[sample], v[sample]], axis=-1)
        variance = point_map.uncertainty.covariance(pixels, xyz[v[sample], u[sample], 2])[:, 2, 2]
        facts["median standard uncertainty of z by calibration, µm"] = 1e3 * _median(np.sqrt(variance))
    return card("PointMap", facts, [map_picture(xyz[..., 2], "z, mm")])


def point_cloud_html(cloud: "PointCloud") -> str:
    """Heights over x and y, ranges, and what the file's header says."""
    finite = cloud.xyz[np.isfinite(cloud.xyz).all(axis=-1)]
    facts: dict[str, object] = {
        "points": len(cloud.xyz),
        **{f"{axis}, mm": span(cloud.xyz[:, k]) for k, axis in enumerate("xyz")},
    }
    for cause, sd in (("noise", cloud.noise_mm), ("calibration", cloud.calibration_mm)):
        if sd is not None:
            facts[f"median standard uncertainty of z by {cause}, µm"] = 1e3 * _median(sd[:, 2])
    if cloud.smooth is not None:
        facts["points on smooth surface"] = share(int(cloud.smooth.sum()), len(cloud.smooth))
    facts |= {f"it says: {name}": value for name, value in cloud.facts.items()}
    return card("PointCloud", facts, [_binned_heights(finite)] if len(finite) else [])


def calibration_html(calibration: "Calibration") -> str:
    """Whose it is, how well its own data fit, and what is left of the spots' centres."""
    from matplotlib.figure import Figure

    identity, procedure = calibration.identity, calibration.procedure
    facts = {
        "method": calibration.method,
        "rig": identity.name,
        "camera": identity.camera_serial,
        "projector": identity.projector_serial,
        "run": calibration.run,
        "exposures": calibration.exposures,
        "camera's rows x columns": " x ".join(str(size) for size in calibration.camera.shape),
        "fringe periods, px": procedure.periods_px,
        "steps": procedure.steps,
        "board's pitch, mm": calibration.board.pitch_mm,
        **{_with_unit(name): value for name, value in calibration.figures.items() if name != "method"},
    }
    left = calibration.residuals.spots_px.reshape(-1, 2)
    left = left[np.isfinite(left).all(axis=-1)]
    if not len(left):
        return card("Calibration", facts)
    figure = Figure(figsize=(3.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(*left.T, ".", markersize=2)
    axes.axhline(0, color="0.5", linewidth=0.5)
    axes.axvline(0, color="0.5", linewidth=0.5)
    axes.locator_params(nbins=4)
    axes.set_aspect("equal", "datalim")
    axes.set_xlabel("reprojection error of spots in u, px")
    axes.set_ylabel("in v, px")
    return card("Calibration", facts, [to_picture(figure, "reprojection errors of the spots")])


def comparison_html(comparison: "Comparison") -> str:
    """The rows of errors, and the motion if there was one."""
    header = ("quantity", "points", "n", "bias, µm", "rms, µm", "95 % of sizes, µm", "largest, µm")
    rows = [
        (row.quantity.replace("_", " "), row.points, row.n, row.bias_um, row.rmse_um, row.p95_um, row.max_um)
        for row in comparison.rows
    ]
    facts: dict[str, object] = {"alignment": comparison.alignment, "points": comparison.points}
    if comparison.valid_share is not None:
        facts["of those lit and seen"] = f"{comparison.valid_share:.1%}"
    if comparison.alignment != "none":
        shift = ", ".join(f"{value:.5g}" for value in comparison.transform[:3, 3])
        facts["shift of the origin, mm"] = shift
        facts["scale"] = f"{np.cbrt(np.linalg.det(comparison.transform[:3, :3])):.7g}"
    return card("Comparison", facts) + table(rows, header)


def _binned_heights(xyz: np.ndarray) -> Picture:
    """Mean z of points (n, 3) over a grid of x and y."""
    bins = int(np.clip(np.sqrt(len(xyz) / _POINTS_PER_BIN), 1, _BINS))
    x, y, z = xyz.T
    count, y_edges, x_edges = np.histogram2d(y, x, bins)
    total, _, _ = np.histogram2d(y, x, bins, weights=z)
    with np.errstate(invalid="ignore"):
        heights = total / count
    extent = (x_edges[0], x_edges[-1], y_edges[0], y_edges[-1])
    return map_picture(heights[::-1], "z, mm", extent=extent, axes_labels=("x, mm", "y, mm"))


def _with_unit(name: str) -> str:
    """The name of a figure in words, with its unit behind a comma."""
    words, _, last = name.replace("_", " ").rpartition(" ")
    return f"{words}, {_UNITS[last]}" if words and last in _UNITS else name.replace("_", " ")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else float("nan")
