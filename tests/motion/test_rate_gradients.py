"""Derivatives of films of rates and of beats against central differences, in both modes."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.rates import VARIANT, hidden_plate, plate, scene
from torchtransient.scenes import look_at, rotate, scale, translate

RATES, AXIS = tt.RateAxis(-12.0, 0.5, 48), tt.TimeAxis(0.0, 0.2, 60)
CHIRPS = tt.Chirps(1e9, 2e-6, 1550e-9)
BEATS = CHIRPS.time_axis((0.5, 6.0), (-6.0, 6.0), bins_per_line=2)
VARIANTS = [VARIANT, "llvm_ad_mono_polarized"]

LAMP = {"type": "point", "position": [0.5, 0.3, -0.5], "intensity": 10.0}
MOTIONS = {
    "back": tt.Motion(linear=(0.3, 0.2, -1.0), angular=(0.1, 0.3, 0.2), center=(0.1, 0, 2)),
    "side": tt.Motion(linear=(0.5, 0.2, -0.4), angular=(0.2, 0.1, 0.1)),
    "lamp": tt.Motion(linear=(0.2, 0.1, 0.3)),
    "sensor": tt.Motion(linear=(0.1, -0.2, 0.5), angular=(0.1, 0.05, 0.02), center=(0.5, 0.8, 0.1)),
}


def room(depth=3, fov=30, **more):
    """Two walls with a gap between them, of which the camera sees one."""
    back = plate((0, 0, 3), (0, 0, 0), half=50)
    side = plate((-2, 0, -6), (0, 0, -6), half=8.5)
    return scene(4, fov, depth, **({"back": back, "side": side, "lamp": LAMP} | more))


def renderer_of(loaded, keys, beats=False, spp=4096, **more):
    film = {"chirps": CHIRPS, "time_axis": BEATS} if beats else {"rates": RATES, "time_axis": AXIS}
    return tt.TransientRenderer(
        loaded, keys, temporal_filter="tent", grad_seed="same", physics="ignore", spp=spp, **film, **more
    )


def loss_of(out):
    """Light weighed by waves over rates and lengths, the other channels by less."""
    light = out.rates if out.beats is None else out.beats
    light = light.reshape(-1, *light.shape[-4:])
    n, m = torch.arange(light.shape[1])[:, None, None, None], torch.arange(light.shape[2])[:, None, None]
    channels = 1 / (1 + torch.arange(light.shape[0]))[:, None, None, None, None]
    return (light * channels * torch.sin(0.21 * n + 0.1) * torch.cos(0.13 * m)).sum()


def direction_of(key, value):
    """A direction in the entries of a parameter; of a pose a shift, and of a shape's a turn and a growth too."""
    generator = torch.Generator().manual_seed(zlib.crc32(key.encode()))
    noise = torch.randn(value.shape, generator=generator)
    if key.endswith("to_world"):
        noise[3] = 0
        if key.startswith("sensor"):
            noise[:, :3] = 0
        return 0.3 * noise
    # Colours and indices grow.
    return torch.full(value.shape, 0.2) if key.endswith(("eta", "value")) else noise


