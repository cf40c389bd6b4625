"""Captures of the third-bounce fast path for tests, and the same light by brute force."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.hidden_shapes import scene_of, wall_grid
from torchtransient.plugins.around_corner.geometry import WallPoints
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import draw_samples

WALL_ALBEDO = 0.9


def film_of(width, height, start=0.0, bins=64, bin_width=0.1, **arguments):
    node = {"type": "transient_hdr_film", "temporal_bins": bins, "bin_width_opl": bin_width, "start_opl": start}
    if arguments.get("type", "transient_hdr_film") != "transient_hdr_film":
        node = {}
    return mi.load_dict({**node, "width": width, "height": height, "rfilter": {"type": "box"}, **arguments})


def wall_of(points, normals, albedo=WALL_ALBEDO, leg=0.0):
    return WallPoints(mi.Point3f(np.transpose(points)), mi.Normal3f(np.transpose(normals)), albedo / np.pi, leg)


def table_of(shapes):
    return HiddenElements(shapes, *wall_grid(5))


def captured(film, run, samples=1):
    """(steady, array) as numpy, after ``run`` has added light to the prepared film."""
    film.start_render(samples)
    run()
    film.finish_render()
    return tuple(np.array(a, dtype=float) for a in film.develop())


def confocal(shapes, points, normals, film, count, seed=0, scene=None):
    scene = scene_of(*shapes) if scene is None else scene
    sensors = wall_of(points, normals)
    samples = draw_samples(table_of(shapes), count, seed)
    return captured(film, lambda: ThirdBounce(scene, film, samples, sensors).add_confocal(), count)


def single(shapes, points, normals, spot, film, count, seed=0):
    scene = scene_of(*shapes)
    samples = draw_samples(table_of(shapes), count, seed)
    job = lambda: ThirdBounce(scene, film, samples, wall_of(points, normals)).add_single(wall_of(*spot))  # noqa: E731
    return captured(film, job, count)


class BruteForce:
    """Light of single pairs of spot and scan point, by points that are uniform over the area of meshes: Mitsuba's own
    points and rays, geometry in double precision.
    """

    def __init__(self, shapes, count, seed=1, others=()):
        """``count`` points for each shape; ``others`` only stand in the way."""
        self.scene, self.count = scene_of(*shapes, *others), count
        rng = np.random.default_rng(seed)
        self.parts = []
        for shape in shapes:
            ps = shape.sample_position(0.0, mi.Point2f(rng.random((2, count)).astype(np.float32)))
            dr.eval(ps)
            weight = float(shape.surface_area()[0]) / count
            two_sided = mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.BackSide)
            self.parts.append((ps, np.array(ps.p, float).T, np.array(ps.n, float).T, weight, two_sided))

    def events(self, spot, point, albedo=0.7):
        """(values, lengths, standard error of their sum) of the light from ``spot`` to ``point``, each (p, n)."""
        values, lengths, variance = [], [], 0.0
        for ps, x, n, weight, two_sided in self.parts:
            (gl, rl), (gs, rs) = (self._factor(ps, x, n, two_sided, *end) for end in (spot, point))
            f = np.where(gl * gs > 0, np.abs(gl * gs), 0) * weight * albedo / np.pi * (WALL_ALBEDO / np.pi) ** 2
            values.append(f)
            lengths.append(rl + rs)
            variance += f.var(ddof=1) * len(f)
        return np.concatenate(values), np.concatenate(lengths), variance**0.5

    def _factor(self, ps, x, n, two_sided, p, normal):
        """Cosines over the squared distance, negative on the back of the hidden surface, and the distance."""
        d = np.asarray(p) - x
        r = np.linalg.norm(d, axis=1)
        cos, wall = (n * d).sum(1) / r, -(d @ np.asarray(normal, float)) / r
        g = np.where(two_sided, cos, np.maximum(cos, 0)) * np.maximum(wall, 0) / r**2
        si = dr.zeros(mi.Interaction3f, len(x))
        si.p, si.n = ps.p, ps.n
        end = mi.Point3f(np.asarray(p, float) + 1e-4 * np.asarray(normal, float))
        return np.where(np.array(self.scene.ray_test(si.spawn_ray_to(end))), 0, g), r
