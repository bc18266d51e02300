"""Claims about the response: the gamma is told from the frames, and its correction gains what is said."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.response import (
    check_response,
    correction_table,
    error_of_steps,
    measure_harmonics,
    power_harmonics,
)
from greenough.pipeline.fringes import FringeSet

SCALE = Yardstick(163.0, 0.5)


@pytest.mark.parametrize("gamma", [0.7, 1.3, 1.8, 2.2])
def test_the_gamma_is_told(taken, gamma):
    (finding,) = check_response(taken(gamma=gamma), SCALE)
    assert finding.name == "response"
    assert finding.evidence["gamma"] == pytest.approx(gamma, rel=0.015)


def test_harmonics_of_a_power_are_those_of_its_fourier_series():
    phase = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    light = ((1 + np.cos(phase)) / 2) ** 1.8
    series = [np.mean(light * np.cos(k * phase)) for k in range(1, 6)]
    np.testing.assert_allclose(power_harmonics(1.8, 5), np.array(series) / series[0], atol=1e-4)


def test_many_steps_show_many_harmonics(taken):
    sequence = taken(gamma=1.8)
    found = measure_harmonics(sequence.fits[-1], sequence.grey_variance, 12.0)
    np.testing.assert_allclose(found.ratios, power_harmonics(1.8, 5)[1:], atol=0.004)
    grey = np.linspace(0, 1, 50)
    np.testing.assert_allclose(found.curve(grey), grey**1.8, atol=0.01)


def test_a_linear_response_is_no_finding(taken):
    assert [check_response(taken(seed=seed), SCALE) for seed in range(10)] == [[]] * 10


@pytest.mark.parametrize("fault", [{"ambient_dn": 30.0}, {"gains": np.random.default_rng(1).normal(1, 0.02, 24)}])
def test_light_that_is_added_or_flickers_is_no_response(taken, fault):
    assert check_response(taken(**fault), SCALE) == []


def test_rounding_of_faint_fringes_is_no_response(taken):
    assert [check_response(taken(seed=seed, full_dn=8.0), SCALE) for seed in range(10)] == [[]] * 10


def test_three_steps_err_as_the_second_harmonic_and_twelve_do_not():
    ratios = power_harmonics(1.8, 6)
    assert error_of_steps(ratios, 3) == pytest.approx(ratios[1] / np.sqrt(2), rel=0.03)
    assert error_of_steps(ratios, 12) < 1e-12


def test_what_three_of_the_steps_err_by_is_said_before_and_after(taken):
    (finding,) = check_response(taken(gamma=1.8), SCALE)
    before, after = (finding.evidence[f"three_of_these_steps{end}_rad"] for end in ("", "_corrected"))
    assert before == pytest.approx(0.15, rel=0.1)
    assert after < 0.25 * before  # noise


def test_patterns_sent_through_the_table_are_linear():
    table = correction_table(1.8)
    np.testing.assert_allclose((table / 255.0) ** 1.8, np.arange(256) / 255, atol=0.004)


@pytest.mark.parametrize("gamma", [1.4, 1.8])
def test_sets_of_three_steps_tell_by_how_their_phases_disagree(taken, gamma):
    fringes = FringeSet((608, 152, 40, 12), (3, 3, 3, 3))
    (finding,) = check_response(taken(fringes=fringes, gamma=gamma), SCALE)
    assert finding.evidence["gamma"] == pytest.approx(gamma, rel=0.03)
    assert finding.effect_um == pytest.approx(163 * error_of_steps(power_harmonics(gamma, 8), 3), rel=0.2)
    assert [check_response(taken(fringes=fringes, seed=seed), SCALE) for seed in range(10)] == [[]] * 10
