"""Derivatives where hidden things hide each other: the boundary term against finite differences."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.hidden_shapes import ball, folded_plates, join, mannequin, mesh
from support.marks import long, long_rows
from support.moved_captures import MovedCapture, agree, move, turn
from support.nlos_scenes import film, plane, scan_scene, transform
from torchtransient.errors import ArgumentError, GradientWarning, TorchTransientWarning

VARIANT = "llvm_ad_mono"
SIGMAS = 4.0
SMOOTH = {"start": 1.0, "width": 0.05, "bins": 100, "temporal_filter": "tent"}


def plates(**changes):
    return {"back": plane(1.2) | changes, "front": plane(0.9, 0.3, 0.22, 0.1)}


def capture_of(hidden, keys, change, kind="confocal", points=4, response=None, **integrator):
    response = response or film(points, **SMOOTH)
    return MovedCapture(scan_scene(hidden, kind, response, **integrator), keys, change)


MOVED = {
    "front, sideways": ("front.to_world", move(1, 0, 0)),
    "wall, sideways": ("wall.to_world", move(1, 0, 0)),
    "wall, depth": ("wall.to_world", move(0, 0, 1)),
    "front, depth": ("front.to_world", move(0, 0, 1)),
    "back, sideways": ("back.to_world", move(1, 0, 0)),
    "back, depth": ("back.to_world", move(0, 0, 1)),
    "front turns": ("front.to_world", turn((0.22, 0.1, 0.9))),
}
# Both kinds by turns.
PAIRS = [(case, ("single", "confocal")[n % 2]) for n, case in enumerate(MOVED)]


@pytest.mark.parametrize(("case", "kind"), long_rows(PAIRS, PAIRS[:1]))
def test_a_plate_before_a_plate(case, kind):
    """What hides, what is hidden and the viewpoints move; without the boundary term the derivative is some other, above
    all where outlines move sideways.
    """
    interior, whole, error = agree(capture_of(plates(), *MOVED[case], kind), most_error=0.05)
    if "sideways" in case:
        assert abs(interior - whole) > 10 * error


EXHAUSTIVE = {
    "front, sideways": (2, 2**12, 2**14, 0.05), "wall, sideways": (3, 2**13, 2**17, 0.01),
}  # fmt: skip


@pytest.mark.parametrize("case", long(EXHAUSTIVE, []))
def test_every_pair_of_an_exhaustive_capture(case):
    """Spots are the scanned points, so that many pairs have outlines in common, which count once."""
    points, spp, spp_differences, most_error = EXHAUSTIVE[case]
    capture = capture_of(plates(), *MOVED[case], "exhaustive", response=film(points, kind="exhaustive", **SMOOTH))
    interior, whole, error = agree(capture, spp, 4, spp_differences, 8, most_error=most_error)
    assert abs(interior - whole) > 5 * error


@pytest.mark.slow
def test_paths_have_the_same_term():
    capture = capture_of(plates(), "front.to_world", move(1, 0, 0), "single", third_bounce="paths", max_depth=4)
    agree(capture, 2**13, spp_differences=2**14, most_error=0.05)


FILMS = {
    "without a steady image": lambda: film(4, **SMOOTH, steady=False),
    "phasors": lambda: {"type": "phasor_hdr_film", "width": 4, "height": 4, "rfilter": {"type": "box"},
                        "frequencies": "0.5, 1.0, 2.5"},
    "gates": lambda: {"type": "gated_hdr_film", "width": 4, "height": 4, "rfilter": {"type": "box"},
                      "gates": "gaussian 2.0 0.3; gaussian 2.6 0.4"},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FILMS)
def test_films(name):
    capture = capture_of(plates(), "front.to_world", move(1, 0, 0), "single", response=FILMS[name]())
    # Of the flanks of gates differences are noisier than the derivative.
    agree(capture, 2**13, spp_differences=2**17 if name == "gates" else 2**16, most_error=0.05)


TWO_SIDED = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.6}}
MATERIALS = {
    "two-sided": TWO_SIDED,
    "metal": {"type": "roughconductor", "alpha": 0.4},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MATERIALS)
def test_materials(name):
    capture = capture_of(plates(bsdf=MATERIALS[name]), "front.to_world", move(1, 0, 0), "single")
    agree(capture, 2**13, most_error=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono_polarized"])
def test_variants(variant):
    mi.set_variant(variant)
    try:
        coloured = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
        material = MATERIALS["metal"] if "polarized" in variant else coloured
        agree(capture_of(plates(bsdf=material), "front.to_world", move(1, 0, 0), "single"), 2**13, most_error=0.05)
    finally:
        mi.set_variant(VARIANT)


@pytest.mark.slow
def test_a_ball_behind_a_plate():
    """What is hidden need not be a mesh; it may move, too."""
    hidden = {
        "ball": {"type": "sphere", "center": [0.1, 0, 1.3], "radius": 0.35, "bsdf": {"type": "diffuse"}},
        "front": plane(0.9, 0.3, 0.22, 0.1),
    }
    agree(capture_of(hidden, "ball.to_world", move(1, 0, 0), "single"), most_error=0.05)


@pytest.mark.slow
def test_a_box_of_six_plates_is_a_cube():
    """Rims at which shapes meet are one edge."""
    base = transform().translate([0.1, 0.05, 0.8]).rotate([0.3, 1, 0.2], 25).scale(0.12)
    turns = [([0, 1, 0], angle) for angle in (0, 90, 180, 270)] + [([1, 0, 0], 90), ([1, 0, 0], -90)]
    bsdf = {"type": "diffuse", "reflectance": 0.6}
    box = {
        f"side{i}": {"type": "rectangle", "to_world": base @ transform().rotate(*t).translate([0, 0, 1]), "bsdf": bsdf}
        for i, t in enumerate(turns)
    }
    behind = {"back": plane(1.3, 1.2)}
    six = capture_of(box | behind, [f"{name}.to_world" for name in box], move(1, 0, 0), "single")
    cube = capture_of({"cube": {"type": "cube", "to_world": base, "bsdf": bsdf}} | behind, "cube.vertex_positions",
                      move(1, 0, 0), "single")  # fmt: skip
    found = [np.array([c.reverse(seed, 2**13) for seed in range(6)]) for c in (six, cube)]
    error = np.hypot(*(x.std(ddof=1) / 6**0.5 for x in found))
    assert abs(found[0].mean() - found[1].mean()) < 4.5 * error
    assert error < 0.01 * abs(found[1].mean())
    agree(cube, 2**13, most_error=0.03)


@pytest.mark.slow
def test_what_hides_may_stand_still():
    """Edges of static shapes count where what is behind them moves; bodies that stand before one another at rest in
    derivatives of others do not.
    """
    far = plates() | {"far": plane(1.0, 0.1, 1.7)}
    # A point of an edge for four paths, and at least one.
    capture = capture_of(plates(), "back.to_world", move(1, 0, 0))
    for spp, of_edges in ((64, 16), (7, 1), (2, 1)):
        assert {job.spp for job in capture.boundary(spp).jobs} == {of_edges}
    assert capture_of(far, "far.to_world", move(1, 0, 0)).boundary() is None
    assert capture_of(far, "wall.to_world", move(1, 0, 0)).boundary() is not None
    assert capture_of(plates(), "back.bsdf.reflectance.value", lambda start, θ: start + θ).boundary() is None


@pytest.mark.slow
def test_points_of_the_capture_move():
    points = np.stack(np.meshgrid(*[(np.arange(3) - 1) * 0.3] * 2), -1).reshape(-1, 2)
    scene = scan_scene(plates(), "single", film(3, **SMOOTH))
    meter = scene["wall"]["sensor"]
    meter["points"] = mi.TensorXf(np.float32(np.c_[points, 0 * points[:, :1]]))
    meter["laser_points"] = mi.TensorXf(np.float32([[-0.2, 0.13, 0.0]]))
    for key in ("wall.sensor.points", "wall.sensor.laser_points"):
        agree(MovedCapture(scene, key, move(1, 0, 0)), most_error=0.03)


# --------------------------------------------------------------------------------------------- where there is none

ALONE = {
    "a body": lambda: {"front": mesh("front", ball([0, 0, 0.9], [0.1, 0.2, 0.1]))},
    "plates side by side": lambda: {"front": plane(0.9, 0.3, -0.3), "back": plane(0.9, 0.3, 0.3)},
    "a ball behind a plate that is not in its way": lambda: {
        "front": plane(0.5, 0.1, -0.9), "back": {"type": "sphere", "center": [0.9, 0, 1.2], "radius": 0.1}},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONE)
def test_what_hides_nothing_costs_nothing(name):
    key = "front.vertex_positions" if name == "a body" else "front.to_world"
    assert capture_of(ALONE[name](), key, move(1, 0, 0)).boundary() is None


def test_outlines_without_edges_are_told():
    hidden = {"ball": {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.1}, "back": plane(1.2)}
    with pytest.warns(TorchTransientWarning, match="'ball' hides 'back'"):
        assert capture_of(hidden, "ball.to_world", move(1, 0, 0)).boundary() is None


def test_the_table_of_parameters_says_so():
    def reason(kind="confocal", **integrator):
        scene = tt.load(scan_scene(plates(), kind, film(2, kind=kind, **SMOOTH), **integrator))
        return scene.parameters()["front.to_world"].reason

    for kind in ("confocal", "exhaustive"):
        assert "without triangles" in reason(kind) and "more than three" not in reason(kind, max_depth=5)
    untraced = reason(nlos_laser_sampling=False, laser={"type": "projector"})
    assert untraced.startswith("correct except where silhouettes move")


def test_polarized_late_light_is_said_to_lack_it():
    """At the first call; and no samples of edges can be asked for by the pixel."""
    scene = tt.load(scan_scene(plates(), "confocal", film(2, **SMOOTH), max_depth=5), variant="llvm_ad_mono_polarized")
    try:
        with pytest.warns(GradientWarning, match=r"'front\.to_world' .* more than three bounces"):
            tt.TransientRenderer(scene, ["front.to_world"], spp=1)(seed=0)
    finally:
        mi.set_variant(VARIANT)
    with pytest.raises(ArgumentError, match="spp_boundary"):
        tt.TransientRenderer(scene, ["front.to_world"], spp_boundary=4)


# ------------------------------------------------------------------------------------------------------- bodies


def arm_and_rest():
    z = 1.2
    rest = join(
        ball([0, 0.55, z], [0.11, 0.14, 0.12]), ball([0, 0.15, z], [0.2, 0.28, 0.13]),
        ball([0.12, -0.38, z], [0.08, 0.34, 0.09]), ball([-0.12, -0.38, z], [0.08, 0.34, 0.09]),
        ball([0.33, 0.2, z - 0.05], [0.22, 0.06, 0.06]),
    )  # fmt: skip
    return {"rest": mesh("rest", rest), "body": mesh("body", ball([-0.2, 0.2, z - 0.27], [0.06, 0.06, 0.24]))}


BODIES = {
    "a mannequin turns": (lambda: {"body": mesh("body", mannequin())}, turn((0, 0, 1.2))),
    "its arm moves sideways": (arm_and_rest, move(1, 0, 0)),
    "a fold and a plate turn": (lambda: {"body": mesh("body", folded_plates())}, turn((0, 0, 1.2))),
}


@pytest.mark.slow
@pytest.mark.parametrize(("case", "kind"), [*zip(BODIES, ("confocal", "single", "confocal"), strict=True)])
def test_bodies_of_many_parts(case, kind):
    hidden, change = BODIES[case]
    capture = capture_of(hidden(), "body.vertex_positions", change, kind)
    agree(capture, 2**15, 6, 2**19, 12, 1.5e-3, most_error=0.05)
