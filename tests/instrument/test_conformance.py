"""What every rig keeps. Each claim runs on the rig itself, on its recording in the making, and on its replay."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument import open_rig
from greenough.instrument.contract import Placement, Rig
from greenough.instrument.errors import InputError
from greenough.instrument.recording import record
from greenough.instrument.replay import open_recording

BOARD = Placement("board")


def ramp(rig: Rig, count: int = 3) -> np.ndarray:
    """``count`` patterns of columns that brighten, shifted from one to the next."""
    rows, cols = rig.projector.shape
    columns = np.linspace(40, 215, cols).astype(np.uint8)
    return np.stack([np.tile(np.roll(columns, 2 * shift), (rows, 1)) for shift in range(count)])


def says_who_it_is(rig: Rig) -> None:
    identity = rig.identity
    assert identity.name
    assert identity.camera_serial
    assert identity.projector_serial
    assert len(bytes.fromhex(identity.settings_sha256)) == 32


def states_limits_and_stands_within_them(rig: Rig) -> None:
    low_us, high_us = rig.camera.exposure_limits_us
    low_mm, high_mm = rig.stage.limits_mm
    assert 0 < low_us < high_us
    assert low_us <= rig.camera.exposure_us <= high_us
    assert low_mm < high_mm
    assert low_mm <= rig.stage.position_mm <= high_mm
    assert 0 <= rig.camera.black_level_dn < rig.camera.full_scale_dn
    assert rig.camera.noise.electrons_per_dn > 0


def refuses_an_exposure_outside_its_limits_and_keeps_the_last(rig: Rig) -> None:
    low, high = rig.camera.exposure_limits_us
    before = rig.camera.exposure_us
    for value in (low / 2, 2 * high, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="outside"):
            rig.camera.exposure_us = value
        assert rig.camera.exposure_us == before


def refuses_a_position_outside_its_limits_and_stays(rig: Rig) -> None:
    low, high = rig.stage.limits_mm
    before = rig.stage.position_mm
    for value in (low - 1e-3, high + 1e-3, np.nan, np.inf):
        with pytest.raises(InputError, match="outside"):
            rig.stage.move_to_mm(value)
        assert rig.stage.position_mm == before


def moves_where_it_is_sent(rig: Rig) -> None:
    low, high = rig.stage.limits_mm
    for share in (0.0, 0.3, 1.0):
        target = low + share * (high - low)
        rig.stage.move_to_mm(target)
        assert rig.stage.position_mm == pytest.approx(target, abs=0.05)


def returns_one_frame_per_pattern_with_its_settings(rig: Rig) -> None:
    rig.operator.place(BOARD)
    rig.camera.exposure_us = 2 * rig.camera.exposure_limits_us[0]
    rig.stage.move_to_mm(0.25 * rig.stage.limits_mm[1])
    frames = rig.capture(ramp(rig))
    assert frames.stack.shape == (3, *rig.camera.shape)
    assert frames.stack.dtype in (np.uint8, np.uint16, np.float32)
    assert np.isfinite(frames.stack).all()
    assert frames.stack.max() <= frames.full_scale_dn == rig.camera.full_scale_dn
    assert frames.black_level_dn == rig.camera.black_level_dn
    assert frames.exposure_us == rig.camera.exposure_us
    assert frames.stage_position_mm == rig.stage.position_mm
    assert np.isfinite(frames.gain_db)
    assert frames.run == "default"


def counts_exposures_without_gap_or_repeat(rig: Rig) -> None:
    rig.operator.place(BOARD)
    captures = [rig.capture(ramp(rig, count)) for count in (2, 3, 1)]
    serials = np.concatenate([frames.serials for frames in captures])
    times = np.concatenate([frames.times_s for frames in captures])
    assert (np.diff(serials) == 1).all()
    assert (np.diff(times) > 0).all()


def never_repeats_its_noise(rig: Rig) -> None:
    rig.operator.place(BOARD)
    first, second = rig.capture(ramp(rig)), rig.capture(ramp(rig))
    assert not np.array_equal(first.stack, second.stack)


def sees_more_light_with_a_longer_exposure(rig: Rig) -> None:
    rig.operator.place(BOARD)
    rig.camera.exposure_us = rig.camera.exposure_limits_us[0]
    short = rig.capture(ramp(rig))
    rig.camera.exposure_us = 4 * rig.camera.exposure_limits_us[0]
    assert rig.capture(ramp(rig)).stack.mean() > short.stack.mean()


def refuses_patterns_that_do_not_fit_before_any_exposure(rig: Rig) -> None:
    rig.operator.place(BOARD)
    good = ramp(rig)
    before = rig.capture(good)
    for bad in (good[:, 1:], good[:, :, 1:], good[0], good[:0], good.astype(float)):
        with pytest.raises(InputError, match="patterns"):
            rig.capture(bad)
    assert rig.capture(good).serials[0] == before.serials[-1] + 1


def refuses_an_unknown_part_and_goes_on_with_the_last(rig: Rig) -> None:
    rig.operator.place(BOARD)
    with pytest.raises(InputError, match="no-such-part"):
        rig.operator.place(Placement("no-such-part"))
    rig.capture(ramp(rig))


def leaves_the_frames_to_the_caller(rig: Rig) -> None:
    rig.operator.place(BOARD)
    first = rig.capture(ramp(rig))
    kept = first.stack.copy()
    rig.capture(ramp(rig))
    np.testing.assert_array_equal(first.stack, kept)
    assert first.stack.flags.writeable


CLAIMS = [
    says_who_it_is,
    states_limits_and_stands_within_them,
    refuses_an_exposure_outside_its_limits_and_keeps_the_last,
    refuses_a_position_outside_its_limits_and_stays,
    moves_where_it_is_sent,
    returns_one_frame_per_pattern_with_its_settings,
    counts_exposures_without_gap_or_repeat,
    never_repeats_its_noise,
    sees_more_light_with_a_longer_exposure,
    refuses_patterns_that_do_not_fit_before_any_exposure,
    refuses_an_unknown_part_and_goes_on_with_the_last,
    leaves_the_frames_to_the_caller,
]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.__name__)
def test_every_rig(claim: Callable[[Rig], None], open_some_rig: Callable[[], Rig]) -> None:
    with open_some_rig() as rig:
        claim(rig)


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.__name__)
def test_every_recording_and_its_replay(
    claim: Callable[[Rig], None], open_some_rig: Callable[[], Rig], tmp_path: Path
) -> None:
    with record(open_some_rig(), tmp_path / "rig.h5") as rig:
        claim(rig)
    with open_recording(tmp_path / "rig.h5") as rig:
        claim(rig)


# What images keep of it: their exposure is one, and nothing but what was projected once can be captured. That each
# capture has frames of its own, in order and numbered on, is claimed in test_image_rig.py.
OF_IMAGES = [
    says_who_it_is,
    refuses_an_exposure_outside_its_limits_and_keeps_the_last,
    refuses_a_position_outside_its_limits_and_stays,
    moves_where_it_is_sent,
]


@pytest.mark.parametrize("claim", OF_IMAGES, ids=lambda claim: claim.__name__)
def test_a_rig_of_images(claim: Callable[[Rig], None], image_folder: Path) -> None:
    with open_rig(image_folder / "rig.toml") as rig:
        claim(rig)


def test_leaving_by_an_exception_leaves_the_rig(open_some_rig: Callable[[], Rig], tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), record(open_some_rig(), tmp_path / "rig.h5"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
