"""Claims about the twin behind the contract. Chance refuses a sound twin in one run out of a million per test."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import BaseModel
from scipy.stats import norm

import greenough.twin as gt
from greenough.instrument import open_rig
from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import builtin_rigs
from greenough.twin.light_sums import LARGEST_REST, RIM
from greenough.twin.plugins import FringeIntegrator
from greenough.twin.rig import BLANKING_US, TwinRig, fringe_patterns
from greenough.twin.settings import TwinSettings
from greenough.twin.stage import StageErrors
from greenough.twin.workbench import Workbench

FALSE_ALARM = 1e-6


def white(rig: TwinRig, n: int = 1) -> np.ndarray:
    return np.full((n, *rig.projector.shape), 255, np.uint8)


def refusal(action: Any, *arguments: Any) -> str:
    with pytest.raises(InputError) as refused:
        action(*arguments)
    sentence = str(refused.value)
    assert not sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


# Noise and repetition


def test_two_runs_with_the_same_seed_give_the_same_frames(small):
    stacks = []
    for _ in range(2):
        rig, _ = small()
        rig.operator.place(Placement("board", posture=2))
        rig.stage.move_to_mm(0.25)
        stacks.append(rig.capture(fringe_patterns(rig)).stack)
    assert_array_equal(stacks[0], stacks[1])
    assert stacks[0].dtype == np.uint8


def test_two_captures_of_one_scene_differ_in_their_noise_alone(small):
    rig, _ = small("camera.bits=0")
    rig.operator.place(Placement("plane"))
    first, second = rig.capture(white(rig)).stack, rig.capture(white(rig)).stack
    lit = rig.irradiance(white(rig))[0] > 0.2
    difference = (first - second)[0][lit]
    assert (difference != 0).mean() > 0.99
    level = first[0][lit] - rig.camera.black_level_dn
    expected = 2 * (level * rig.camera.noise.electrons_per_dn + 100) / rig.camera.noise.electrons_per_dn**2
    z = difference / np.sqrt(expected)
    assert abs(z.mean()) * np.sqrt(z.size) < norm.isf(FALSE_ALARM / 2)
    assert abs(z.var() - 1) * np.sqrt(z.size / 2) < norm.isf(FALSE_ALARM / 2)


def test_runs_of_different_names_share_no_noise(small):
    def noise(run: str, seed: int = 1) -> np.ndarray:
        """Six frames without their expectation, in its standard deviation: (frames, pixels)."""
        rig, _ = small("camera.bits=0", "twin.camera.prnu=0", "twin.camera.dsnu_e=0", f"twin.seed={seed}", run=run)
        rig.operator.place(Placement("plane"))
        stack = rig.capture(white(rig, 6)).stack.reshape(6, -1)
        quiet, _ = small(f"twin.seed={seed}", noiseless=True)
        quiet.operator.place(Placement("plane"))
        expected = quiet.capture(white(rig)).stack.reshape(1, -1)
        per_dn = rig.camera.noise.electrons_per_dn
        return (stack - expected) / np.sqrt((expected - rig.camera.black_level_dn) / per_dn + (10 / per_dn) ** 2)

    streams = np.concatenate([noise("calibrate"), noise("measure"), noise("calibrate2"), noise("calibrate", seed=2)])
    r = np.corrcoef(streams)[np.triu_indices(len(streams), 1)]
    assert np.abs(r).max() < norm.isf(FALSE_ALARM / 2 / r.size) / np.sqrt(streams.shape[1])
    assert np.corrcoef(noise("measure")[0], streams[6])[0, 1] == pytest.approx(1)


def test_a_resumed_run_goes_on_where_it_stopped(small):
    rig, _ = small()
    rig.operator.place(Placement("plane"))
    patterns = fringe_patterns(rig)[:6]
    whole = rig.capture(patterns)
    resumed, _ = small(exposures_done=4)
    resumed.operator.place(Placement("plane"))
    rest = resumed.capture(patterns[4:])
    assert_array_equal(rest.stack, whole.stack[4:])
    assert_array_equal(rest.serials, whole.serials[4:])


def test_a_sequence_sent_in_two_uploads_is_the_sequence(small):
    stacks = []
    for cuts in ([6], [2, 4]):
        rig, _ = small()
        rig.operator.place(Placement("plane"))
        patterns, frames = fringe_patterns(rig)[:6], []
        for n in cuts:
            frames.append(rig.capture(patterns[:n]).stack)
            patterns = patterns[n:]
        stacks.append(np.concatenate(frames))
    assert_array_equal(stacks[0], stacks[1])


# Frames


def test_frames_carry_what_the_camera_and_the_stage_reported(small):
    rig, _ = small(run="evening")
    rig.operator.place(Placement("plane"))
    rig.stage.move_to_mm(-0.7)
    rig.camera.exposure_us = 20_000.0
    first, second = rig.capture(white(rig, 3)), rig.capture(white(rig, 2))
    assert first.stack.shape == (3, *rig.camera.shape)
    assert (first.full_scale_dn, first.black_level_dn, first.run) == (255, 4, "evening")
    assert (first.exposure_us, first.stage_position_mm, first.gain_db) == (20_000, -0.7, 0)
    assert_array_equal(np.concatenate([first.serials, second.serials]), np.arange(5))
    times = np.concatenate([first.times_s, second.times_s])
    assert_allclose(np.diff(times), (20_000 + BLANKING_US) * 1e-6)


def test_grey_values_are_linear_in_light_and_exposure(small):
    rig, _ = small(noiseless=True)
    rig.operator.place(Placement("plane"))
    patterns = fringe_patterns(rig)[:3]
    irradiance = rig.irradiance(patterns)
    for exposure_us in (8333.0, 33_332.0):
        rig.camera.exposure_us = exposure_us
        # 75 electrons per ms from a white Lambertian surface, whose radiance is 1 / pi.
        electrons = irradiance * np.pi * 75 * exposure_us * 1e-3
        expected = rig.camera.black_level_dn + electrons / rig.camera.noise.electrons_per_dn
        assert_allclose(rig.capture(patterns).stack, expected, rtol=1e-5)


def test_float_frames_say_that_they_do_not_clip(small):
    rig, _ = small("camera.bits=0")
    rig.operator.place(Placement("plane"))
    rig.camera.exposure_us = 1e6
    frames = rig.capture(white(rig))
    assert frames.full_scale_dn == float("inf")
    assert frames.stack.max() > 255


@pytest.mark.slow
def test_what_is_mounted_and_where_is_what_is_seen(small):
    rig, _ = small(noiseless=True)
    patterns = fringe_patterns(rig)[-1:]
    pictures = {}
    for part in ("plane", "coin"):
        rig.operator.place(Placement(part))
        for z in (0.0, 0.5):
            rig.stage.move_to_mm(z)
            pictures[part, z] = rig.capture(patterns).stack
    again = pictures["plane", 0.0]
    rig.operator.place(Placement("plane"))
    rig.stage.move_to_mm(0.0)
    assert_array_equal(rig.capture(patterns).stack, again)
    for key, picture in pictures.items():
        assert key == ("plane", 0.0) or np.abs(picture - again).max() > 5
    assert np.abs(rig.capture(fringe_patterns(rig)[:1]).stack - again).max() > 5


def test_the_fringe_patterns_are_those_of_the_procedure(small):
    rig, _ = small()
    patterns = fringe_patterns(rig)
    assert patterns.shape == (24, 684, 608)
    assert patterns.dtype == np.uint8
    assert (patterns == patterns[:, :1]).all()
    column = np.arange(608)
    for k, (period, n, steps) in {0: (608, 0, 4), 5: (152, 1, 4), 8: (40, 0, 4), 23: (12, 11, 12)}.items():
        exact = 127.5 * (1 + np.cos(2 * np.pi * column / period + 2 * np.pi * n / steps))
        assert np.abs(patterns[k, 0] - exact).max() <= 0.5 + 1e-9
    assert_array_equal(patterns[12:, 0, :588], patterns[12:, 0, 12:600])


# Identity and opening


def test_the_identity_names_the_instrument_and_its_settings(small):
    one, _ = small()
    same, _ = small(run="other", exposures_done=9)
    assert one.identity == same.identity
    for change in ("twin.seed=2", "twin.camera.prnu=0.02"):
        other, _ = small(change)
        assert other.identity.settings_sha256 != one.identity.settings_sha256
    assert small("twin.seed=2")[0].identity.camera_serial != one.identity.camera_serial


@pytest.mark.slow
def test_opening_by_name_gives_the_same_rig_without_the_bench(small):
    chosen = ["camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875"]
    rig = open_rig("twin", chosen, run="test")
    ours, _ = gt.open("twin", chosen, run="test")
    for either in (rig, ours):
        either.operator.place(Placement("plane"))
    patterns = fringe_patterns(ours)[:2]
    assert_array_equal(rig.capture(patterns).stack, ours.capture(patterns).stack)


@pytest.fixture
def rendered(monkeypatch) -> list[int]:
    """Grows by 1 whenever light is traced for a stack."""
    calls: list[int] = []
    original = FringeIntegrator.render_channels

    def counted(self, *arguments, **named):
        calls.append(1)
        return original(self, *arguments, **named)

    monkeypatch.setattr(FringeIntegrator, "render_channels", counted)
    return calls


@pytest.mark.parametrize(("vibration_um", "fringes_rendered"), [(0.1, 0), (10, 3)])
def test_pictures_that_set_the_exposure_are_rendered_once_and_fringes_where_they_moved_far(
    small, rendered, vibration_um, fringes_rendered
):
    """A uniform pattern looks the same wherever the specimen's place against it is; fringes do not."""
    rig, _ = small(f"twin.stability.vibration_um={vibration_um}")
    rig.operator.place(Placement("plane"))
    for patterns, count in ((white(rig), 1), (fringe_patterns(rig), fringes_rendered)):
        rendered.clear()
        for exposure_us in (20_000, 40_000, 80_000):
            rig.camera.exposure_us = exposure_us
            rig.capture(patterns)
        assert len(rendered) == count


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("part", ["bga", "plane"])
def test_fringes_captured_after_white_are_as_if_rendered_alone(small, rendered, part, seed):
    """No pixel errs by a larger share of its light under white than `light_sums` allows, and float's rounding.

    Pixels are nine columns wide here: those that see columns within RIM of either end are left out, but what the rim
    of the light there diffracts elsewhere, a millionth, is not.
    """
    unsteady = (f"twin.seed={seed}", "twin.stability.vibration_um=0.1", "twin.stability.table_drift_um=0.5")
    (exposed, bench), (alone, _) = (small(*unsteady, noiseless=True) for _ in range(2))
    frames = []
    for rig in (exposed, alone):
        rig.operator.place(Placement(part))
        rig.capture(white(rig) if rig is exposed else white(rig) - 1)  # another grey value sets no exposure
        rendered.clear()
        frames.append(rig.capture(fringe_patterns(rig)))
        assert len(rendered) == (rig is alone)
    scale = np.pi * 75 * frames[0].exposure_us * 1e-3 / exposed.camera.noise.electrons_per_dn
    allowed = scale * (LARGEST_REST * exposed.irradiance(white(exposed))[0] + 1e-5)
    error = np.abs(frames[0].stack - frames[1].stack)
    column = bench.truth().column
    from_end = np.minimum(column, exposed.projector.shape[1] - 1 - column)
    inside = from_end > RIM + 10
    assert inside.mean() > 0.3
    assert (error <= allowed)[:, inside].all()
    assert error[:, inside].max() > 0  # they were not rendered alike


