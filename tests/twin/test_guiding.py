"""Claims about drawing paths from maps of the light. Comparisons by chance refuse what is right once in a thousand."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from greenough.twin.plugins.guiding import look_around
from greenough.twin.renderer import dr, mi

FALSE_ALARM = 1e-3
ALPHA = 0.2
GLOSSY = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": ALPHA}
MIRROR = {"type": "conductor", "material": "none"}
DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
PLASTIC = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.3, "diffuse_reflectance": 0.2}


def balls(bsdf: dict[str, Any], ground: dict[str, Any] = DIFFUSE) -> dict[str, Any]:
    """Two balls on a plane."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([6, 6, 1]), "bsdf": ground}
    left, right = ({"type": "sphere", "radius": 0.8, "center": [x, 0, 0.8], "bsdf": bsdf} for x in (-1.3, 1.3))
    return {"plane": plane, "left": left, "right": right}


def close_up(scenery: Any) -> dict[str, Any]:
    """The plane between the balls and their flanks, in pixels much smaller than the balls."""
    film = scenery.film | {"width": 64, "height": 48}
    return scenery.lens_sensor(film=film, focal_length_px=400.0)


def blocks(pictures: np.ndarray) -> np.ndarray:
    """Means over 8 x 8 pixels: in single ones the few plain paths that meet a glint are far from normally spread."""
    seeds, rows, cols, channels = pictures.shape
    return pictures.reshape(seeds, rows // 8, 8, cols // 8, 8, channels).mean(axis=(2, 4))


def guide_of(inside: mi.Scene, brightness: float = 1.0) -> Any:
    """A guide of one tile that looks from the top of the plane z = 0, lit from one side more than from the other."""

    def camera_ray(pixel: mi.UInt32) -> mi.Ray3f:
        return mi.Ray3f(mi.Point3f(0.01, 0.02, 3) + dr.zeros(mi.Vector3f, dr.width(pixel)), mi.Vector3f(0, 0, -1))

    def light(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        return dr.select(active, brightness * dr.exp(3 * ray.d.x) * dr.select(ray.d.y > 0.3, 1.0, 0.0), 0.0)

    return look_around(inside, (8, 8), camera_ray, light)


@pytest.fixture(scope="module")
def dome() -> mi.Scene:
    """A plane under a large sphere, so that everything above the plane meets something."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([20, 20, 1]), "bsdf": DIFFUSE}
    return mi.load_dict({"type": "scene", "plane": plane, "dome": {"type": "sphere", "radius": 15.0}})


def densities(dome: mi.Scene, guide: Any, p: mi.Point3f, ray: mi.Ray3f) -> tuple[np.ndarray, np.ndarray]:
    """Directions from ``p`` to what ``ray`` meets, (n, 3), and how densely the guide draws them."""
    si = dome.ray_intersect(ray)
    density = guide.density(mi.UInt32(0), p, si, si.is_valid())
    return np.array(dr.normalize(si.p - p)).T, np.array(density)


@pytest.mark.parametrize("p", [(0.01, 0.02, 0.0), (1.0, -2.0, 0.5)], ids=["middle", "beside"])
def test_the_density_integrates_to_one(dome, p):
    guide = guide_of(dome)
    n = 1000
    at = (mi.Float(dr.arange(mi.UInt32, n * n) % n) + 0.5) / n, (mi.Float(dr.arange(mi.UInt32, n * n) // n) + 0.5) / n
    p = mi.Point3f(*p) + mi.Vector3f(0, 0, 1e-4)
    towards = mi.warp.square_to_uniform_sphere(mi.Point2f(*at))
    _, density = densities(dome, guide, p, mi.Ray3f(p, towards))
    assert density.mean() * 4 * np.pi == pytest.approx(1, abs=2e-3)


def test_what_is_drawn_has_the_density_that_is_stated(dome):
    guide = guide_of(dome)
    rng = np.random.default_rng(1)
    n = 200_000
    u = mi.Point2f(*rng.random((2, n)).astype(np.float32))
    p = mi.Point3f(1.0, -2.0, 0.5)
    drawn = guide.sample(mi.UInt32(0), u, mi.Bool(True))
    met, density = densities(dome, guide, p, drawn)
    assert (density > 0).all()
    # Importance sampling of functions that vanish where nothing is drawn: the map is blurred over one bin.
    lit = met[:, 1] > 0.5
    grid = rng.normal(size=(4 * n, 3))
    grid /= np.linalg.norm(grid, axis=1, keepdims=True)
    for function in (lambda d: d[:, 0] ** 2, lambda d: np.exp(2 * d[:, 2])):
        ours = np.where(lit, function(met) / density, 0.0)
        theirs = np.where((grid[:, 1] > 0.5) & (grid[:, 2] > 0), function(grid), 0.0) * 4 * np.pi
        spread = np.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))
        assert 2 * norm.sf(abs(ours.mean() - theirs.mean()) / spread) > FALSE_ALARM / 2


def test_a_dark_surrounding_draws_nothing(dome):
    guide = guide_of(dome, brightness=0.0)
    ray = guide.sample(mi.UInt32(0), mi.Point2f([0.1, 0.9], [0.5, 0.3]), mi.Bool(True))
    assert not np.array(dome.ray_intersect(ray).is_valid()).any()
    p = mi.Point3f(0, 0, 0.1)
    _, density = densities(dome, guide, p, mi.Ray3f(p, mi.Vector3f(0, 0.6, 0.8)))
    assert density == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bsdf", "ground"),
    [(GLOSSY, DIFFUSE), (GLOSSY, GLOSSY), (PLASTIC, PLASTIC), (GLOSSY, MIRROR)],
    ids=["balls on a matt plane", "all metal", "all plastic", "balls on a mirror"],
)
def test_guided_paths_have_the_mean_of_plain_ones(scenery, chance, chance_brightness, bsdf, ground):
    guided, plain = (
        scenery.renders(
            close_up(scenery),
            scenery.lens_projector(),
            scenery.fringe(2, guided=how),
            balls(bsdf, ground),
            seeds=range(first, first + 16),
        )
        for how, first in ((True, 0), (False, 1000))
    )
    assert chance(blocks(guided), blocks(plain), 64 * scenery.paths) > FALSE_ALARM
    assert chance_brightness(guided, plain) > FALSE_ALARM


@pytest.mark.slow
def test_guided_paths_are_mitsubas(scenery, chance, chance_brightness):
    bodies = balls(GLOSSY)
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe(3), bodies)[..., :1]
    theirs = scenery.renders(
        scenery.perspective(), scenery.projector(0), scenery.path(3), bodies, seeds=range(1000, 1032)
    )
    assert chance(ours, theirs, scenery.paths) > FALSE_ALARM
    assert chance_brightness(ours, theirs) > FALSE_ALARM


@pytest.mark.slow
def test_glints_on_a_matt_plane_are_met_with_much_less_noise(scenery):
    render = partial(scenery.renders, close_up(scenery), scenery.lens_projector(), bodies=balls(GLOSSY), seeds=range(8))
    direct = render(scenery.fringe(1))
    variances = []
    for guided in (True, False):
        indirect = render(scenery.fringe(2, guided=guided)) - direct  # the same paths of direct light
        variances.append(indirect[:, :, 24:40].var(axis=0, ddof=1).mean())
    assert variances[0] < variances[1] / 4
