"""Claims about the section [twin] of a rig file."""

import pytest

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import load_rig_file
from greenough.twin.settings import TwinSettings, twin_settings


def settings(*overrides: str) -> TwinSettings:
    return twin_settings(load_rig_file("twin", overrides))


def refusal(*overrides: str) -> str:
    with pytest.raises(InputError) as refused:
        settings(*overrides)
    sentence = str(refused.value)
    assert not sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


def test_an_empty_section_is_the_default_instrument():
    rig_file = load_rig_file("twin").model_copy(update={"__pydantic_extra__": {}})
    assert twin_settings(rig_file) == TwinSettings()


def test_overrides_reach_every_depth():
    changed = settings("twin.seed=7", "twin.stage.position_sd_um=10", "twin.optics.finite_aperture=false")
    assert changed.seed == 7
    assert changed.stage.position_sd_um == 10
    assert not changed.optics.finite_aperture
    assert changed.board == TwinSettings().board


@pytest.mark.parametrize(
    "effect",
    [
        "camera.read_noise_e",
        "camera.prnu",
        "camera.dsnu_e",
        "stage.position_sd_um",
        "stage.straightness_sd_um",
        "stage.pitch_roll_sd_urad",
        "stage.axis_sd_deg",
        "board.print_sd_um",
        "board.scale_sd_ppm",
        "board.bow_sd_um",
        "board.wedge_sd_urad",
        "board.ink_thickness_um",
        "optics.off_state",
    ],
)
def test_every_effect_can_be_switched_off_and_none_is_negative(effect):
    section, _, field = effect.partition(".")
    assert getattr(getattr(settings(f"twin.{effect}=0"), section), field) == 0
    assert effect in refusal(f"twin.{effect}=-1")


@pytest.mark.parametrize(
    ("override", "field", "allowed"),
    [
        ("twin.optics.na=0.5", "optics.na", "0.019"),
        ("twin.optics.na=0", "optics.na", "0"),
        ("twin.optics.wavelength_um=525", "optics.wavelength_um", "2"),
        ("twin.optics.camera_focal_px=1", "optics.camera_focal_px", "100"),
        ("twin.stage.axis_sd_deg=90", "stage.axis_sd_deg", "5"),
        ("twin.render.nodes=48", "render.nodes", "power of two"),
        ("twin.render.nodes=1", "render.nodes", "2"),
        ("twin.render.bounces=0", "render.bounces", "1"),
        ("twin.seed=-1", "seed", "0"),
        ("twin.seed=1.5", "seed", "whole number"),
        ('twin.camera.prnu="much"', "camera.prnu", "number"),
        ('twin.camera.prnu="0.01"', "camera.prnu", "number"),
        ('twin.camera.shot_noise="perhaps"', "camera.shot_noise", "true"),
        ("twin.light.white_photons_per_ms=nan", "light.white_photons_per_ms", "number"),
        ("twin.camera.quantum_efficiency=1.1", "camera.quantum_efficiency", "1"),
        ("twin.optics.gamma=0", "optics.gamma", "0.2"),
        ("twin.optics.na=0.01", "na", "twin.optics.glass=false"),
        ("twin.optics.pupil_distance_mm=200", "pupil_distance_mm", "twin.optics.glass=false"),
    ],
)
def test_a_wrong_field_is_named_with_what_is_allowed(override, field, allowed):
    sentence = refusal(override)
    assert field in sentence
    assert allowed in sentence.replace(override, "")
    assert "section [twin]" in sentence


def test_all_wrong_fields_are_named_at_once():
    sentence = refusal("twin.optics.na=9", "twin.camera.prnu=9", "twin.stage.position_sd_um=-3")
    for field in ("optics.na", "camera.prnu", "stage.position_sd_um"):
        assert field in sentence


def test_an_unknown_field_is_named_with_the_nearest_known():
    sentence = refusal("twin.stage.position_sd=3")
    assert "stage.position_sd," in sentence
    assert "stage.position_sd_um" in sentence


def test_a_board_of_dark_spots_is_refused_and_not_printed_white():
    assert "leave board.dark_spots out" in refusal("board.dark_spots=true")
