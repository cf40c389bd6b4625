"""Tiles of scan points with samples of their own: the same light with less noise where geometry is near."""

import numpy as np
import pytest

from support.hidden_shapes import ball, mesh, scene_of, wall_grid
from support.third_bounce_runs import captured, film_of, wall_of
from torchtransient.plugins.around_corner.shafts import spare_rays
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import ScanTiles, draw_samples

VARIANT = "llvm_ad_mono"
GRID = 8


@pytest.fixture(scope="module")
def arm():
    """10 cm before a scan of 1 m."""
    shapes = [mesh("arm", ball((0.1, 0, 0.25), (0.35, 0.06, 0.12), 3))]
    points, normals = wall_grid(GRID)
    return shapes, scene_of(*shapes), points, normals


@pytest.mark.slow
def test_less_noise_and_no_bias(arm):
    shapes, scene, points, normals = arm
    film = film_of(GRID, GRID, bins=40, bin_width=0.05)
    tiles = ScanTiles(points, normals, 0.1)
    tables = {True: HiddenElements(shapes, tiles.points, tiles.normals), False: HiddenElements(shapes, *wall_grid(5))}
    runs = {}
    for tiled, table in tables.items():
        spare_rays(scene, table, points, normals)
        runs[tiled] = np.array(
            [run(scene, film, table, arm, seed, tiles if tiled else None) for seed in range(64)]
        )
    total = {tiled: r.sum(-1) for tiled, r in runs.items()}
    errors = [r.std(0, ddof=1) / 8 for r in total.values()]
    apart = (total[True].mean(0) - total[False].mean(0)) / np.hypot(*errors)
    # All points share samples, or those of a tile: 64 numbers that are not independent.
    assert np.abs(apart).max() < 4.5 and np.mean(apart**2) < 4
    assert total[True].var(0).sum() < total[False].var(0).sum() / 8


def run(scene, film, table, arm, seed, tiles):
    _, _, points, normals = arm
    tile = None if tiles is None else tiles.tile_per_point()
    samples = draw_samples(table, 256, seed)

    def add():
        ThirdBounce(scene, film, samples, wall_of(points, normals), tile=tile).add_confocal()

    return captured(film, add)[1].reshape(GRID**2, 40)
