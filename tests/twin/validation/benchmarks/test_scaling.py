import numpy as np
import pytest

from greenough.twin.validation.benchmarks import scaling
from greenough.twin.validation.benchmarks.required import REQUIRED
from greenough.twin.validation.benchmarks.scaling import SERIES, Series, exponent, series_rows

SIZES = (10, 30, 100)


@pytest.mark.parametrize("power", [-0.5, 0.0, 0.9, 1.0, 2.0])
def test_the_exponent_of_a_power_law_is_its_power(power: float) -> None:
    assert exponent(SIZES, [3e-3 * size**power for size in SIZES]) == pytest.approx(power, abs=1e-9)


def test_a_fixed_cost_lowers_the_exponent_and_a_quadratic_share_raises_it() -> None:
    assert exponent(SIZES, [20 + size for size in SIZES]) < 0.9
    assert exponent(SIZES, [size + 0.01 * size**2 for size in SIZES]) > 1.1


def test_the_exponent_errs_by_the_scatter_of_the_times() -> None:
    """Normal errors of 3 % move the slope by more than 4 of its standard deviations in 1 of 16 000 draws."""
    rng = np.random.default_rng(1)
    spread = np.log(SIZES) - np.mean(np.log(SIZES))
    sd = 0.03 / np.sqrt(np.sum(spread**2))
    for _ in range(20):
        times = np.array(SIZES) * np.exp(rng.normal(0, 0.03, 3))
        assert abs(exponent(SIZES, times) - 1) < 4 * sd


@pytest.mark.parametrize(("power", "holds"), [(0.5, True), (1.0, True), (1.2, False)])
def test_growth_beyond_the_limit_falls_short(monkeypatch: pytest.MonkeyPatch, power: float, holds: bool) -> None:
    monkeypatch.setattr(scaling, "_peak_in_child", lambda series, size, *rig: 2.0 * size)
    series = Series("sort", "cards", SIZES, scaling.LINEAR, 1, lambda rig, overrides, size: lambda: size)
    times = {series.name(size): 0.1 * size**power for size in SIZES}
    monkeypatch.setattr(scaling, "interleaved", lambda works, repeats: times)
    *sizes, last = series_rows(series, "twin", [])
    assert last.name == "sort, exponent of time in cards"
    assert last.value == pytest.approx(power)
    assert last.holds is holds
    assert [row.value for row in sizes] == [*times.values(), 20.0, 60.0, 200.0]
    assert sizes[2].ratio == pytest.approx(10**power)
    assert all(row.limit is None for row in sizes)


def test_the_table_has_every_size_and_exponent_that_is_required() -> None:
    names = [name for series in SERIES for size in series.sizes for name in (series.name(size),)]
    memory = [f"{name}, peak memory" for name in names]
    assert {*names, *memory, *(series.exponent_name for series in SERIES)} == set(REQUIRED["scaling"])
    limits = {(series.step, series.of): series.limit for series in SERIES}
    assert limits["decode", "pixels"] == limits["fit", "planes"] == limits["render", "patterns"] == 1.05
    assert limits["render", "triangles"] == 1.0


@pytest.mark.parametrize("series", SERIES, ids=lambda series: f"{series.step} {series.of}")
def test_a_series_does_as_much_as_it_says(series: Series) -> None:
    coarse = ["twin.optics.glass=false", "camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875"]
    seen = {
        ("decode", "pixels"): lambda phase_map: phase_map.absolute.size / 1200,
        ("frames to points", "pixels"): lambda points: points.valid.size / 1200,
        ("fit", "pixels"): lambda fit: fit.relation.valid.size / 1200,
        ("render", "pixels"): lambda channels: len(channels[0]) / 1200,
        ("render", "patterns"): len,
        ("fit", "planes"): lambda fit: len(fit.plane_residual_um),
        ("load a mesh", "triangles"): lambda scene: sum(shape.face_count() for shape in scene.shapes()),
    }
    for size in series.sizes[:2]:
        result = series.prepare("twin", coarse, size)()
        assert result is not None
        if (series.step, series.of) in seen:
            assert seen[series.step, series.of](result) == pytest.approx(size, rel=0.01)