def compare(renderer, directions=None, step=1e-2, seeds=range(4), together=()):
    """Check the gradient by each key of a renderer with differences of the same samples, and both modes at once.

    ``together``: starts of keys whose parameters are changed by one unknown.
    """
    values = {key: value.detach() for key, value in renderer.values.items()}
    directions = {key: direction_of(key, value) for key, value in values.items()} | (directions or {})
    groups: dict[str, list[str]] = {}
    for key in values:
        groups.setdefault(next((start for start in together if key.startswith(start)), key), []).append(key)

    def loss(along, seed):
        moved = {key: values[key] + x * directions[key] for name, x in along.items() for key in groups[name]}
        return loss_of(renderer(moved, seed=seed))

    reverse = []
    for seed in seeds:
        leaves = {key: torch.zeros((), requires_grad=True) for key in groups}
        reverse.append([float(g) for g in torch.autograd.grad(loss(leaves, seed), list(leaves.values()))])
    reverse = np.array(reverse)
    for n, key in enumerate(groups):
        with torch.no_grad():
            pairs = [[float(loss({key: sign * step}, seed)) for sign in (1.0, -1.0)] for seed in seeds]
        differences = np.array(pairs) @ [1, -1] / (2 * step)
        gap, size = reverse[:, n] - differences, abs(differences.mean())
        error = gap.std(ddof=1) / len(gap) ** 0.5
        # Differences over a step are off by its square, and by the rounding of sums over the film.
        assert abs(gap.mean()) < 3 * error + 2e-3 * size, (key, reverse[:, n], differences)
        assert error < 0.1 * size, (key, reverse[:, n], differences)

    def all_at_once(*along):
        return loss(dict(zip(groups, along, strict=True)), seeds[0])

    zeros, ones = (tuple(torch.full((), x) for _ in groups) for x in (0.0, 1.0))
    _, forward = torch.func.jvp(all_at_once, zeros, ones)
    assert float(forward) == pytest.approx(reverse[0].sum(), abs=1e-4 * np.abs(reverse[0]).sum())


def in_variants(quick):
    """Variants for a test, of which one is quick."""
    return [pytest.param(one, marks=() if one == quick else pytest.mark.slow) for one in VARIANTS]


ROOM_KEYS = [
    *(f"{name}.velocity.{part}" for name in MOTIONS for part in ("linear", "angular")),
    "back.velocity.center", "back.bsdf.reflectance.value", "side.bsdf.reflectance.value", "lamp.position",
    "back.to_world", "side.to_world", "sensor.to_world",
]  # fmt: skip


@pytest.mark.parametrize("variant", in_variants(VARIANT))
def test_velocities_colours_places_and_poses_in_a_room(variant):
    """No edge is in play."""
    renderer = renderer_of(tt.load(room(), variant=variant).moving(MOTIONS), ROOM_KEYS, boundary=False)
    compare(renderer, together=[f"{name}.velocity" for name in MOTIONS])


@pytest.mark.slow
@pytest.mark.parametrize("variant", in_variants(VARIANT))
def test_beats_of_a_room(variant):
    keys = ["back.velocity.linear", "side.velocity.angular", "sensor.velocity.linear", "lamp.position"]
    compare(renderer_of(tt.load(room(), variant=variant).moving(MOTIONS), keys, beats=True))


# ------------------------------------------------------------------------------------------------------------ outlines

PLATES = {
    "in view": plate((0.05, 0.02, 2.0), (0.05, 0.02, 0), half=0.24, bsdf={"type": "diffuse", "reflectance": 0.4}),
    "its shadow": plate((0.5, 0.2, 1.4), (0.5, 0.2, 0), half=0.28, bsdf={"type": "diffuse", "reflectance": 0.4}),
}
SIDEWAYS = torch.zeros(4, 4)
SIDEWAYS[:2, 3] = torch.tensor([1.0, 0.5])


@pytest.mark.parametrize(
    ("where", "key"),
    [
        pytest.param("in view", "plate.to_world", marks=pytest.mark.slow),
        pytest.param("in view", "sensor.to_world", marks=pytest.mark.soak),
        pytest.param("its shadow", "lamp.position", marks=pytest.mark.slow),
    ],
)
def test_outlines_that_poses_move(where, key):
    """What they hide and uncover has other rates. No outline comes to the border of a pixel, where differences kink."""
    moving = MOTIONS | {"plate": MOTIONS["back"]}
    del moving["back"]
    loaded = tt.load(room(fov=20, plate=PLATES[where]), variant=VARIANT).moving(moving)
    directions = {key: SIDEWAYS if key.endswith("to_world") else torch.tensor([1.0, 0.5, 0.0])}
    compare(renderer_of(loaded, [key], spp=8192), directions, seeds=range(12))


