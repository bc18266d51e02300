"""Names of rows in words, for readers: ``cap15_p95_deconvolved`` is "caps up to 15°, 95 % of the errors, deconvolved".

Names are what scripts rely on; a name that is not known here is shown with spaces for its underscores.
"""

import re

_ENDINGS = {
    "_deconvolved_filtered": "deconvolved and filtered",
    "_deconvolved": "deconvolved",
    "_two_exposures": "mean of two exposures",
    "_filtered": "filtered",
    "_raw": "one exposure",
    "_all_spots": "all spots",
}

_FIGURES = {
    "bias": "mean error",
    "rmse": "RMS error",
    "p95": "95 % of the errors",
    "p99": "99 % of the errors",
    "rms": "RMS error",
    "sd": "standard deviation",
    "mean": "mean",
    "valid_share": "share of valid points",
    "error_mean": "mean error",
    "error_sd": "standard deviation of the errors",
}

_WHOLE = {
    "reprojection_rmse_u": "reprojection error in u, RMS",
    "reprojection_rmse_v": "reprojection error in v, RMS",
    "plane_rmse": "plane, RMS departure",
    "plane_noise_ratio": "plane, RMS departure over its prediction",
    "plane_within_5um": "plane, share of departures within 5 µm",
    "plane_line_noise": "plane, 95 % of the departures along one row",
    "plane_structure": "plane, structure beyond white noise",
    "plane_structure_common": "plane, structure that two exposures share",
    "depth_p95_volume": "depth, 95 % of the errors over the volume",
    "depth_tilted_p95": "depth, 95 % of the errors of tilted planes",
    "depth_origin": "depth, mean error over all planes",
    "volume_x": "length measured at all heights",
    "volume_y": "width measured at all heights",
    "z_range": "height between the outermost planes",
    "step_2500um": "error of a step of 2.5 mm",
    "stages_within_4um": "share of other stages that keep 4 µm",
    "stages_median_p95": "median over other stages of 95 % of the depth errors",
    "ball_apex_within_tolerance": "largest error of an apex height",
    "coplanarity_error": "error of the coplanarity by the seating plane",
    "coplanarity_regression_error": "error of the coplanarity by the regression plane",
}

_SUBJECTS = {
    "depth_systematic": "systematic depth error",
    "depth_tilted_systematic": "systematic depth error of tilted planes",
    "pitch_second_board": "circle distance on a board unseen before",
    "pitch": "circle distance",
    "ball_apex": "apex heights",
    "ball_diameter": "ball diameters",
    "cap15": "caps up to 15°",
    "cap45": "caps up to 45°",
    "substrate": "substrate",
}


def in_words(name: str) -> str:
    """A row's name in words."""
    base, treatment = name, ""
    for ending, said in _ENDINGS.items():
        if name.endswith(ending):
            base, treatment = name.removesuffix(ending), f", {said}"
            break
    if base in _WHOLE:
        return _WHOLE[base] + treatment
    if base in _FIGURES:
        return _FIGURES[base] + treatment
    if found := re.fullmatch(r"depth_bias_at_([+-][0-9.]+)mm", base):
        return f"mean depth error where the stage reads {found[1].replace('-', '−')} mm"
    for subject, said in _SUBJECTS.items():
        figure = _FIGURES.get(base.removeprefix(f"{subject}_")) if base.startswith(f"{subject}_") else None
        if figure is not None:
            return f"{said}, {figure}{treatment}"
    return re.sub(r"\b95\b", "95 %", base.replace("_", " ")) + treatment
