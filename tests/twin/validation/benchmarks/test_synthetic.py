import numpy as np
import pytest

from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline import FringeSet, decode, reconstruct
from greenough.pipeline.phase_height import fit_phase_height
from greenough.twin.validation.benchmarks import synthetic

RIG_FILE = load_rig_file("twin", ["camera.rows=48", "camera.cols=160"])
FRINGES = FringeSet(RIG_FILE.procedure.periods_px, RIG_FILE.procedure.steps)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_frames_become_the_surface_at_zero(seed: int) -> None:
    frames = synthetic.frames(FRINGES, (48, 160), noise_dn=1.0, seed=seed)
    points = reconstruct(decode(frames, FRINGES), synthetic.calibration(RIG_FILE))
    assert points.valid.mean() > 0.99
    z = points.xyz[..., 2][points.valid]
    assert abs(z.mean()) < 1e-3
    assert 0 < z.std() < 0.01


def test_the_planes_are_fitted_in_every_pixel() -> None:
    z_mm = np.linspace(-1, 1, 12)
    fit = fit_phase_height(synthetic.plane_phases(FRINGES, (10, 40), z_mm), z_mm)
    assert fit.relation.valid.all()
    np.testing.assert_allclose(fit.relation.slope(fit.relation.phase_centre), 1 / synthetic.RAD_PER_MM, rtol=0.02)
