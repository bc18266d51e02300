"""Claims that hold for every sample of the catalogue."""

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.scenes.catalogue import FLAT, NAMES, specimen
from greenough.scenes.mesh_file import HALF_VOLUME_MM


@pytest.fixture(scope="module", params=NAMES)
def sample(request):
    return request.param, specimen(request.param, seed=7)


def test_a_sample_has_its_name_and_nominal_dimensions(sample):
    name, found = sample
    assert found.name == name
    assert found.nominal
    assert all(key.endswith(("_mm", "_deg", "_count")) for key in found.nominal)


def test_a_sample_fits_the_volume_and_memory(sample):
    _, found = sample
    for part in found.parts:
        assert (np.abs(part.vertices).max(axis=0) <= HALF_VOLUME_MM).all()
        assert part.vertices.dtype == np.float64
        assert part.faces.dtype == np.int32
    assert sum(len(part.faces) for part in found.parts) <= 2_500_000


def test_facets_are_sound_and_shading_normals_follow_them(sample):
    _, found = sample
    for part in found.parts:
        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        facet = np.cross(b - a, c - a)
        length = np.linalg.norm(facet, axis=-1, keepdims=True)
        assert length.min() > 1e-6  # mm²: no slivers
        if part.normals is None:  # each facet is flat
            continue
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=-1), 1)
        shading = part.normals[part.faces].mean(axis=1)
        assert np.sum(facet / length * shading, axis=-1).min() > 0.999


def test_flat_samples_have_no_relief_by_which_they_could_light_themselves_and_the_others_have(sample):
    name, found = sample
    heights = np.concatenate([part.vertices[:, 2] for part in found.parts])
    assert (np.ptp(heights) < 5e-3) == (name in FLAT)


def test_an_unknown_sample_is_refused_with_the_names_there_are():
    for name in ("penny", "diaphragm", "diaphragm-flat", "coin-", ""):
        with pytest.raises(InputError, match="plane, coin, bga, diaphragm-concave"):
            specimen(name, seed=0)
