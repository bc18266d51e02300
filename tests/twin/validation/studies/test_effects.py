"""The study ablation: every effect is there, is switched off, and is felt without the others."""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.twin.rig import fringe_patterns
from greenough.twin.settings import TwinSettings
from greenough.twin.validation.studies.ablation import ALL, NONE, alone, without
from greenough.twin.validation.studies.runs import runs_of
from greenough.twin.validation.studies.study_file import load_study

TINY = ("camera.rows=30", "camera.cols=40", "twin.optics.camera_focal_px=708.84", "twin.render.nodes_edges=16")
STUDY = load_study("ablation")
EFFECTS, CASES = STUDY.effects, STUDY.all_cases
GLASS = "lenses of glass"


def alone_with(name: str) -> tuple[str, ...]:
    return CASES[alone(name, EFFECTS[name])]


def frames(case: tuple[str, ...], *more: str, run: str = "test", sample: str = "board") -> np.ndarray:
    """Two frames of a part, after drifts have had time, away from the stage's zero: (2, rows, cols)."""
    settings = [*TINY, "twin.optics.glass=true", *case, *more]
    rig, _ = gt.open("twin", settings, run=run, exposures_done=1000)
    rig.operator.place(Placement(sample))
    rig.stage.move_to_mm(0.3)
    rig.camera.exposure_us = 40_000
    return rig.capture(fringe_patterns(rig)[-2:]).stack


@pytest.fixture(scope="module")
def undisturbed() -> dict[str | None, np.ndarray]:
    """Frames of the twins to which one effect is added, by the effect that they have already."""
    return {None: frames(CASES[NONE]), GLASS: frames(alone_with(GLASS))}


def test_every_effect_is_off_and_alone_once():
    assert len(CASES) == 2 + 2 * len(EFFECTS)
    for name, effect in EFFECTS.items():
        kept = {*effect.off, *(EFFECTS[effect.within].off if effect.within else ())}
        assert CASES[without(name)] == effect.off
        assert set(alone_with(name)) == set(CASES[NONE]) - kept
    assert CASES[ALL] == ()


def test_all_cases_share_one_noise_and_everything_is_repeated_with_others():
    runs = runs_of(STUDY)
    assert {run.name for run in runs if run.repeat == 1} == {STUDY.name}
    repeated = [run for run in runs if run.repeat > 1]
    assert {run.case for run in repeated} == {ALL}
    assert len({run.name for run in repeated} | {STUDY.name}) == STUDY.repeats[ALL] == 4


def test_no_size_of_an_effect_is_forgotten():
    """Sizes of the physics table live in these sections; what is not an error of planes is named here."""
    layout = {"na", "wavelength_um", "convergence_deg", "pupil_distance_mm", "camera_focal_px", "gamma"}
    layout |= {"column_pitch_um", "row_pitch_um", "white_photons_per_ms", "quantum_efficiency"}
    switched = {setting.split("=")[0] for effect in EFFECTS.values() for setting in effect.off}
    for section in ("optics", "assembly", "light", "camera", "stage", "stability", "board"):
        sizes = {f"twin.{section}.{name}" for name in type(getattr(TwinSettings(), section)).model_fields}
        assert sizes - {f"twin.{section}.{name}" for name in layout} <= switched


@pytest.mark.parametrize("name", EFFECTS)
def test_each_effect_is_felt_alone(name, undisturbed):
    assert not np.array_equal(frames(alone_with(name)), undisturbed[EFFECTS[name].within])


def test_nothing_is_left_without_the_effects(undisturbed):
    """Exposures of different runs are the same to the last bit, and instruments of different seeds see the same."""
    still = undisturbed[None]
    assert still.dtype == np.float32
    np.testing.assert_array_equal(frames(CASES[NONE], run="another"), still)
    ours, others = (frames(CASES[NONE], f"twin.seed={seed}", sample="plane") for seed in (1, 2))
    inside = slice(None), slice(8, -8), slice(12, -12)  # its rim lies as a hand left it
    assert ours[inside].min() > 4.5
    np.testing.assert_allclose(ours[inside], others[inside], atol=0.005)  # single precision's of 100 DN


@pytest.mark.slow
def test_cases_of_a_run_share_the_noise_that_both_have():
    """Read noise is the same with and without shot noise, and none of it hangs on what is measured."""
    off = [effect.off for name, effect in EFFECTS.items() if name not in ("shot noise", "read noise")]
    both = tuple(setting for settings in off for setting in settings)
    read = frames(alone_with("read noise")) - frames(CASES[NONE])
    assert read.std() > 0.1
    np.testing.assert_allclose(frames(both) - frames(alone_with("shot noise")), read, atol=1e-4)
    still = frames(CASES[NONE], sample="plane")
    np.testing.assert_allclose(frames(alone_with("read noise"), sample="plane") - still, read, atol=1e-4)
