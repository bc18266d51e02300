import numpy as np
import pytest

from greenough.twin.validation.benchmarks import sized_works


@pytest.mark.parametrize("triangles", [10_000, 100_000])
def test_the_relief_has_its_triangles_over_the_field_and_faces_up(triangles: int) -> None:
    part = sized_works.relief(triangles)
    assert len(part.faces) == pytest.approx(triangles, rel=0.02)
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    area = np.cross(b - a, c - a)[:, 2] / 2  # seen from above
    assert area.min() > 0
    width, height = (2 * half for half in sized_works.HALF_FIELD_MM)
    assert area.sum() == pytest.approx(width * height)
    assert np.ptp(area) < 1e-9


def test_fringes_have_as_many_patterns_as_they_are_named_after() -> None:
    for count, (periods, steps) in sized_works.FRINGES.items():
        assert sum(steps) == count
        assert len(periods) == len(steps)