@pytest.mark.slow
@pytest.mark.parametrize("change", ["height", "part", "placed again"])
def test_fringes_rendered_with_white_elsewhere_are_not_shown(small, change):
    rig, fresh = (small(noiseless=True)[0] for _ in range(2))
    rig.operator.place(Placement("bga"))
    for either in (rig, fresh):
        either.capture(white(either)) if either is rig else either.operator.place(Placement("bga"))
        if change == "height":
            either.stage.move_to_mm(0.3)
        else:
            either.operator.place(Placement("coin" if change == "part" else "bga", pose_mm_deg=(0.2, 0, 0, 0, 0, 0)))
    patterns = fringe_patterns(rig)[-2:]
    assert_array_equal(rig.capture(patterns).stack, fresh.capture(patterns).stack)


@pytest.mark.parametrize(
    ("placement", "words"),
    [
        (Placement("coin", pose_mm_deg=(float("nan"), 0, 0, 0, 0, 0)), "six finite numbers"),
        (Placement("coin", pose_mm_deg=(0, 0, 1)), "six finite numbers"),
        (Placement("plane", pose_mm_deg=(0, 0, 100, 0, 0, 0)), "measuring volume"),
        (Placement("board", pose_mm_deg=(0, 0, 1, 0, 0, 0)), "postures"),
    ],
)
def test_poses_that_nobody_can_hold_are_refused(small, placement, words):
    rig, _ = small()
    assert words in refusal(rig.operator.place, placement)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["patterns", "height", "part"])
