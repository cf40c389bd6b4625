"""Exhaustive captures: reciprocity, bands of a film, and colours of both sides."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, folded_plates, mannequin, mesh, plate, scene_of, wall_grid
from support.third_bounce_runs import captured, film_of, table_of, wall_of
from torchtransient.errors import SceneError
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner import third_bounce
from torchtransient.plugins.around_corner.late_light import LateLight
from torchtransient.plugins.around_corner.launches import ScanJob
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce, add_exhaustive
from torchtransient.plugins.sampling.shared_samples import draw_samples

VARIANT = "llvm_ad_mono"
SCENES = {
    "body": lambda **a: [mesh("a", mannequin(1), **a)],
    "V and plate": lambda **a: [mesh("a", folded_plates(), two_sided=True, **a)],
    "smooth": lambda **a: [mesh("a", ball((0, 0, 1), (0.4, 0.3, 0.2), 1), vertex_normals=True, **a)],
}
GRID, COUNT = 3, 130


def films(bins=60, start=1.0):
    one = film_of(GRID, GRID, start=start, bins=bins, bin_width=0.05)
    pairs = {"exhaustive_scan": True, "laser_scan_width": GRID, "laser_scan_height": GRID}
    return one, film_of(GRID, GRID, start=start, bins=bins, bin_width=0.05, **pairs)


class Runs:
    def __init__(self, shapes, leg=0.0):
        self.scene, self.samples = scene_of(*shapes), draw_samples(table_of(shapes), COUNT, 2)
        points, normals = wall_grid(GRID, 0.4)
        self.sensors = wall_of(points, normals, leg=np.linspace(0, leg, GRID**2))
        self.spots = wall_of(points, normals, leg=np.linspace(leg, 0, GRID**2))
        self.one, self.pairs = films()

    def job(self, film):
        return ThirdBounce(self.scene, film, self.samples, self.sensors, 2.5)

    def exhaustive(self, spots=None, **arguments):
        spots = self.sensors if spots is None else spots
        run = lambda: add_exhaustive(self.job(self.pairs), spots, **arguments)  # noqa: E731
        steady, cube = captured(self.pairs, run)
        return steady, cube.reshape(GRID**2, GRID**2, *cube.shape[4:])


@pytest.mark.parametrize(("name", "bins", "samples"), [("body", 60, 1), ("V and plate", 30, 1), ("body", 60, 2**40)])
def test_reciprocity_is_exact(monkeypatch, name, bins, samples):
    """In numbers of four or one, of single or double precision, and so many scan points at a time."""
    runs = Runs(SCENES[name]())
    runs.pairs = films(bins)[1]
    start = type(runs.pairs).start_render
    monkeypatch.setattr(type(runs.pairs), "start_render", lambda film, count: start(film, samples))
    monkeypatch.setattr(third_bounce, "MOST_MIRRORED", 2 * GRID**2 * bins)
    steady, cube = runs.exhaustive()
    assert np.array_equal(cube, cube.transpose(1, 0, 2, 3))
    whole_steady, whole = runs.exhaustive(reciprocal=False)
    assert np.array_equal(cube, whole)
    assert steady == pytest.approx(whole_steady, rel=1e-6)


@pytest.mark.parametrize("rows", [1, 2])
def test_bands_of_a_film_hold_what_it_holds(monkeypatch, rows):
    """Of scans that are not square, whoever finds the light."""
    shapes = [mesh("a", folded_plates(), two_sided=True)]
    scene, samples, elements = scene_of(*shapes), draw_samples(table_of(shapes), 40, 2), table_of(shapes)
    points, normals = (each[:6] for each in wall_grid(3, 0.4))
    sensors, spots = wall_of(points, normals), wall_of(points[:4], normals[:4])
    pairs = film_of(2, 3, 1.0, 30, 0.1, exhaustive_scan=True, laser_scan_width=4, laser_scan_height=1)
    one = film_of(2, 3, 1.0, 30, 0.1)

    def runs():
        for film, kind, lasers in ((pairs, "EXHAUSTIVE", spots), (one, "CONFOCAL", sensors)):
            film.start_render(1)
            third = ThirdBounce(scene, film, samples, sensors)
            third.add_confocal() if film is one else add_exhaustive(third, spots)
            yield held_by(film)
            film.start_render(1)
            with dr.suspend_grad():
                LateLight(ScanJob(scene, film, sensors), elements, lasers, CaptureType[kind], (4, 5)).add(32, 0)
            yield held_by(film)

    whole = list(runs())
    monkeypatch.setattr(type(one), "band_rows", lambda film: rows)
    assert len(one.band_layout()) == len(pairs.band_layout()) == -(-3 // rows)
    for found, expected in zip(runs(), whole, strict=True):
        for a, b in zip(found, expected, strict=True):
            assert b.max() > 0
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6 * b.max())


def held_by(film):
    return np.array(film.steady), np.concatenate([np.array(values) for _, _, values in film.bands])


def test_interpolated_normals_are_not_reciprocal():
    runs = Runs(SCENES["smooth"]())
    _, cube = runs.exhaustive()
    assert not np.allclose(cube, cube.transpose(1, 0, 2, 3), rtol=1e-3)
    with pytest.raises(SceneError, match="reciprocity"):
        runs.exhaustive(reciprocal=True)


def test_colours_of_the_other_side():
    """A sheet has the colour of the side that it turns towards the wall."""
    colours = [0.1, 0.5, 0.8], [0.9, 0.3, 0.2]
    v, f = plate(0.5, 0.4, (0.1, 0, 0.9))
    found = []
    with mi.variant_context("llvm_ad_rgb"):
        front, back = ({"type": "rgb", "value": list(colour)} for colour in colours)
        for faces in (f, f[:, ::-1]):
            runs = Runs([mesh("a", (v, faces), front, two_sided=True, back=back)])
            job = lambda film, runs=runs: ThirdBounce(runs.scene, film, runs.samples, runs.sensors, 1.0)  # noqa: E731
            add = lambda runs=runs, job=job: add_exhaustive(job(runs.pairs), runs.sensors)  # noqa: E731
            found.append(captured(runs.pairs, add)[1].reshape(-1, 3).sum(0))
    away = np.cross(*(v[f[0][1:]] - v[f[0][0]]))[2] > 0
    expected = colours[::-1] if away else colours
    np.testing.assert_allclose([c / c[1] for c in found], [np.divide(c, c[1]) for c in expected], rtol=1e-4)
