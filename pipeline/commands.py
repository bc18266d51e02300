"""The verbs of the pipeline: calibrate, measure, compare, export, decode, diagnose, report."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from greenough.instrument.errors import InputError
from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, RigArgument, RunOption, SetOption, output_file, show

from .decode_command import app as decode_app
from .diagnose_command import app as diagnose_app
from .method import Method
from .report_command import ReportOption
from .report_command import app as report_app

if TYPE_CHECKING:
    from greenough.instrument.contract import Placement

app = typer.Typer()
app.add_typer(decode_app)
app.add_typer(diagnose_app)
app.add_typer(report_app)


@app.command()
def calibrate(
    rig: RigArgument,
    out: Annotated[
        Path, typer.Option("--out", metavar="CAL.h5", help="The calibration to write.", callback=output_file)
    ],
    method: Annotated[
        Method,
        typer.Option(
            "--method",
            help="paper: trust the stage, fit every pixel; bundle: trust the board, fit one model to postures and "
            "planes; stage-free: the same model, postures alone; triangulation: pinholes, postures alone.",
        ),
    ] = "bundle",
    run: RunOption = "calibrate",
    report: ReportOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a rig by a board of spots and by planes.

    It captures the board in its postures, then, for paper and bundle, its blank side at every plane height.

    An interrupted calibration goes on from the last finished posture or plane when the same command is given again.
    """
    from greenough.instrument.opening import open_rig

    from . import acquisition
    from .unfinished import Unfinished

    exposures_done = Unfinished.beside(out).exposures
    with open_rig(rig, settings or (), run=run, exposures_done=exposures_done) as opened:
        steps = acquisition.calibration_steps(opened.procedure, [method])
        with progress(steps, "calibrating", quiet=as_json) as advance:
            calibration = acquisition.calibrate(opened, out, run, advance, method)
    if report is not None:
        from .report.page import write_page
        from .report.results import calibration_page

        write_page(report, calibration_page(out.name, calibration, for_papers=False))
    summary = {"calibration": out, "rig": calibration.identity.name, "run": run, "method": calibration.method}
    show({**summary, **calibration.figures}, as_json)