def test_interreflections_kept_from_another_scene_are_not_shown(small, change):
    rig, _ = small()
    left, right = white(rig), white(rig)
    left[..., 304:] = 0
    right[..., :304] = 0
    rig.operator.place(Placement("bga"))
    rig.irradiance(left)
    fresh, _ = small()
    part = "coin" if change == "part" else "bga"
    fresh.operator.place(Placement(part))
    if change == "part":
        rig.operator.place(Placement(part))
    if change == "height":
        for either in (rig, fresh):
            either.stage.move_to_mm(0.3)
    patterns = right if change == "patterns" else left
    assert_array_equal(rig.irradiance(patterns), fresh.irradiance(patterns))


def test_connecting_and_leaving_do_nothing(small):
    rig, _ = small()
    rig.stage.move_to_mm(0.5)
    with rig as same:
        assert same is rig
        assert rig.stage.position_mm == 0.5
    assert rig.stage.position_mm == 0.5


def attributes(thing: Any, public: bool) -> list[Any]:
    """What hangs on ``thing``: members of containers, values of attributes and properties, owners of methods."""
    if isinstance(thing, dict):
        return [*thing.keys(), *thing.values()]
    if isinstance(thing, list | tuple | set | frozenset):
        return list(thing)
    properties = {name for name, value in inspect.getmembers(type(thing)) if isinstance(value, property)}
    names = {*getattr(thing, "__dict__", ()), *(properties if not isinstance(thing, BaseModel) else ())}
    values = [getattr(thing, name) for name in names if not (public and name.startswith("_"))]
    return [getattr(value, "__self__", value) for value in values]


