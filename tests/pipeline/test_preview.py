"""A look at a part before it is measured, against what decoding makes of all frames."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from greenough.instrument import opening
from greenough.instrument.command import run
from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.pipeline import commands
from greenough.pipeline.acquisition import capture_part
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import PAPER, FringeSet
from greenough.pipeline.preview import preview, write_preview
from plain_rig import PlainRig, scene

BOARD, PLANE = Placement("board"), Placement("plane")


class Source:
    """Stands for the installed entry point."""

    name, value, module = "pipeline", "greenough.pipeline.commands:app", "greenough.pipeline.commands"

    @staticmethod
    def load():
        return commands.app


def greenough(*arguments):
    return run([str(argument) for argument in arguments], [Source])


class GlintingRig(PlainRig):
    """A PlainRig with a glint that clips in every exposure and a shadow that nothing reaches."""

    glint, shadow = np.s_[100:120, 200:230], np.s_[200:230, 150:250]

    def capture(self, patterns):
        frames = super().capture(patterns)
        stack = frames.stack.copy()
        stack[:, *self.glint] = 255
        stack[:, *self.shadow] = 4 + (frames.serials % 2)[:, None, None]
        return replace(frames, stack=stack)


@pytest.mark.parametrize("placement", [BOARD, PLANE])
@pytest.mark.parametrize("fringes", [PAPER, FringeSet((70, 64, 59), (4, 4, 4), field=608)])
def test_what_is_called_measurable_is_what_decoding_calls_valid(placement, fringes):
    seen = preview(PlainRig(), placement, fringes)
    frames, noise = capture_part(PlainRig(), placement, fringes.patterns(2, 608))
    valid = decode(frames, fringes, noise).valid
    # Within a period of the field's ends noise may leave it open at which of them a dark pixel is.
    _, column = scene(placement, False, 0.0)
    inside = ((column > 12) & (column < 595)) | (column < 0) | (column > 608)
    assert 0.3 < valid.mean() < 0.99
    assert (seen.measurable & ~valid)[inside].mean() < 1e-3
    assert (valid & ~seen.measurable)[inside].mean() < 0.02


def test_the_limit_of_what_is_too_faint_is_that_of_decoding():
    class Fading(PlainRig):
        """From dark on the left to little light on the right."""

        def capture(self, patterns):
            frames = super().capture(patterns)
            fading = 4 + (frames.stack - 4.0) * np.linspace(0, 0.06, frames.stack.shape[2])
            return replace(frames, stack=np.rint(fading).astype(np.uint8))

    rig = Fading()
    rig.camera.exposure_limits_us = (20_000.0, 20_000.0)  # of which one makes the whole part grey
    rig.camera.exposure_us = 20_000.0
    seen = preview(rig, PLANE, PAPER)
    frames, noise = capture_part(rig, PLANE, PAPER.patterns(2, 608))
    valid = decode(frames, PAPER, noise).valid
    assert 0.2 < valid.mean() < 0.5
    assert seen.measurable.mean() == pytest.approx(valid.mean(), abs=0.01)


def test_glints_and_shadows_are_told_apart():
    rig = GlintingRig()
    seen = preview(rig, PLANE, PAPER)
    assert seen.saturated[rig.glint].all()
    assert seen.saturated.sum() == seen.saturated[rig.glint].size
    assert seen.weak[rig.shadow].all()
    np.testing.assert_array_equal(seen.measurable, ~seen.saturated & ~seen.weak)


def test_shorter_exposures_take_in_what_saturates():
    class Shiny(PlainRig):
        """Of which a hundredth reflects three times as much as the rest, as the exposure says."""

        shiny = np.s_[100:120, 200:230]

        def capture(self, patterns):
            frames = super().capture(patterns)
            stack = frames.stack.copy()
            stack[:, *self.shiny] = np.clip(4 + 3 * (stack[:, *self.shiny].astype(float) - 4), 0, 255)
            return replace(frames, stack=stack)

    one, both = (preview(Shiny(), PLANE, PAPER, brackets) for brackets in ((1.0,), (1.0, 0.25)))
    assert one.saturated[Shiny.shiny].mean() > 0.9
    assert both.saturated.sum() == 0
    assert both.measurable[Shiny.shiny].all()


def test_it_takes_five_frames_beside_those_of_the_exposure():
    counts = []

    class Counting(PlainRig):
        def capture(self, patterns):
            counts.append(len(patterns))
            return super().capture(patterns)

    preview(Counting(), PLANE, PAPER)
    assert counts[-1] == 5
    assert set(counts[:-1]) == {1}


def test_the_picture_marks_what_is_saturated_and_what_is_too_dark(tmp_path):
    rig = GlintingRig()
    seen = preview(rig, PLANE, PAPER)
    write_preview(tmp_path / "plane.png", seen, "a $plane_{<")
    picture = np.asarray(Image.open(tmp_path / "plane.png").convert("RGB")).astype(int)
    left = picture[:, : picture.shape[1] // 2]
    red = (left[..., 0] > 180) & (left[..., 1] < 80)
    blue = (left[..., 2] > left[..., 0] + 60) & (left[..., 2] > left[..., 1] + 40)
    per_pixel = (left.shape[1] * 0.85 / seen.light.shape[1]) ** 2  # the axes fill most of their half
    assert 0.7 < red.sum() / (seen.saturated.sum() * per_pixel) < 2  # with the legend's patch
    assert 0.7 < blue.sum() / (seen.weak.sum() * per_pixel) < 1.5


def test_the_command_needs_no_calibration_and_writes_a_picture(tmp_path, monkeypatch, capsys):
    asked = {}

    def open_rig(name, overrides, **options):
        asked.update(name=name, **options)
        return PlainRig()

    monkeypatch.setattr(opening, "open_rig", open_rig)
    picture = tmp_path / "plane.png"
    assert greenough("measure", "bench", "--sample", "plane", "--preview", picture, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    with Image.open(picture) as drawn:
        assert drawn.format == "PNG"
    assert result["measurable_share"] + result["saturated_share"] + result["weak_share"] == pytest.approx(1)
    assert asked == {"name": "bench", "run": "preview-plane"}
    assert [file.name for file in tmp_path.iterdir()] == ["plane.png"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--preview", "plane.jpg"), "must end in .png"),
        (("--calibration", "cal.h5"), "needs --calibration and --out"),
        (("--out", "cloud.ply"), "needs --calibration and --out"),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused(tmp_path, monkeypatch, capsys, options, sentence):
    monkeypatch.chdir(tmp_path)
    assert greenough("measure", "twin", "--sample", "plane", *options) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_part_that_is_refused_leaves_no_picture(tmp_path, monkeypatch, capsys):
    class Refusing(PlainRig):
        """Knows no materials."""

        def _place(self, placement):
            raise InputError(f"no {placement.material} here")

    monkeypatch.setattr(opening, "open_rig", lambda *_, **__: Refusing())
    options = ("--sample", "part.stl", "--material", "cheese", "--preview", tmp_path / "part.png")
    assert greenough("measure", "bench", *options) == 2
    assert "no cheese here" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
