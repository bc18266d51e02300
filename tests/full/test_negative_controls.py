"""Errors that are planted turn the rows about them red, and without the error these are green: six calibrations."""

from greenough.twin.validation.negative_controls import negative_controls

COARSE = (
    "camera.rows=480", "camera.cols=640", "twin.optics.camera_focal_px=11341.5",
    "procedure.planes=10", "procedure.plane_step_mm=0.3",
)  # fmt: skip


def test_every_planted_error_turns_its_rows_red(figure):
    found = negative_controls("twin", COARSE, "negative controls", lambda steps: None)
    for finding in found:
        for what, value in (("sound", finding.sound), ("planted", finding.planted), ("predicted", finding.predicted)):
            figure(f"{finding.control}, {finding.row}, {what}", value, finding.limit, finding.unit)
    assert [finding for finding in found if not finding.as_expected] == []
