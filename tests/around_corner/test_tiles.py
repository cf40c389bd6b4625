"""Tiles of scan points with samples of their own: the same light with less noise where geometry is near."""

import numpy as np
import pytest

from support.hidden_shapes import ball, mesh, scene_of, wall_grid
from support.marks import long
from support.third_bounce_runs import captured, film_of, wall_of
from torchtransient.errors import SceneError, ShapeError
from torchtransient.plugins.around_corner.exhaustive import add_exhaustive
from torchtransient.plugins.around_corner.shafts import spare_rays
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import ScanTiles, distance_to, draw_samples

VARIANT = "llvm_ad_mono"
GRID = 8


@pytest.fixture(scope="module")
def arm():
    """10 cm before a scan of 1 m."""
    shapes = [mesh("arm", ball((0.1, 0, 0.25), (0.35, 0.06, 0.12), 3))]
    points, normals = wall_grid(GRID)
    return shapes, scene_of(*shapes), points, normals


def test_tiles_are_neighbours_and_all_points_have_one(arm):
    shapes, _, points, normals = arm
    distance = distance_to(np.array(shapes[0].vertex_positions_buffer(), float).reshape(-1, 3), points)
    assert distance == pytest.approx(0.13, abs=0.02)
    tiles = ScanTiles(points, normals, distance)
    assert tiles.count == 16 and tiles.points.shape == (16, 25, 3)
    for t in range(16):
        inside = points[tiles.tile == t]
        assert len(inside) == 4 and np.ptp(inside, axis=0).max() == pytest.approx(1 / GRID)
        assert set(map(tuple, tiles.points[t])) == set(map(tuple, inside))
    assert ScanTiles(points, normals, 0.6).count == 1
    assert ScanTiles(points[:1], normals[:1], 0.1).count == 1
    assert ScanTiles(points[:GRID], normals[:GRID], 0.25).count == 2


@pytest.mark.slow
@pytest.mark.parametrize("single", long([False, True], [False]))
def test_less_noise_and_no_bias(arm, single):
    shapes, scene, points, normals = arm
    film = film_of(GRID, GRID, bins=40, bin_width=0.05)
    tiles = ScanTiles(points, normals, 0.1)
    tables = {True: HiddenElements(shapes, tiles.points, tiles.normals), False: HiddenElements(shapes, *wall_grid(5))}
    runs = {}
    for tiled, table in tables.items():
        spare_rays(scene, table, points, normals)
        runs[tiled] = np.array(
            [run(scene, film, table, arm, seed, single, tiles if tiled else None) for seed in range(64)]
        )
    total = {tiled: r.sum(-1) for tiled, r in runs.items()}
    errors = [r.std(0, ddof=1) / 8 for r in total.values()]
    apart = (total[True].mean(0) - total[False].mean(0)) / np.hypot(*errors)
    # All points share samples, or those of a tile: 64 numbers that are not independent.
    assert np.abs(apart).max() < 4.5 and np.mean(apart**2) < 4
    if not single:
        assert total[True].var(0).sum() < total[False].var(0).sum() / 8


def run(scene, film, table, arm, seed, single, tiles):
    _, _, points, normals = arm
    tile = None if tiles is None else tiles.tile_per_point()
    samples = draw_samples(table, 256, seed)

    def add():
        job = ThirdBounce(scene, film, samples, wall_of(points, normals), tile=tile)
        job.add_single(wall_of(points[:1], normals[:1])) if single else job.add_confocal()

    return captured(film, add)[1].reshape(GRID**2, 40)


def test_tiles_have_to_be_told(arm):
    shapes, scene, points, normals = arm
    tiles = ScanTiles(points, normals, 0.1)
    film = film_of(GRID, GRID)
    film.start_render()
    many = draw_samples(HiddenElements(shapes, tiles.points, tiles.normals), 8, 0)
    one = draw_samples(HiddenElements(shapes, *wall_grid(5)), 8, 0)
    sensors = wall_of(points, normals)
    for samples, tile in ((many, None), (one, tiles.tile_per_point())):
        with pytest.raises(ShapeError, match="tile"):
            ThirdBounce(scene, film, samples, sensors, tile=tile)
    pairs = film_of(GRID, GRID, exhaustive_scan=True, laser_scan_width=GRID, laser_scan_height=GRID)
    pairs.start_render()
    with pytest.raises(SceneError, match="16 tiles"):
        add_exhaustive(ThirdBounce(scene, pairs, many, sensors, tile=tiles.tile_per_point()), sensors)
