"""The error budget: systematic and noise told apart, and a file from which an interrupted one goes on."""

import json

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.twin.rig import open as open_twin
from greenough.twin.settings import TwinSettings
from greenough.twin.validation import budget
from greenough.twin.validation.budget import ALL, EFFECTS, NONE, Cost, cases


def test_systematic_errors_are_told_from_noise():
    """Two exposures share a tilt and an offset; 5 x 20 000 normal deviates fix their spread to 1 %."""
    rng = np.random.default_rng(3)
    tilt = np.linspace(-1, 1, 200) * np.sqrt(3) * 0.4  # 0.4 um RMS
    offsets = np.array([-1.0, -0.5, 0.0, 0.5, 2.0])
    pairs = [o + tilt + rng.normal(0, 1.5, (2, 100, 200)) for o in offsets]
    for pair in pairs:
        pair[:, :3] = np.nan
    cost = budget._cost("x", "paper", pairs)
    assert cost.noise_um == pytest.approx(1.5, rel=0.02)
    assert cost.flatness_um == pytest.approx(0.4, rel=0.1)
    assert cost.systematic_um == pytest.approx(np.sqrt(np.mean(offsets**2) + 0.16), rel=0.05)
    assert cost.step_um == pytest.approx(3.0, abs=0.06)


def test_every_effect_is_switched_off_by_its_settings_and_alone_without_them():
    lines = cases()
    assert len(lines) == 2 + 2 * len(EFFECTS)
    assert not lines[ALL]
    for name, settings in EFFECTS.items():
        assert lines[f"all but {name}"] == settings
        assert set(lines[f"{name} alone"]) == set(lines[NONE]) - set(settings)
    open_twin("twin", lines[NONE])  # all are known to the rig


def test_no_size_of_an_effect_is_forgotten():
    """Sizes of the physics table live in these sections; what is not an effect of planes is named here."""
    others = {"twin.light.white_photons_per_ms", "twin.light.bandwidth_um", "twin.camera.quantum_efficiency"}
    switched = {setting.split("=")[0] for settings in EFFECTS.values() for setting in settings}
    for section in ("light", "camera", "stage", "stability", "board"):
        sizes = {f"twin.{section}.{name}" for name in type(getattr(TwinSettings(), section)).model_fields}
        assert sizes - others <= switched


def lines_of(monkeypatch, runs: list[str], stop_after: int | None = None) -> None:
    def run(rig, overrides, name):
        if stop_after is not None and len(runs) == stop_after:
            raise KeyboardInterrupt
        runs.append(name)
        return [Cost(name, "paper", 1.0, 0.5, 2.0, 0.1)]

    monkeypatch.setattr(budget, "_run", run)


def test_an_interrupted_budget_goes_on(monkeypatch, tmp_path):
    runs: list[str] = []
    lines_of(monkeypatch, runs, stop_after=4)
    with pytest.raises(KeyboardInterrupt):
        budget.budget("twin", [], tmp_path / "budget.json", lambda steps: None)
    lines_of(monkeypatch, runs)
    costs = budget.budget("twin", [], tmp_path / "budget.json", lambda steps: None)
    assert runs == list(cases()) == [cost.effects for cost in costs]
    assert len(json.loads((tmp_path / "budget.json").read_text())["costs"]) == len(costs)


def test_the_file_of_other_settings_is_refused(monkeypatch, tmp_path):
    lines_of(monkeypatch, [])
    out = tmp_path / "budget.json"
    budget.budget("twin", [], out, lambda steps: None)
    with pytest.raises(InputError, match="other settings"):
        budget.budget("twin", ["twin.seed=2"], out, lambda steps: None)
    out.write_text("{}")
    with pytest.raises(InputError, match="not an error budget"):
        budget.budget("twin", [], out, lambda steps: None)
