"""Verdicts of the negative controls on rows that are given, and the size that is predicted for a gamma.

``tests/full`` plants the errors in rendered twins.
"""

from collections.abc import Sequence

import numpy as np
import pytest

from greenough.twin.rig import open as open_twin
from greenough.twin.validation import negative_controls
from greenough.twin.validation.claims import Claim
from greenough.twin.validation.negative_controls import SCALE_TOLERANCE, control_figures, ripple_mm

GAMMA_RMSE_UM = 17.0
SOUND = {
    "step_2500um": (0.1, 0.5), "pitch_second_board_error_mean_all_spots": (0.02, 0.1),
    "pitch_second_board_mean_all_spots": (0.65002, 0.0015),
    "plane_noise_ratio": (1.0, 0.05), "plane_rmse_raw": (3.5, 1.223), "depth_systematic_rms": (0.2, 0.5),
    "depth_systematic_p99": (0.5, 1.5), "stages_within_4um": (1.0, 0.95),
}  # fmt: skip


def row(name: str, measured: float) -> Claim:
    limit = SOUND[name][1]
    off_by = abs(measured - 1) if name == "plane_noise_ratio" else abs(measured)
    holds = measured >= limit if name == "stages_within_4um" else off_by <= limit
    noise = 3.2 if name == "plane_rmse_raw" else None
    return Claim(
        name, "plane", None, measured, "um", 9, "none", "none", "bundle", 1, limit, holds, True, "", predicted=noise
    )


def planted(setting: str) -> dict[str, float]:
    """What an override does to the figures, as it should."""
    name, _, value = setting.partition("=")
    if name == "twin.board.scale_error_ppm":
        shorter = 1 / (1 + 1e-6 * float(value)) - 1
        return {
            "step_2500um": 0.1 + 2500 * shorter,
            "pitch_second_board_error_mean_all_spots": 0.02 + 650 * shorter,
            "pitch_second_board_mean_all_spots": 0.65002 * (1 + shorter),
        }
    if name == "twin.optics.gamma":
        return {"plane_noise_ratio": 5.0, "plane_rmse_raw": GAMMA_RMSE_UM}
    return {}


def figures(monkeypatch, **wrong: float) -> list[dict]:
    """Figures of the controls on a twin whose rows are as they should be, but for those with the error in ``wrong``."""

    def measured(rig_name: str, overrides: Sequence[str], run: str, advance: object) -> dict[str, Claim]:
        change = {name: value for setting in overrides for name, value in planted(setting).items()}
        change |= {name: wrong[name] for name in change if name in wrong}
        return {name: row(name, change.get(name, value)) for name, (value, _) in SOUND.items()}

    def stages(*args: object) -> tuple[dict[str, Claim], dict[str, Claim]]:
        bad = {"depth_systematic_rms": 2.0, "depth_systematic_p99": 5.0, "stages_within_4um": 0.05}
        sound = {name: row(name, SOUND[name][0]) for name in bad}
        return sound, {name: row(name, wrong.get(name, value)) for name, value in bad.items()}

    for name in ("_lengths", "_one_plane"):
        monkeypatch.setattr(negative_controls, name, lambda *args, measured=measured: measured(*args))
    monkeypatch.setattr(negative_controls, "_exact_and_coarse_stage", stages)
    return control_figures("twin", (), "test", lambda steps: None)


def unexpected(found: list[dict]) -> set[tuple[str, str]]:
    return {(figure["control"].split(",")[0], figure["row"].split(":")[0]) for figure in found if figure["unexpected"]}


def test_rows_that_turn_red_are_as_expected_for_all_four_errors(monkeypatch):
    found = figures(monkeypatch)
    assert unexpected(found) == set()
    assert len({figure["control"] for figure in found}) == 4
    assert all(isinstance(value, float | str) for figure in found for value in figure.values())


@pytest.mark.parametrize(
    ("name", "green"),
    [
        ("step_2500um", 0.3), ("pitch_second_board_error_mean_all_spots", 0.05),
        ("plane_noise_ratio", 1.03), ("depth_systematic_rms", 0.4), ("stages_within_4um", 0.97),
    ],
)  # fmt: skip
def test_a_row_that_stays_green_is_unexpected(monkeypatch, name, green):
    assert name in {row for _, row in unexpected(figures(monkeypatch, **{name: green}))}


def test_a_row_that_is_red_without_the_error_proves_nothing(monkeypatch):
    monkeypatch.setitem(SOUND, "plane_noise_ratio", (1.1, 0.05))
    assert unexpected(figures(monkeypatch)) == {("gamma of 1.8", "plane_noise_ratio")}


@pytest.mark.parametrize(("share", "expected"), [(0.9, True), (1.1, False), (-1.1, False)])
def test_the_second_boards_pitch_must_change_by_the_scale_error_and_no_more(monkeypatch, share, expected):
    mean = 0.65002 * (1 / 1.001 + share * SCALE_TOLERANCE)
    found = figures(monkeypatch, pitch_second_board_mean_all_spots=mean)
    wrong = {row for _, row in unexpected(found)}
    assert ("pitch_second_board_mean_all_spots" not in wrong) == expected


def test_a_ripple_of_another_size_than_predicted_is_unexpected(monkeypatch):
    assert ("gamma of 1.8", "plane_rmse_raw") in unexpected(figures(monkeypatch, plane_rmse_raw=10.0))


@pytest.mark.parametrize(("gamma", "steps"), [(1.8, 3), (1.2, 3), (2.2, 4), (0.6, 3)])
def test_the_ripple_of_a_gamma_is_what_the_n_step_formula_makes_of_its_bent_fringes(gamma, steps):
    """The fringe bent, each of its harmonics damped by what it passes, sampled and decoded."""
    rig, bench = open_twin("twin")
    optics, n = bench.settings.optics, 1440
    phase = 2 * np.pi * np.arange(n) / n
    spectrum = np.fft.rfft(((1 + np.cos(phase)) / 2) ** gamma)
    frequency = np.arange(len(spectrum)) / (12 * 17.835e-3)
    q = np.minimum(frequency * 0.525e-3 / (2 * 0.015), 1)
    lens = 2 / np.pi * (np.arccos(q) - q * np.sqrt(1 - q**2))
    pixel, half_diagonal = 224.56 / 22683, np.sqrt(0.92) * 17.835e-3 / 2
    spectrum *= lens**2 * np.sinc(frequency * pixel) * np.sinc(frequency * half_diagonal) ** 2
    light = np.fft.irfft(spectrum, n)
    frames = [np.roll(light, -k * n // steps) for k in range(steps)]
    phasor = sum(frame * np.exp(-2j * np.pi * k / steps) for k, frame in enumerate(frames))
    error = np.angle(phasor * np.exp(-1j * phase))
    mm_per_rad = 12 * 17.835e-3 / (2 * np.pi) / (2 * np.sin(np.radians(6)))
    expected = np.sqrt(np.mean(error**2)) * mm_per_rad
    assert expected > 2e-4
    assert ripple_mm(gamma, steps, optics, rig.procedure) == pytest.approx(expected, rel=2e-3)