def behind(bender):
    """A body before a wall, seen in a mirror or through a tilted pane; all move."""
    dark = {"type": "diffuse", "reflectance": 0.4}
    if bender == "mirror":
        lamp, depth = [0.6, 0.5, -0.3], 3
        nodes = {"bender": plate((0, 0, 2), (0.1, 0.05, 0), half=2, bsdf={"type": "conductor"}),
                 "body": plate((0.33, 0.22, -1), (0.33, 0.22, 1), half=0.4, bsdf=dark, up=(0.5, 1, 0)),
                 "wall": plate((0, 0, -2.5), (0, 0, 0), half=9)}  # fmt: skip
    else:
        lamp, depth = [0.6, 0.5, 1.7], 6
        nodes = {"bender": {"type": "cube", "bsdf": {"type": "dielectric", "int_ior": 1.5},
                            "to_world": translate([0, 0, 1.2]) @ rotate([1, 0, 0], 20) @ scale([3, 3, 0.1])},
                 "body": plate((0.05, 0.02, 2.4), (0.05, 0.02, 0), half=0.24, bsdf=dark),
                 "wall": plate((0, 0, 3.2), (0, 0, 0), half=9)}  # fmt: skip
    motions = {"bender": MOTIONS["back"], "body": MOTIONS["side"], "wall": tt.Motion(linear=(0, 0.3, -2.0))}
    nodes = scene(4, 24, depth, **nodes, lamp=LAMP | {"position": lamp})
    return tt.load(nodes, variant=VARIANT).moving(motions | {name: MOTIONS[name] for name in ("sensor", "lamp")})


AWAY = torch.zeros(4, 4)
AWAY[2, 3] = 1.0
SEEN = [
    pytest.param("mirror", "body.to_world", marks=pytest.mark.slow),
    pytest.param("mirror", "lamp.position", marks=pytest.mark.slow),
    pytest.param("mirror", "bender.to_world", marks=pytest.mark.soak),
    pytest.param("pane", "body.to_world", marks=pytest.mark.soak),
    pytest.param("pane", "sensor.to_world", marks=pytest.mark.soak),
]


@pytest.mark.parametrize(("bender", "key"), SEEN)
def test_outlines_and_shadows_behind_a_mirror_or_a_pane_that_moves(bender, key):
    """The light that they hide and uncover has the rate of the whole way. Of poses of a mirror, what moves it away."""
    direction = SIDEWAYS if key.endswith("to_world") else torch.tensor([1.0, 0.5, 0.0])
    compare(renderer_of(behind(bender), [key]), {key: AWAY if key.startswith("bender") else direction}, seeds=range(6))


@pytest.mark.slow
def test_outlines_in_beats():
    loaded = tt.load(room(fov=20, plate=PLATES["in view"]), variant=VARIANT)
    loaded = loaded.moving({"plate": MOTIONS["back"], "side": MOTIONS["side"]})
    renderer = renderer_of(loaded, ["plate.to_world"], beats=True, spp=8192)
    compare(renderer, {"plate.to_world": SIDEWAYS}, seeds=range(12))


# ------------------------------------------------------------------------------------------- glass, meshes, copies, fog


@pytest.mark.soak
def test_velocities_and_index_of_glass():
    """A tilted pane before a wall, with a lamp that paths find."""
    pane = {"type": "cube", "to_world": translate([0, 0, 2.0]) @ rotate([1, 0, 0], 10) @ scale([3, 3, 0.1]),
            "bsdf": {"type": "dielectric", "int_ior": 1.5}}  # fmt: skip
    lamp = {"type": "rectangle", "to_world": look_at([1.5, 0.3, 0.5], [0, 0, 3]) @ scale(0.6),
            "emitter": {"type": "area", "radiance": 10.0}}  # fmt: skip
    moving = {"back": MOTIONS["back"], "pane": tt.Motion(linear=(0, 0.1, 0.5), angular=(0.1, 0, 0))}
    loaded = tt.load(room(7, pane=pane, lamp=lamp), variant=VARIANT).moving(moving)
    keys = ["pane.velocity.linear", "pane.velocity.angular", "back.velocity.linear", "pane.bsdf.eta"]
    compare(renderer_of(loaded, keys, spp=1 << 15), seeds=range(8))