def reachable(root: Any, public: bool) -> list[Any]:
    """Everything of this package and of the contract that is reached from ``root``, step by step."""
    seen: dict[int, Any] = {id(root): root}
    waiting = [root]
    while waiting:
        for value in attributes(waiting.pop(), public):
            ours = type(value).__module__.startswith("greenough") or isinstance(value, dict | list | tuple | set)
            if ours and id(value) not in seen:
                seen[id(value)] = value
                waiting.append(value)
    return list(seen.values())


def test_a_rig_does_not_lead_to_its_bench(small):
    rig, bench = small()
    rig.operator.place(Placement("board"))
    rig.capture(white(rig))
    truth_types = (gt.Bench, gt.Truth)
    assert not any(isinstance(thing, truth_types) for thing in reachable(rig, public=False))
    hidden = (*truth_types, Workbench, TwinSettings, StageErrors)
    public = reachable(rig, public=True)
    assert not any(isinstance(thing, hidden) for thing in public)
    assert len(public) > 10
    # The search finds what there is to find.
    assert any(isinstance(thing, Workbench) for thing in reachable(rig, public=False))
    assert any(isinstance(thing, TwinSettings) for thing in reachable(bench, public=True))


# Bad input


def test_without_a_part_there_is_nothing_to_capture(small):
    rig, _ = small()
    for action in (rig.capture, rig.irradiance, rig.scene_dict):
        assert "nothing is mounted" in refusal(action, white(rig))


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((2, 684, 607), np.uint8),
        np.zeros((684, 608), np.uint8),
        np.zeros((1, 684, 608), np.float32),
        np.zeros((1, 684, 608), bool),
        np.zeros((0, 684, 608), np.uint8),
    ],
    ids=["shape", "one image", "float", "bool", "none"],
)
def test_wrong_patterns_are_refused_with_what_the_projector_takes(small, wrong):
    rig, _ = small()
    rig.operator.place(Placement("plane"))
    for action in (rig.capture, rig.irradiance, rig.scene_dict):
        sentence = refusal(action, wrong)
        for word in ("uint8", "684", "608"):
            assert word in sentence
    assert rig.capture(white(rig)).serials[0] == 0  # a refused sequence takes no exposure


