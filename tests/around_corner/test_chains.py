"""Late light from shared chains: the same as that of paths, in every kind of capture and colour."""

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, folded_plates, join, mannequin, mesh, plate, scene_of, wall_grid
from support.late_light_runs import agree, chains, density_of, rendered, scan_scene
from support.marks import long_rows
from support.third_bounce_runs import film_of, table_of, wall_of
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_mono"


PATHS, CHAINS = 1 << 14, 1 << 10


def curved_wall(folder):
    """A part of a cylinder that points of it see each other across, as a file; scanned points are inside of facets."""
    v, f = plate(1.6, 1.6, (0, 0, 0), 23)
    v[:, 2] = 0.35 * v[:, 0] ** 2
    name = str(folder / "wall.ply")
    mesh("wall", (v, f[:, ::-1]), 0.9).write_ply(name)
    return {"type": "ply", "filename": name, "face_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.9}}


SCENES = {
    "V and plate": lambda: [mesh("a", folded_plates())],
    "two-sided": lambda: [mesh("a", folded_plates(), two_sided=True), mesh("b", ball((0, 0.2, 0.7), 0.1, 1), 0.5)],
    "body before a wall": lambda: [mesh("a", mannequin(1)), mesh("b", plate(2, 2, (0, 0, 1.6)), 0.5)],
    "interpolated normals": lambda: [
        mesh("a", ball((0.1, 0, 1), (0.3, 0.4, 0.2), 1), vertex_normals=True),
        mesh("b", plate(1.5, 1.5, (0, 0, 1.3)), 0.9),
    ],
}


ROWS = [("two-sided", "single"), ("V and plate", "exhaustive"), ("body before a wall", "confocal"),
        ("interpolated normals", "single")]  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), long_rows(ROWS, ROWS[:1]))
def test_chains_bring_what_paths_do(name, kind):
    size = (2, 1) if kind == "exhaustive" else (3, 2)
    given = {"min_bounces": 4, "max_depth": 6, "kind": kind, "size": size}
    # A tile of four pairs has less to average over. Many runs of few: standard errors out of ten runs are too often too
    # small for ten blocks at a time.
    count = 2 * CHAINS if kind == "exhaustive" else CHAINS // 2
    some = scan_scene(SCENES[name](), **given, late_light="chains")
    other = scan_scene(SCENES[name](), **given, late_light="paths")
    equal, z = agree(rendered(some, count, 24), rendered(other, PATHS // 2, 16, first=50))
    assert equal, z


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [5, 7])
def test_each_number_of_bounces(bounces):
    """One by one, also where the walk goes by way of the relay wall: plates that do not see each other."""
    shapes = [mesh("a", join(plate(0.5, 0.5, (-0.4, 0, 0.5)), plate(0.5, 0.5, (0.4, 0, 0.6))), 0.9)]
    given = {"filter_bounces": bounces, "max_depth": 7}
    some, other = (scan_scene(shapes, **given, late_light=choice) for choice in ("chains", "paths"))
    a, b = rendered(some, 2 * CHAINS, 12), rendered(other, PATHS, 8, first=50)
    equal, z = agree(a, b)
    assert equal, z
    assert (a.mean() > 0) == (b.mean() > 0)


@pytest.mark.slow
def test_a_curved_wall(tmp_path):
    """Heads lie on the wall, too; light of two and three bounces goes on coming from paths."""
    wall = curved_wall(tmp_path)
    x, y = np.meshgrid((np.arange(3) + 0.5) / 3, (np.arange(2) + 0.5) / 2)
    points = np.array(mi.load_dict(wall).sample_position(0, mi.Point2f(x.ravel(), y.ravel())).p).T
    shapes = [mesh("a", plate(0.8, 0.8, (0, 0, 1.0)))]
    given = {"max_depth": 5, "wall": wall, "points": points, "film": {"start_opl": 0.0}}
    some, other = scan_scene(shapes, **given, late_light="chains"), scan_scene(shapes, **given)
    equal, z = agree(rendered(some, 4 * CHAINS, 12), rendered(other, 4 * PATHS, 8, first=50))
    assert equal, z


@pytest.mark.slow
def test_all_light_is_the_sum_of_its_parts():
    """Shared third bounce, chains up to seven bounces, and paths beyond, against paths alone."""
    given = {"max_depth": 9, "rr_depth": 100}
    shapes = [mesh("a", folded_plates(), 0.9)]
    whole = rendered(scan_scene(shapes, **given, late_light="paths", third_bounce="paths"), PATHS, 8, first=50)
    for choice in ({}, {"third_bounce": "paths"}, {"late_light": "paths"}):
        equal, z = agree(rendered(scan_scene(shapes, **given, **choice), CHAINS, 12), whole)
        assert equal, (choice, z)


# ------------------------------------------------------------------------------------------------ by themselves


@pytest.fixture(scope="module")
def corner():
    shapes = [mesh("a", folded_plates(), two_sided=True)]
    scene = scene_of(*shapes)
    points, normals = wall_grid(2, 0.4)
    elements = density_of(scene, table_of(shapes), points, normals)
    return scene, elements, points, normals


def histogram(points, **arguments):
    return film_of(points, points, 1.2, 48, 0.05, **arguments)


@pytest.mark.parametrize("choices", [{"size": 1}, {"side": 2}])
def test_groups_and_tiles_have_one_mean(corner, choices):
    scene, elements, points, normals = corner
    sensors = wall_of(points, normals)
    run = lambda seed, **more: chains(  # noqa: E731
        scene, elements, histogram(2), sensors, sensors, "confocal", 512, seed, **more
    )[1]
    a = np.array([run(seed) for seed in range(10)])
    b = np.array([run(seed, **choices) for seed in range(20, 30)])
    equal, z = agree(a, b, blocks=6)
    assert equal, z


def test_the_choice_says_why_not():
    shapes = [mesh("a", folded_plates())]
    # Mitsuba's parser hands on what the plugin says.
    with pytest.raises(RuntimeError, match="expected auto, chains or paths"):
        scan_scene(shapes, late_light="walks")
    metal = mi.load_dict({"type": "sphere", "center": [0, 0, 1], "radius": 0.2, "bsdf": {"type": "roughconductor"}})
    scene = scan_scene([metal], late_light="chains")
    with pytest.raises(SceneError, match=r"late_light is 'chains', but not all surfaces are diffuse"):
        scene.integrator().render(scene, spp=1)
    scene = scan_scene(shapes, late_light="chains", nlos_hidden_geometry_sampling=False)
    with pytest.raises(SceneError, match="late_light is 'chains', but nlos_laser_sampling"):
        scene.integrator().render(scene, spp=1)


# ------------------------------------------------------------------------------------------------ colours