@pytest.mark.slow
def test_velocities_of_vertices():
    vertices = np.array([[-9, -9, 3.0], [9, -9, 3.2], [9, 9, 3.1], [-9, 9, 2.9]])
    speeds = np.array([[0.3, -0.4, 1.2], [0.5, 1.0, -0.7], [0.2, 0.1, 2.0], [-1.0, 0.3, 0.4]])
    sheet = {"type": "mesh_arrays", "vertices": vertices, "faces": np.array([[0, 2, 1], [0, 3, 2]]),
             "vertex_velocity": speeds}  # fmt: skip
    loaded = tt.load(room(back=sheet), variant=VARIANT).moving({"side": MOTIONS["side"]})
    compare(renderer_of(loaded, ["back.vertex_velocity", "side.velocity.linear", "lamp.position"]))


def bent_lamp(**more):
    corners = np.array([[0.5, -0.3, 0.5], [1.3, -0.3, 0.5], [1.3, 0.5, 0.5], [0.5, 0.5, 0.5]])
    lamp = {"type": "mesh_arrays", "vertices": corners, "faces": np.array([[0, 1, 2], [0, 2, 3]]),
            "vertex_velocity": np.random.default_rng(1).normal(size=(4, 3)) * 1.5,
            "emitter": {"type": "area", "radiance": 5.0}}  # fmt: skip
    return tt.load(room(lamp=lamp, **more), variant=VARIANT).moving({name: MOTIONS[name] for name in ("back", "side")})


def test_velocities_of_lamps_whose_vertices_move():
    compare(renderer_of(bent_lamp(), ["lamp.vertex_velocity", "back.velocity.linear"], spp=2048))


@pytest.mark.soak
def test_places_and_shadows_of_lamps_whose_vertices_move():
    grows = {"lamp.vertex_positions": torch.tensor([[0.5, 0, 1], [1, 0.3, 0.5], [0.2, 0.5, 0.8], [0.5, -0.4, 1.2]])}
    compare(renderer_of(bent_lamp(), list(grows)), grows)
    hider = plate((0.5, 0.1, 1.6), (0.9, 0.1, 0.5), half=0.3, up=(0.4, 1, 0))
    compare(renderer_of(bent_lamp(plate=hider), ["plate.to_world"]), {"plate.to_world": SIDEWAYS}, seeds=range(6))


@pytest.mark.slow
def test_wind_on_a_grid():
    """Its numbers, beside the velocity and the colour of the wall behind."""
    data = np.random.default_rng(3).normal(size=(2, 3, 3, 3)).astype(np.float32)
    wind = {"type": "gridvolume", "data": data, "to_world": translate([-5, -5, 0]) @ scale([10, 10, 3])}
    fog = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.8, "id": "mist", "velocity": wind}
    box = {"type": "cube", "to_world": translate([0, 0, 1.5]) @ scale([5, 5, 0.9]), "bsdf": {"type": "null"},
           "interior": fog}  # fmt: skip
    nodes = room(4, box=box)
    nodes["integrator"]["type"] = "transient_prbvolpath"
    loaded = tt.load(nodes, variant=VARIANT).moving({"back": MOTIONS["back"]})
    keys = ["mist.velocity.data", "back.velocity.linear", "back.bsdf.reflectance.value"]
    compare(renderer_of(loaded, keys, spp=2048))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "confocal"])
def test_a_hidden_plate(kind):
    """Around a corner; its outline hides and uncovers nothing but itself."""
    nodes, center, _ = hidden_plate(kind)
    motion = tt.Motion(linear=(0.8, -0.5, -1.6), angular=(0.6, 1.5, 0.4), center=center)
    loaded = tt.load(nodes, variant=VARIANT).moving({"hidden": motion})
    keys = ["hidden.velocity.linear", "hidden.velocity.angular", "hidden.bsdf.reflectance.value", "hidden.to_world"]
    compare(renderer_of(loaded, keys), step=3e-3, seeds=range(8))
