"""Every film through its own interface: the same light as the histogram has, whatever the number of lanes a pixel."""

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mannequin, mesh, scene_of, wall_grid
from support.marks import long
from support.third_bounce_runs import captured, film_of, table_of, wall_of
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.shared_samples import draw_samples

VARIANT = "llvm_ad_mono"
GRID, COUNT, START, WIDTH, BINS = 2, 500, 1.2, 0.05, 40


@pytest.fixture(scope="module")
def body():
    shapes = [mesh("a", mannequin(1))]
    return scene_of(*shapes), draw_samples(table_of(shapes), COUNT, 2)


@pytest.fixture
def run(body):
    points, normals = wall_grid(GRID, 0.4)
    sensors = wall_of(points, normals, leg=[0.1, 0.2, 0.0, 0.3])

    def of(film, spot=False, **arguments):
        def add():
            job = ThirdBounce(body[0], film, body[1], sensors, 3.0, **arguments)
            job.add_single(wall_of(points[:1], normals[:1], leg=0.05)) if spot else job.add_confocal()

        return captured(film, add, COUNT)

    return of


def histogram(**arguments):
    return film_of(GRID, GRID, START, BINS, WIDTH, **arguments)


@pytest.mark.parametrize("spot", [False, True])
@pytest.mark.parametrize("filter_name", ["box", "tent", "gaussian"])
def test_bins_and_what_is_outside_are_the_steady_image(run, filter_name, spot):
    more = {"gaussian_stddev": 2.0} if filter_name == "gaussian" else {}
    film = film_of(GRID, GRID, 2.4, 3, WIDTH, temporal_filter=filter_name, **more)
    steady, cube = run(film, spot)
    assert cube.sum() + film.energy_before + film.energy_after == pytest.approx(steady.sum(), rel=1e-5)
    assert min(film.energy_before, film.energy_after) > 0.05 * steady.sum()


def test_a_film_without_a_steady_image_leaves_out_what_it_cannot_see(run):
    _, cube = run(histogram())
    steady, same = run(histogram(steady=False))
    assert same == pytest.approx(cube, rel=1e-6) and steady.sum() == pytest.approx(cube.sum(), rel=1e-6)


@pytest.mark.parametrize("spot", [False, True])
def test_phasors_are_the_transform_of_fine_bins(run, spot):
    frequencies = [0.0, 0.7, 2.5]
    fine = film_of(GRID, GRID, 0.0, 4096, 0.001)
    _, cube = run(fine, spot)
    film = film_of(GRID, GRID, type="phasor_hdr_film", frequencies="0, 0.7, 2.5", start_opl=0.3)
    steady, phasors = run(film, spot)
    centers = 0.001 * (np.arange(4096) + 0.5) - 0.3
    for f, frequency in enumerate(frequencies):
        expected = (cube[..., 0] * np.exp(-2j * np.pi * frequency * centers)).sum(-1)
        found = phasors[:, :, f, 0] + 1j * phasors[:, :, f, 1]
        # Within a bin the phase changes by 2 pi nu 0.5 mm at most, at random.
        assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()
    assert steady[..., 0] == pytest.approx(phasors[:, :, 0, 0], rel=1e-5)


def test_gates_are_sums_of_bins(run):
    _, cube = run(histogram())
    film = film_of(GRID, GRID, type="gated_hdr_film", gates="rectangular 1.2 2.2; rectangular 2.2 3.2")
    _, gated = run(film)
    expected = cube.reshape(GRID, GRID, 2, 20, 1).sum(3)
    assert gated == pytest.approx(expected, rel=1e-5)


def test_legs_are_path_length(body):
    points, normals = wall_grid(GRID, 0.4)
    cubes = []
    for leg in (0.0, 0.1):
        film = histogram()
        sensors = wall_of(points, normals, leg=leg)
        cubes.append(captured(film, lambda s=sensors, f=film: ThirdBounce(body[0], f, body[1], s).add_confocal())[1])
    # To the scan point and back: 0.2 m, four bins; what lies at the rim of a bin may be rounded to either side.
    moved = np.abs(cubes[1][:, :, 4:] - cubes[0][:, :, :-4]).sum()
    assert moved < 0.01 * cubes[0].sum()


@pytest.mark.slow
@pytest.mark.parametrize("vertex_normals", long([False, True], [True]))
def test_colours(vertex_normals):
    """Every channel of a single and a confocal capture is one of its own albedo and energy."""

    def captures(albedo, energy, variant):
        with mi.variant_context(variant):
            shapes = [mesh("a", mannequin(1), albedo, two_sided=True, vertex_normals=vertex_normals)]
            scene, samples = scene_of(*shapes), draw_samples(table_of(shapes), 128, 2)
            points, normals = wall_grid(GRID, 0.4)
            sensors, laser, film = wall_of(points, normals), wall_of(points[:1], normals[:1]), histogram()
            job = lambda: ThirdBounce(scene, film, samples, sensors, mi.UnpolarizedSpectrum(energy))  # noqa: E731
            return [captured(film, lambda: job().add_confocal())[1], captured(film, lambda: job().add_single(laser))[1]]

    rgb = captures({"type": "rgb", "value": [0.2, 0.5, 0.8]}, [1.0, 2.0, 3.0], "llvm_ad_rgb")
    for channel, (albedo, energy) in enumerate(((0.2, 1.0), (0.5, 2.0), (0.8, 3.0))):
        for found, expected in zip(rgb, captures(albedo, energy, "llvm_ad_mono"), strict=True):
            assert found[..., channel] == pytest.approx(expected[..., 0], rel=1e-5, abs=1e-7 * expected.max())
