"""Rates of path lengths of scenes that move against closed forms, to 1e-4 m/s."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.rates import AXIS, RATES, VARIANT, close, hidden_plate, mean_length, mean_rate, plate, rates_of, scene
from torchtransient.scenes import look_at, rotate, scale, translate

SPEED, WAVELENGTH = 1.37, 1550e-9


def rate_of(description, motions=None, **settings):
    """Mean rate of a scene of one pixel."""
    return float(mean_rate(rates_of(description, motions, **settings)))


# ----------------------------------------------------------------------------------------------------------- one wall


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_mono_polarized"])
def test_a_wall_head_on_has_the_doppler_shift_of_lidars(variant):
    """f_D = 2 v / wavelength; the light arrives after twice the distance and is that of the wall at rest."""
    nodes = scene(wall=plate((0, 0, 2), (0, 0, 0)))
    light = rates_of(nodes, {"wall": tt.Motion(linear=(0, 0, -SPEED))}, variant=variant)
    shift = -float(mean_rate(light)) / WAVELENGTH
    assert shift == pytest.approx(2 * SPEED / WAVELENGTH, rel=1e-5)
    assert float(mean_length(light)) == pytest.approx(4.0, abs=1e-4)
    still = tt.TransientRenderer(tt.load(nodes, variant=variant), time_axis=AXIS, spp=256)(seed=0)
    assert float(light.sum()) == pytest.approx(float(still.transient.reshape(-1, AXIS.num_bins)[0].sum()), rel=1e-4)


@pytest.mark.parametrize(("distance", "speed"), [(1e-2, 1e6), (1e5, 1e-6)])
def test_near_and_far_walls_that_creep_and_fly(distance, speed):
    """Mean rate, its derivative by the velocity in both modes, relative to the speed."""
    nodes = scene(wall=plate((0, 0, distance), (0, 0, 0), half=distance))
    nodes["sensor"] |= {"near_clip": 1e-3 * distance, "far_clip": 1e3 * distance}
    rates, axis = tt.RateAxis(-4 * speed, 0.1 * speed, 80), tt.TimeAxis(0.0, distance, 3)
    moving = tt.load(nodes, variant=VARIANT).moving({"wall": tt.Motion(linear=(0, 0, -speed))})
    key = "wall.velocity.linear"
    renderer = tt.TransientRenderer(moving, [key], rates=rates, time_axis=axis, spp=64, physics="ignore")
    centers = rates.centers.float()[:, None, None, None]

    def mean(value):
        light = renderer({key: value}, seed=0).rates
        return (light * centers).sum() / light.sum()

    base, along = torch.tensor([0.0, 0.0, -speed], requires_grad=True), torch.tensor([0.0, 0.0, 1.0])
    found = mean(base)
    found.backward()
    _, tangent = torch.func.jvp(mean, (base.detach(),), (along,))
    assert float(found.detach()) / speed == pytest.approx(-2.0, abs=1e-4)
    assert float(base.grad[2]) == pytest.approx(2.0, rel=1e-3) and float(tangent) == pytest.approx(2.0, rel=1e-3)


def test_described_velocities_are_those_of_motions(tmp_path):
    """In a dictionary as a child of the wall, and in XML."""
    child = {"type": "rigid_motion", "linear": [0, 0, -SPEED], "angular": [0.2, 0.1, 0.0], "center": [0.1, 0.0, 2.0]}
    motion = tt.Motion(linear=(0, 0, -SPEED), angular=(0.2, 0.1, 0.0), center=(0.1, 0, 2))
    described = rates_of(scene(4, 20, wall=plate((0, 0, 2), (0, 0, 0), velocity=child)))
    given = rates_of(scene(4, 20, wall=plate((0, 0, 2), (0, 0, 0))), {"wall": motion})
    torch.testing.assert_close(described, given, rtol=1e-5, atol=1e-9)
    text = f"""<scene version="3.0.0">
      <integrator type="transient_path"><integer name="max_depth" value="2"/></integrator>
      <emitter type="point"><point name="position" value="0, 0, 0"/></emitter>
      <sensor type="perspective"><float name="fov" value="0.02"/><float name="near_clip" value="1e-3"/>
        <film type="transient_hdr_film"><integer name="width" value="1"/><integer name="height" value="1"/></film>
      </sensor>
      <shape type="rectangle" id="wall">
        <transform name="to_world"><rotate y="1" angle="180"/><translate z="2"/></transform>
        <texture type="rigid_motion" name="velocity"><vector name="linear" value="0, 0, {-SPEED}"/></texture>
      </shape>
    </scene>"""
    path = tmp_path / "wall.xml"
    path.write_text(text, encoding="utf-8")
    assert rate_of(tt.load(path, variant=VARIANT)) == pytest.approx(-2 * SPEED, abs=1e-4)


def test_films_without_rates_do_not_feel_velocities():
    """The light of the same samples is the same, bit by bit."""
    loaded = tt.load(corner_of_three(), variant=VARIANT)
    moving = loaded.moving(dict.fromkeys(("a", "sensor", "lamp"), tt.Motion(linear=(1.0, 2.0, 3.0))))
    still, found = (tt.render(one, time_axis=AXIS, spp=16, seed=0) for one in (loaded, moving))
    assert torch.equal(still.transient, found.transient) and float(still.transient.sum()) > 0


@pytest.mark.parametrize("degrees", [0.0, 60.0])
def test_a_wall_that_slides_in_its_plane(degrees):
    """Nothing of the picture changes, but material points move along the line of sight: 2 v sin(tilt)."""
    tilt = math.radians(degrees)
    normal, along = (math.sin(tilt), 0, -math.cos(tilt)), np.array([math.cos(tilt), 0, math.sin(tilt)])
    nodes = scene(wall=plate((0, 0, 2), (normal[0], 0, 2 + normal[2])))
    found = rate_of(nodes, {"wall": tt.Motion(linear=SPEED * along)})
    assert found == pytest.approx(2 * SPEED * math.sin(tilt), abs=1e-4)


def test_a_rotating_disc_is_a_linear_map_of_rates():
    """Rate times distance over the picture of a tilted disc is -2 (omega x c) . p, a linear function of the point p.
    Each pixel is the mean over its area, by quadrature; the strata of the samples leave less than 1e-4 m/s.
    """
    size, fov, center, turns = 24, 10.0, np.array([0.05, -0.03, 2.0]), 6.0
    normal = np.array([0.6, 0.0, -0.8])
    pose = look_at(tuple(center), tuple(center + normal), (0, 1, 0)) @ scale(0.15)
    disc = {"type": "disk", "to_world": pose, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    nodes = scene(size, fov, sampler="owen", disc=disc)
    motion = tt.Motion(angular=turns * normal, center=center)
    found = mean_rate(rates_of(nodes, {"disc": motion}, spp=4096)).numpy()
    # +x of the camera is left in the picture.
    edges, fine = np.tan(np.radians(fov) / 2), 8
    k = edges * (1 - (np.arange(size * fine) + 0.5) / (size * fine) * 2)
    d = np.stack(np.broadcast_arrays(k[None, :], k[:, None], 1.0), -1)
    cosine = 1 / np.linalg.norm(d, axis=-1)
    d *= cosine[..., None]
    p = d * ((center @ normal) / (d @ normal))[..., None]
    distance = np.linalg.norm(p, axis=-1)
    # Samples are uniform in the picture.
    weight = np.abs(d @ normal) / distance**2
    rate = -2 * (p @ np.cross(turns * normal, center)) / distance

    def pixels(x):
        return x.reshape(size, fine, size, fine).sum((1, 3))

    expected = pixels(weight * rate) / pixels(weight)
    inside = pixels(np.linalg.norm(p - center, axis=-1) < 0.149) == fine**2
    assert inside.sum() > 150 and np.abs(expected[inside]).max() > 0.9
    assert np.abs(found - expected)[inside].max() < 1e-4


# ------------------------------------------------------------------------------------------------------ mirrors, glass

MIRROR_AT, MIRROR_NORMAL = np.array([0, 0, 2.0]), np.array([1, 0, -1]) / math.sqrt(2)


def mirror_scene():
    lamp = np.array([1.5, 0, 2.0])
    mirror = plate(tuple(MIRROR_AT), tuple(MIRROR_AT + MIRROR_NORMAL), half=0.5, bsdf={"type": "conductor"})
    pose = look_at(tuple(lamp), tuple(MIRROR_AT)) @ scale(0.3)
    return scene(mirror=mirror, lamp={"type": "rectangle", "to_world": pose, "emitter": {"type": "area"}}), lamp


def test_a_mirror_moves_the_image_of_a_lamp():
    """By 2 (v . n) n, n the normal; sliding does nothing. One that turns moves the point that is seen."""
    nodes, lamp = mirror_scene()
    loaded, n = tt.load(nodes, variant=VARIANT), MIRROR_NORMAL
    image = lamp - 2 * ((lamp - MIRROR_AT) @ n) * n
    towards = n @ image / np.linalg.norm(image)
    for v in (1.1 * n, np.array([0.9, 0.4, 0.9]), np.array([0.3, -2.0, 1.2])):
        assert rate_of(loaded, {"mirror": tt.Motion(linear=v)}) == pytest.approx(2 * (v @ n) * towards, abs=1e-4)
    turning = tt.Motion(angular=(0, 3, 0), center=MIRROR_AT + np.array([0.1, 0, 0.1]))
    v = np.cross([0, 3, 0], [-0.1, 0, -0.1])
    assert rate_of(loaded, {"mirror": turning}) == pytest.approx(2 * (v @ n) * towards, abs=1e-4)


def test_an_area_light_that_moves():
    """Seen in the mirror, and lighting a wall by samples of its points."""
    nodes, _ = mirror_scene()
    v = np.array([0.7, 0.3, -0.4])
    assert rate_of(nodes, {"lamp": tt.Motion(linear=v)}) == pytest.approx(v[0], abs=1e-4)
    small = {"type": "rectangle", "to_world": look_at((1.5, 0, 0.5), (0, 0, 2)) @ scale(1e-3)}
    lit = scene(wall=plate((0, 0, 2), (0, 0, 0)), lamp=small | {"emitter": {"type": "area"}})
    u = np.array([1.5, 0, -1.5]) / np.linalg.norm([1.5, 0, -1.5])
    assert rate_of(lit, {"lamp": tt.Motion(linear=v)}) == pytest.approx(v @ u, abs=1e-4)


def slab_of_glass(near, far):
    """Mean length and rate straight through a slab of glass whose faces move along z."""
    corners = np.array([[x, y, z] for z in (1.0, 1.4) for y in (-1, 1) for x in (-1, 1)], float)
    faces = np.array([[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7], [2, 7, 3],
                      [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]])  # fmt: skip
    speeds = np.where(corners[:, 2:] < 1.2, near, far) * np.array([[0, 0, 1.0]])
    glass = {"type": "mesh_arrays", "vertices": corners, "faces": faces, "vertex_velocity": speeds,
             "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}  # fmt: skip
    lamp = {"type": "rectangle", "to_world": look_at((0, 0, 3), (0, 0, 0)), "emitter": {"type": "area"}}
    light = rates_of(scene(depth=3, glass=glass, lamp=lamp), spp=1024)
    direct = light[:, :36]  # light that was reflected inside comes later
    return float(mean_length(direct, tt.TimeAxis(0.0, 0.1, 36))), float(mean_rate(direct))


def test_a_slab_of_glass():
    """One that moves changes nothing; one that grows has n - 1 metres of optical path more for each of glass."""
    length, rate = slab_of_glass(2.0, 2.0)
    assert length == pytest.approx(3 + 0.5 * 0.4, abs=1e-4) and rate == pytest.approx(0.0, abs=1e-4)
    assert slab_of_glass(0.0, 2.0)[1] == pytest.approx(0.5 * 2.0, abs=1e-4)


# ------------------------------------------------------------------------------------------------------- two bounces


def moments(light):
    """Light, mean length, mean rate and their covariance, of one pixel."""
    h = light[:, :, 0, 0]
    r, t = RATES.centers[:, None], AXIS.centers_opl[None]
    total = h.sum()
    length, rate = (h * t).sum() / total, (h * r).sum() / total
    return np.array([float(x) for x in (total, length, rate, (h * (r - rate) * (t - length)).sum() / total)])


def test_two_bounces_in_a_corner():
    """A spot at rest, and a wall that moves beside it: moments of length and rate against quadrature over the wall."""
    spot, normal = np.array([0, 0, 2.0]), np.array([0, 0, -1.0])
    center, facing, half, v = np.array([1.0, 0, 1.0]), np.array([-1.0, 0, 0]), 0.8, np.array([-2.0, 0.7, 1.1])
    at = np.array([-0.5, 0.3, 0.2])
    walls = {"a": plate(tuple(spot), (0, 0, 0), half=0.9), "b": plate(tuple(center), tuple(center + facing), half=half)}
    lamp = {"type": "point", "position": list(at), "intensity": 1.0}
    both, one = (tt.load(scene(depth=depth, lamp=lamp, **walls), variant=VARIANT) for depth in (3, 2))
    motions = {"b": tt.Motion(linear=v)}
    direct = rates_of(one, motions)
    runs = np.stack([moments(rates_of(both, motions, spp=1 << 14, seed=seed) - direct) for seed in range(12)])

    m = 400
    g = (np.arange(m) + 0.5) / m * 2 - 1
    y = np.stack(np.broadcast_arrays(center[0], half * g[None] + center[1], half * g[:, None] + center[2]), -1)
    y = y.reshape(-1, 3)
    d1, d2 = np.linalg.norm(y - spot, axis=1), np.linalg.norm(at - y, axis=1)
    u1, u2 = (y - spot) / d1[:, None], (at - y) / d2[:, None]
    cosines = [np.maximum(c, 0) for c in (u1 @ normal, -(u1 @ facing), u2 @ facing)]
    f = (0.5 / math.pi) ** 2 * np.prod(cosines, axis=0) / d1**2 / d2**2 * (2 * half / m) ** 2
    length, rate = 2 + d1 + d2, (u1 - u2) @ v
    mean_l, mean_r = (f * length).sum() / f.sum(), (f * rate).sum() / f.sum()
    truth = [f.sum(), mean_l, mean_r, (f * (rate - mean_r) * (length - mean_l)).sum() / f.sum()]
    error = runs.std(0, ddof=1) / len(runs) ** 0.5
    assert (np.abs(runs.mean(0) - truth) < 4 * error + 1e-4).all()
    assert (error < [2e-3 * truth[0], 1e-3, 3e-3, 1e-3]).all()


# ----------------------------------------------------------------------------------- the same motion, said differently


def corner_of_three(depth=4):
    lamp = {"type": "point", "position": [-0.3, 0.3, 0.1], "intensity": 1.0}
    return scene(4, 50, depth, lamp=lamp, a=plate((0, 0, 2), (0, 0, 0), half=2), b=plate((1, 0, 1), (0, 0, 1), half=2),
                 c=plate((0, -1, 1), (0, 0, 1), half=2, up=(0, 0, 1)))  # fmt: skip


def test_a_camera_and_a_lamp_that_move_are_a_world_that_moves_the_other_way():
    """Four bounces, with the same samples; what is left is the rounding of rates over the bins."""
    loaded = tt.load(corner_of_three(), variant=VARIANT)
    v, w = np.array([0.4, -0.7, 1.3]), np.array([0.2, 0.5, -0.3])
    world = rates_of(loaded, dict.fromkeys("abc", tt.Motion(linear=v, angular=w)), spp=512)
    ours = rates_of(loaded, dict.fromkeys(("sensor", "lamp"), tt.Motion(linear=-v, angular=-w)), spp=512)
    assert float((world - ours).abs().sum() / world.sum()) < 1e-4
    assert float(mean_rate(world).abs().min()) > 0.3


def test_instances_that_move():
    """As the same plates that stand alone; two copies of a group have velocities of their own."""
    motions = {
        "first": tt.Motion(linear=(0.5, -0.4, 1.1), angular=(0.3, 0.6, -0.2), center=(0.1, 0.0, 2.0)),
        "second": tt.Motion(linear=(-0.3, 0.2, 0.6)),
    }
    poses = {
        "first": translate([1, 0, 2]) @ rotate([0, 1, 0], 160),
        "second": translate([-1, 0, 2]) @ rotate([0, 1, 0], 200),
    }
    leaf = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    copies = {
        name: {"type": "instance", "to_world": pose, "group": {"type": "ref", "id": "group"}}
        for name, pose in poses.items()
    }
    grouped = rates_of(scene(4, 60, 3, group={"type": "shapegroup", "leaf": leaf}, **copies), motions)
    apart = rates_of(scene(4, 60, 3, **{name: leaf | {"to_world": pose} for name, pose in poses.items()}), motions)
    assert float((grouped - apart).abs().sum() / apart.sum()) < 1e-4
    assert float(mean_rate(apart).max()) > 1.0


@pytest.mark.parametrize("seen", [False, True])
def test_a_lamp_whose_vertices_move(seen):
    """Vertices with the velocities of a rigid body are that body, of light that is found and that is sampled."""
    corners = np.array([[0.5, -0.3, 0.5], [1.3, -0.3, 0.5], [1.3, 0.5, 0.5], [0.5, 0.5, 0.5]])
    lamp = {"type": "mesh_arrays", "vertices": corners, "faces": np.array([[0, 1, 2], [0, 2, 3]]),
            "texcoords": corners[:, :2], "emitter": {"type": "area", "radiance": 5.0}}  # fmt: skip
    if seen:
        lamp |= {"vertices": corners * [0.7, 0.7, 3], "faces": lamp["faces"][:, ::-1]}
    linear, angular, center = np.array([0.1, 0.2, 1.3]), np.array([0.3, 0.8, 0.5]), np.array([0.2, 0, 1.0])
    whirl = linear + np.cross(angular, lamp["vertices"] - center)
    wall = plate((0, 0, 3), (0, 0, 0), half=5)
    found = rates_of(scene(4, 30, wall=wall, lamp=lamp | {"vertex_velocity": whirl}))
    expected = rates_of(scene(4, 30, wall=wall, lamp=lamp),
                        {"lamp": tt.Motion(linear=linear, angular=angular, center=center)})  # fmt: skip
    assert float(expected.sum()) > 0
    assert float((found - expected).abs().sum()) < 1e-5 * float(expected.sum())


# ----------------------------------------------------------------------------------------------------------------- fog


def test_fog_that_blows():
    """Light that is scattered once at p has the rate 2 v(p) . p / |p|: 2 v_z for wind, and for a whirl the same
    wherever it was. Light from the wall behind has none.
    """
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.9, "id": "mist"}
    box = {"type": "cube", "to_world": translate([0, 0, 2.5]) @ scale([5, 5, 1.5]), "bsdf": {"type": "null"},
           "interior": fog}  # fmt: skip
    loaded = tt.load(scene(kind="transient_prbvolpath", box=box), variant=VARIANT)
    wind, whirl, center = np.array([0.3, 0.2, 1.4]), np.array([0.3, 0.8, 0.0]), np.array([0.7, 0.1, 2.0])
    light = rates_of(loaded, {"mist": tt.Motion(linear=wind, angular=whirl, center=center)}, spp=4096)
    expected = 2 * (wind + np.cross(whirl, -center))[2]
    assert float(mean_rate(light)) == pytest.approx(expected, abs=1e-4)
    lengths = light.sum(0).flatten()
    assert float(lengths[20:80].sum()) > 0 and int((lengths > 0).sum()) > 50
    walled = tt.load(scene(kind="transient_prbvolpath", box=box, wall=plate((0, 0, 4.5), (0, 0, 0))), variant=VARIANT)
    light = rates_of(walled, {"mist": tt.Motion(linear=wind, angular=whirl, center=center)}, spp=4096)
    assert float(mean_rate(light[:, 88:92])) == pytest.approx(0.0, abs=1e-4)
    assert float(mean_rate(light[:, :80])) == pytest.approx(expected, abs=1e-4)


# ------------------------------------------------------------------------------------------------------ around a corner


@pytest.mark.parametrize("kind", ["single", "confocal"])
def test_a_hidden_plate_that_moves_and_turns(kind):
    """Mean rates of the points of a relay wall against quadrature over the plate; noise is 2e-4 m/s."""
    nodes, center, normal = hidden_plate(kind)
    v, w, c, n = np.array([0.8, -0.5, -1.6]), np.array([0.6, 1.5, 0.4]), np.array(center), np.array(normal)
    n = n / np.linalg.norm(n)
    axis = tt.TimeAxis(1.0, 0.05, 60)
    motions = {"hidden": tt.Motion(linear=v, angular=w, center=c)}
    found = mean_rate(rates_of(nodes, motions, spp=1 << 14, axis=axis)).numpy()
    pose, fine, points = np.array(look_at(center, tuple(c + n))), 100, 4
    g = 0.3 * ((np.arange(fine) + 0.5) / fine * 2 - 1)
    x, y = (a.reshape(-1, 1) for a in np.meshgrid(g, g))
    hidden = c + x * pose[:3, 0] + y * pose[:3, 1]
    speeds = v + np.cross(w, hidden - c)
    expected = np.zeros((points, points))
    for row, column in np.ndindex(points, points):
        # Within a cell of the wall the rate is linear enough for its middle.
        seen = np.array([(column + 0.5) / points - 0.5, (row + 0.5) / points - 0.5, 0.0])
        spot = seen if kind == "confocal" else np.array([-0.2, 0.1, 0.0])
        there, back = hidden - seen, spot - hidden
        r, s = np.linalg.norm(there, axis=1), np.linalg.norm(back, axis=1)
        u, d = there / r[:, None], back / s[:, None]
        weight = u[:, 2] * -(u @ n) * (d @ n) * -d[:, 2] / r**2 / s**2
        expected[row, column] = (weight * (speeds * (u - d)).sum(1)).sum() / weight.sum()
    assert np.ptp(expected) > 0.5
    assert np.abs(found - expected).max() < 1e-3


# -------------------------------------------------------------------------------------------------------------- beats

CHIRPS = tt.Chirps(1e9, 10e-6, WAVELENGTH)


def test_range_and_speed_of_a_wall_from_two_beats():
    """Of walls that come nearer and go away; a bin is c / B, 0.15 m of distance and 0.08 m/s."""
    axis = CHIRPS.time_axis((0.5, 6.0), (-3.0, 3.0))
    for distance, speed in ((3.217, 1.83), (1.45, -2.6)):
        loaded = tt.load(scene(wall=plate((0, 0, distance), (0, 0, 0))), variant="llvm_ad_spectral")
        loaded = loaded.moving({"wall": tt.Motion(linear=(0, 0, -speed))})
        out = tt.TransientRenderer(loaded, chirps=CHIRPS, time_axis=axis, temporal_filter="box", spp=64)(seed=0)
        beats = out.beats.reshape(-1, *out.beats.shape[-4:])[0]
        found, approach = tt.sensing.range_and_speed(beats, CHIRPS, axis)
        assert float(found) == pytest.approx(distance, abs=1e-4)
        assert float(approach) == pytest.approx(speed, abs=1e-4)
        for whole, one in zip(tt.sensing.range_and_speed(out), (found, approach), strict=True):
            assert float(whole.reshape(-1, 1, 1)[0]) == float(one)


def test_beats_are_the_rates_of_a_film_of_rates():
    """Means of both chirps are those of opl + k rate and opl - k rate, of a room of several bounces."""
    loaded = tt.load(corner_of_three(3), variant=VARIANT)
    turning, sliding = tt.Motion(linear=(0.2, 0.1, -0.4), angular=(0.1, 0.2, 0)), tt.Motion(linear=(0, 0.1, 0.2))
    motions = {"a": turning, "sensor": sliding}
    light = rates_of(loaded, motions, spp=256)
    moving = loaded.moving(motions)
    axis = CHIRPS.time_axis((0.0, 10.0), (-4.0, 4.0), bins_per_line=4)
    out = tt.TransientRenderer(moving, chirps=CHIRPS, time_axis=axis, temporal_filter="tent", spp=256)(seed=0)
    spectra = out.beats[0].double()
    means = (spectra * axis.centers_opl[:, None, None]).sum(1) / spectra.sum(1)
    for mean, sign in zip(means, (1, -1), strict=True):
        expected = mean_length(light) + sign * CHIRPS.rate_scale_s * mean_rate(light)
        assert close(mean, expected, 2e-3)
    torch.testing.assert_close(spectra.sum(1), light.sum((0, 1)).expand(2, 4, 4), rtol=2e-3, atol=0)


def simulated_beat(chirps, distance, speed, sign, samples):
    """Beat of one chirp with the exact phase of a target that moves, hertz: the largest bin of a padded transform."""
    t = (np.arange(samples) + 0.5) / samples * chirps.duration_s - chirps.duration_s / 2
    slope, carrier = sign * chirps.bandwidth_hz / chirps.duration_s, tt.units.SPEED_OF_LIGHT / chirps.wavelength_m
    delay, fixed = (-2 * speed * t) / tt.units.SPEED_OF_LIGHT, 2 * distance / tt.units.SPEED_OF_LIGHT
    # Phase of the local oscillator minus that of the light, in turns, without the constant part.
    turns = carrier * delay + slope * (t * (fixed + delay) - (2 * fixed * delay + delay**2) / 2)
    power = np.abs(np.fft.fft(np.hanning(samples) * np.exp(2j * np.pi * turns), 1 << 19))
    return sign * np.fft.fftfreq(1 << 19, chirps.duration_s / samples)[np.argmax(power)]


def test_a_chirp_simulated_in_time():
    """Beats of a wall; what is of second order in time, the length that changes during the chirp, is 2e-5 of a line."""
    distance, speed = 3.217, 1.83
    loaded = tt.load(scene(wall=plate((0, 0, distance), (0, 0, 0))), variant=VARIANT)
    loaded = loaded.moving({"wall": tt.Motion(linear=(0, 0, -speed))})
    axis = CHIRPS.time_axis((0.5, 6.0), (-3.0, 3.0), bins_per_line=8)
    out = tt.TransientRenderer(loaded, chirps=CHIRPS, time_axis=axis, temporal_filter="tent", spp=64)(seed=0)
    spectra = out.beats[0, :, :, 0, 0].double()
    beats = (spectra * CHIRPS.beats_hz(axis)).sum(1) / spectra.sum(1)
    line = 1 / CHIRPS.duration_s
    for sign, beat in zip((1, -1), beats.tolist(), strict=True):
        assert beat == pytest.approx(simulated_beat(CHIRPS, distance, speed, sign, 2000), abs=1e-3 * line)


@pytest.mark.slow
def test_chirps_simulated_in_time_of_a_turning_disc():
    """Mean power of 100 chirps of 1000 paths with random phases: the film's spectra, within the speckle of so many."""
    chirps, n, repeats, paths = tt.Chirps(1e9, 20e-6, WAVELENGTH), 256, 100, 1000
    center, turns, drift = np.array([0.0, 0.0, 2.0]), 2.0, np.array([0, 0, 0.3])
    normal = np.array([0.7, 0.0, -math.sqrt(0.51)])
    pose = look_at(tuple(center), tuple(center + normal)) @ scale(0.4)
    disc = {"type": "disk", "to_world": pose, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    motion = tt.Motion(linear=drift, angular=turns * normal, center=center)
    loaded = tt.load(scene(fov=20, disc=disc), variant=VARIANT).moving({"disc": motion})
    axis = tt.TimeAxis(-12.0, chirps.resolution_opl / 8, 960)
    out = tt.TransientRenderer(loaded, chirps=chirps, time_axis=axis, temporal_filter="box", spp=1 << 16)(seed=0)
    film = out.beats[0, :, :, 0, 0].double().numpy()

    t = ((np.arange(n) + 0.5) / n - 0.5) * chirps.duration_s
    window = 0.5 + 0.5 * np.cos(2 * np.pi * t / chirps.duration_s)
    rng, k = np.random.default_rng(0), math.tan(math.radians(10))
    power = np.zeros((2, 8 * n))
    for _ in range(repeats):
        d = np.stack([rng.uniform(-k, k, paths), rng.uniform(-k, k, paths), np.ones(paths)], -1)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        s = (center @ normal) / (d @ normal)
        p = d * s[:, None]
        inside = np.linalg.norm(p - center, axis=1) < 0.4
        weight = np.where(inside, 0.5 / math.pi * np.abs(d @ normal) / s**2, 0) / paths
        rate = 2 * ((drift + np.cross(turns * normal, p - center)) * d).sum(1)
        field = np.sqrt(weight) * np.exp(2j * np.pi * rng.random(paths))
        for row, sign in enumerate((1, -1)):
            beat = chirps.hertz_per_metre * (2 * s + sign * chirps.rate_scale_s * rate)
            signal = np.exp(2j * np.pi * t[:, None] * beat) @ field
            power[row] += np.abs(np.fft.fft(signal * window, 8 * n)) ** 2 / repeats
    power /= (window**2).sum() * 8 * n  # Parseval: sums to the energy
    at = np.fft.fftshift(np.fft.fftfreq(8 * n, chirps.duration_s / n)) / chirps.hertz_per_metre
    for expected, simulated in zip(film, np.fft.fftshift(power, axes=1), strict=True):
        places = axis.centers_opl.numpy()
        got = np.interp(places, at, simulated)
        assert got.sum() == pytest.approx(expected.sum(), rel=0.1)
        # Rates shift the means of the two chirps by 2 m each; speckle by 0.1 m.
        mean = (expected * places).sum() / expected.sum()
        assert (got * places).sum() / got.sum() == pytest.approx(mean, abs=0.3)
        # A bin of N chirps deviates by 0.8 / sqrt(N) in the mean; without rates the difference is near 2.
        assert np.abs(got / got.sum() - expected / expected.sum()).sum() < 2 * 0.8 / repeats**0.5