@app.command()
def measure(
    rig: RigArgument,
    sample: Annotated[str, typer.Option("--sample", metavar="NAME|MESHFILE", help="The part to lay under the lenses.")],
    calibration: Annotated[
        Path | None, typer.Option("--calibration", metavar="CAL.h5", help="Of `greenough calibrate`.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="CLOUD.ply", help="The point cloud to write.", callback=output_file),
    ] = None,
    preview: Annotated[
        Path | None,
        typer.Option(
            "--preview",
            metavar="PICTURE.png",
            help="Measure nothing: draw what the camera sees, and mark what is saturated or too dark. Needs neither "
            "--calibration nor --out.",
            callback=output_file,
        ),
    ] = None,
    unit: Annotated[str, typer.Option("--unit", help="Unit of a mesh file: mm, um, m or inch.")] = "mm",
    material: Annotated[
        str | None, typer.Option("--material", help="Of a mesh file, as the twin's are called. [default: matte]")
    ] = None,
    pose: Annotated[
        str, typer.Option("--pose", metavar="X,Y,Z,A,B,C", help="Where the sample lies: mm and degrees about x, y, z.")
    ] = "0,0,0,0,0,0",
    bracket: Annotated[
        bool, typer.Option("--bracket", help="Merge the exposures of procedure.brackets, for shiny parts.")
    ] = False,
    filter_fwhm_px: Annotated[
        float | None, typer.Option("--filter-fwhm-px", help="Plane under a Gaussian on the phasors. [default: none]")
    ] = None,
    deconvolve: Annotated[
        bool, typer.Option("--deconvolve", help="Undo the drag of blur towards brighter neighbours: metal, solder.")
    ] = False,
    run: Annotated[
        str | None, typer.Option("--run", metavar="NAME", help="Name of the run. [default: measure-SAMPLE]")
    ] = None,
    report: ReportOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure a part and write its points in the calibrated frame.

    The same command with --preview looks at the part first, in a few frames.
    """
    import numpy as np

    from greenough.instrument.contract import Placement
    from greenough.instrument.opening import open_rig

    from . import acquisition
    from .calibration import Calibration
    from .point_cloud import PointCloud, write_cloud

    placement = Placement(sample, unit=unit, pose_mm_deg=_pose(pose), material=material)
    if preview is not None:
        run = run or f"preview-{Path(sample).stem}"
        _look(rig, settings, run, placement, bracket, preview, as_json)
        return
    if calibration is None or out is None:
        raise InputError("measuring needs --calibration and --out; --preview looks at the part without")
    loaded = Calibration.load(calibration)
    run = run or f"measure-{Path(sample).stem}"
    with (
        open_rig(rig, settings or (), run=run) as opened,
        progress(1, f"measuring {sample}", quiet=as_json) as advance,
    ):
        brackets = opened.procedure.brackets if bracket else (1.0,)
        points = acquisition.measure(opened, loaded, placement, brackets, filter_fwhm_px, deconvolve)
        taken = acquisition.possible_brackets(opened, brackets) if bracket else brackets
        advance(1)
    filtered = f"plane under a gaussian on phasors, fwhm {filter_fwhm_px or 0:g} px"
    facts = {
        "unit": "mm",
        "sample": sample,
        "rig": loaded.identity.name,
        "run": run,
        "calibration": loaded.method,
        "calibration_run": loaded.run,
        "brackets": " ".join(f"{ratio:g}" for ratio in taken),
        "deconvolved": "yes" if deconvolve else "no",
        "filter": "none" if filter_fwhm_px is None else filtered,
    }
    if material is not None:
        facts["material"] = material
    cloud = PointCloud.from_point_map(points, facts=facts)
    if len(cloud.xyz) == 0:
        raise InputError(f"no point of {sample} could be measured: check that it lies in the light and in the z range")
    write_cloud(out, cloud)
    if report is not None:
        from .report.page import write_page
        from .report.results import cloud_page

        write_page(report, cloud_page(out.name, cloud, None, for_papers=False))
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    sigma_um = {
        f"sigma_{cause}_um": 1e3 * np.median(sd, axis=0)
        for cause, sd in (("noise", cloud.noise_mm), ("calibration", cloud.calibration_mm))
        if sd is not None
    }
    show({"cloud": out, "points": len(cloud.xyz), "low_mm": low, "high_mm": high, **sigma_um, **facts}, as_json)


@app.command()
def compare(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="Measured points: PLY.")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="What they should lie on: PLY, STL or OBJ, in mm.")],
    align: Annotated[
        Literal["none", "rigid", "similarity"] | None,
        typer.Option("--align", help="Motion of the points before comparing. [default: none, with all side by side]"),
    ] = None,
    tolerance_um: Annotated[
        float | None,
        typer.Option("--tolerance-um", help="Exit with 1 if 95 % of the vertical errors do not stay within this."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare measured points with a mesh.

    Distances are taken along the normal and vertically. Without --align the points stay as they are, and all three
    alignments are shown beside each other as well.
    """
    from .compare import ALIGNMENTS
    from .compare import compare as compare_cloud
    from .point_cloud import read_cloud, read_mesh

    if tolerance_um is not None and not tolerance_um > 0:
        raise InputError(f"--tolerance-um is {tolerance_um:g}: it must be above 0")
    alignments = ALIGNMENTS if align is None else (align,)
    points, surface = read_cloud(cloud), read_mesh(mesh)
    results = []
    with progress(len(alignments), "comparing", quiet=as_json) as advance:
        for alignment in alignments:
            results.append(compare_cloud(points, surface, alignment))
            advance(1)
    result = results[0]
    summary = {
        "cloud": cloud,
        "mesh": mesh,
        "points": result.points,
        "valid_share": result.valid_share,
        "alignment": result.alignment,
        "rows": [asdict(row) for row in result.rows],
    }
    if align is None:
        beside = [{"alignment": each.alignment} | asdict(row) for each in results for row in each.rows]
        summary["side_by_side"] = beside
    if tolerance_um is None:
        show(summary, as_json)
        return
    holds = result.within(tolerance_um)
    show({**summary, "tolerance_um": tolerance_um, "within_tolerance": holds}, as_json)
    if not holds:
        raise typer.Exit(1)


@app.command()
def export(
    source: Annotated[
        Path, typer.Argument(metavar="CLOUD|CAL.h5", help="Measured points, PLY, or a calibration, for its camera.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Its ending says what. Points: .ply, .xyz, .asc, .npz; surface: .stl, .obj; height map: .x3p, .gwy, "
            ".gsf; camera: .yaml, .json, .xml.",
            callback=output_file,
        ),
    ],
    pitch_um: Annotated[
        float | None,
        typer.Option("--pitch-um", help="From node to node of a height map. [default: as far as pixels are apart]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write points or a camera for programs of others.

    Points and surfaces are in mm, height maps in m. A surface has triangles between neighbouring pixels and is open
    where nothing was measured. A height map is linear inside these triangles and void elsewhere.
    """
    from .export import CAMERA_ENDINGS, export_cloud
    from .point_cloud import read_cloud

    if out.suffix.lower() in CAMERA_ENDINGS:
        from .calibration import Calibration
        from .camera_file import write_camera

        if pitch_um is not None:
            raise InputError("--pitch-um is for height maps: a camera has none")
        camera = write_camera(Calibration.load(source), out)
        off = {"fit_rms_px": camera.rms_px, "fit_max_px": camera.max_px}
        show({"file": out, "unit": "px, mm", **off, "bytes": out.stat().st_size}, as_json)
        return
    points = read_cloud(source)
    written = export_cloud(points, out, None if pitch_um is None else 1e-3 * pitch_um)
    show({"file": out, "points": len(points.xyz), **written, "bytes": out.stat().st_size}, as_json)


def _look(
    rig: str,
    settings: list[str] | None,
    run: str,
    placement: "Placement",
    bracket: bool,
    picture: Path,
    as_json: bool,
) -> None:
    """`measure --preview`."""
    from greenough.instrument.opening import open_rig

    from .fringes import FringeSet
    from .preview import preview, write_preview

    if picture.suffix.lower() != ".png":
        raise InputError(f"--preview {picture}: the name must end in .png")
    with (
        open_rig(rig, settings or (), run=run) as opened,
        progress(1, f"looking at {placement.part}", quiet=as_json) as advance,
    ):
        procedure = opened.procedure
        fringes = FringeSet.of(procedure)
        seen = preview(opened, placement, fringes, procedure.brackets if bracket else (1.0,))
        name = opened.identity.name
        advance(1)
    write_preview(picture, seen, f"{placement.part} at {name}")
    shares = {
        "measurable_share": seen.measurable.mean(),
        "saturated_share": seen.saturated.mean(),
        "weak_share": seen.weak.mean(),
    }
    facts = {"sample": placement.part, "rig": name, "run": run, "exposure_us": seen.exposure_us}
    show({"picture": picture, **shares, **facts}, as_json)


def _pose(text: str) -> tuple[float, float, float, float, float, float]:
    try:
        x, y, z, a, b, c = (float(item) for item in text.split(","))
    except ValueError:
        raise InputError(f"--pose {text}: give six numbers, x,y,z in mm and three angles in degrees") from None
    return x, y, z, a, b, c