@pytest.mark.parametrize("position", [1.7, -1.7, float("nan"), float("inf")])
def test_beyond_the_travel_the_stage_refuses_and_stays(small, position):
    rig, _ = small()
    rig.stage.move_to_mm(0.4)
    sentence = refusal(rig.stage.move_to_mm, position)
    assert "-1.6 to 1.6 mm" in sentence
    assert rig.stage.position_mm == 0.4


@pytest.mark.parametrize("exposure_us", [100.0, 1e7, float("nan")])
def test_beyond_its_limits_the_camera_refuses_an_exposure_and_keeps_its_own(small, exposure_us):
    rig, _ = small()
    rig.camera.exposure_us = 10_000.0
    sentence = refusal(setattr, rig.camera, "exposure_us", exposure_us)
    assert "8333 to 5e+06 us" in sentence
    assert rig.camera.exposure_us == 10_000


def test_an_unknown_sample_is_refused_with_the_known_ones(small):
    rig, _ = small()
    rig.operator.place(Placement("plane"))
    sentence = refusal(rig.operator.place, Placement("penny"))
    for known in ("board", "second-board", "plane", "coin", "bga", "diaphragm-raised", "mesh file"):
        assert known in sentence
    rig.capture(white(rig))  # what was mounted still is


def test_a_mesh_file_that_does_not_exist_is_refused(small):
    rig, _ = small()
    assert "nowhere.stl" in refusal(rig.operator.place, Placement("nowhere.stl"))


def test_wrong_fields_of_the_twin_are_refused_on_opening(small):
    assert "optics.na" in refusal(small, "twin.optics.na=3")
    assert "0.019" in refusal(small, "twin.optics.na=3")


def test_only_a_twin_has_a_bench(tmp_path: Path):
    assert "twin" in builtin_rigs()
    text = (Path(str(gt.__file__)).parents[1] / "instrument" / "rigs" / "twin.toml").read_text()
    other = tmp_path / "lab.toml"
    other.write_text(text.replace("greenough.twin:open_rig", "lab.devices:open_rig"))
    assert "lab.devices:open_rig" in refusal(gt.open, other)


def test_the_package_has_no_other_names():
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = gt.nothing_of_the_kind
    assert set(gt.__all__) == {"Bench", "Truth", "TwinRig", "open", "open_rig", "scene_dict"}
    assert all(getattr(gt, name) is not None for name in gt.__all__)
