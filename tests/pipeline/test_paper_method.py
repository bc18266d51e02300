"""What the stage's errors do to the paper's heights: the prediction against fits to planes that err."""

import numpy as np
import pytest

from greenough.pipeline.paper_method import fit_planes, fitted_errors


@pytest.mark.slow
def test_errors_of_the_stage_come_out_as_predicted():
    """Step over 2.5 mm and height at its upper end, from 300 stages of 10 µm: a spread is known to 16 % (4 sd)."""
    readings = (np.arange(30) - 14.5) * 0.1
    rng = np.random.default_rng(6)

    def phase(z):
        return (150.0 + 6.2 * z / (1 + 0.004 * z)) * np.ones((2, 3))

    places = np.array([-1.25, 1.25])
    found = []
    for _ in range(300):
        at = readings + 0.01 * rng.standard_normal(30)
        fit, _ = fit_planes(phase(0.0), np.stack([phase(z) for z in at]), readings)
        found.append([np.mean(fit.relation.height(phase(z))) - z for z in places])
    errors = np.array(found)
    causes = 0.01 * (fitted_errors(readings, places) - fitted_errors(readings, np.zeros(1)))
    assert abs(np.std(errors[:, 1]) / np.linalg.norm(causes[1]) - 1) < 4 / np.sqrt(2 * 300)
    assert abs(np.std(errors[:, 1] - errors[:, 0]) / np.linalg.norm(causes[1] - causes[0]) - 1) < 4 / np.sqrt(2 * 300)
