"""Every scene of the sweep, and which of its parameters are to be looked at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.gradient_sweep import bsdfs, lights, media, scans, shapes, textures
from tools.gradient_sweep.shapes import Maker
from tools.gradient_sweep.stages import (
    Description,
    between_lights,
    filled,
    grouped,
    lit_by,
    matte,
    move,
    moving,
    polarizing_sheet,
    seen_by,
    stretch,
    with_rates,
)

RGB, SPECTRAL, POLARIZED = "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized"
GROUP = ("group.", "copy.")
PLATE, LAMP, SENSOR, MEDIUM = ("plate.",), ("lamp.",), ("sensor.",), ("slab.interior_medium.",)
# Mitsuba paints a lamp without a surface black; of it one sees what it emits.
PAINT_OF_LAMPS = ("lamp.bsdf.",)
# What a plugin is inside of that cannot stand alone.
BARE = ("", "rectangle", "reflectance", "homogeneous", "constvolume as extinction", "constvolume as albedo")
# Their parameters are those of the same plugin without the words, at other values.
AGAIN = ("plastic (nonlinear)", "principled (without lobes)")
# Plugins with parameters that matter to polarized light alone.
FILTERS = ("polarizer", "retarder", "diff_polarizer", "diff_retarder")
MIRROR = {"type": "conductor", **bsdfs.METAL}
# Attributes that nothing reads.
COORDINATES = ("plate.vertex_texcoords", "group.plate.vertex_texcoords", "lamp.vertex_texcoords")
COLOURS = tuple(f"{mesh}.vertex_{name}" for mesh in ("plate", "group.plate", "lamp") for name in ("color", "share"))
# The edges between its facets are silhouettes in a mirror.
FACETED = ("ellipsoidsmesh",)


@dataclass(frozen=True)
class Setting:
    """A scene of the sweep: the plugin that it is for, what that one is inside of, and the parameters to look at, by
    the beginnings of their keys. ``make`` takes a folder for the files that a scene reads.
    """

    kind: str
    plugin: str
    inside: str
    make: Maker
    keys: tuple[str, ...]
    variant: str = RGB
    # Beginnings of keys that mean nothing there.
    without: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name in messages and results."""
        words = f"{self.kind} {self.plugin}" + (f" in {self.inside}" if self.inside else "")
        return words if self.variant == RGB else f"{words}, {self.variant.removeprefix('llvm_ad_')}"

    @property
    def is_bare(self) -> bool:
        """True if it stands for its plugin alone, in the simplest place."""
        if self.inside not in BARE or self.plugin in AGAIN:
            return False
        return bool(self.variant == RGB or self.kind == "spectrum" or self.plugin in FILTERS)

    def takes(self, key: str) -> bool:
        """True if a parameter is measured."""
        return key.startswith(self.keys) and not key.startswith(self.without)


def bsdf_settings() -> Iterator[Setting]:
    """Surfaces, bare and in others."""
    for name, surface in bsdfs.surfaces().items():
        for variant in (RGB, POLARIZED) if surface.polarizes else (RGB,):
            yield _bare(name, surface, variant)
        if not surface.bare_only:
            yield from _nested(name, surface)
    for name, surface in bsdfs.holders().items():
        yield from (setting for setting in _nested(name, surface) if setting.inside != "instance")
    # It has no parameters, and is everywhere the same.
    yield Setting("bsdf", "null", "blendbsdf", _between_lights(bsdfs.blend({"type": "null"})), ("plate.bsdf.",))


def _bare(name: str, surface: bsdfs.Surface, variant: str) -> Setting:
    keys = (f"plate.bsdf.{surface.only}",) if surface.only else PLATE
    without = surface.without
    if surface.filters and variant == RGB:
        keys, without = ("plate.bsdf.",), ("theta", "delta")
    where = _before_a_filter if surface.filters else _between_lights
    parts = tuple(f"plate.bsdf.{key}" for key in without)
    return Setting("bsdf", name, "", where(surface.make(), surface.grazing), keys, variant, parts)


def _nested(name: str, surface: bsdfs.Surface) -> Iterator[Setting]:
    where = _before_a_filter if surface.filters else _between_lights
    variant = POLARIZED if surface.filters else RGB
    for holder, wrap in bsdfs.HOLDERS.items():
        if not (surface.outermost or (holder == "twosided" and surface.transmits)):
            yield Setting("bsdf", name, holder, where(wrap(surface.make()), surface.grazing), PLATE, variant)
    make = where(surface.make(), surface.grazing)
    yield Setting("bsdf", name, "instance", lambda folder: grouped(make(folder)), GROUP, variant)


def _between_lights(bsdf: Description, grazing: bool = False) -> Maker:
    return lambda _: between_lights(bsdf, grazing)


def _before_a_filter(bsdf: Description, grazing: bool = False) -> Maker:
    """Polarized light from behind the plate."""
    return lambda _: between_lights(bsdf, grazing) | {"sheet": polarizing_sheet()}


def shape_settings() -> Iterator[Setting]:
    """Shapes of paint, of metal, under a normal map; bare and in a group; as lamps."""
    coats = {
        "": matte(),
        "mirror": MIRROR,
        "rough metal": MIRROR | {"type": "roughconductor", "alpha": 0.3},
        "normal map over a mirror": bsdfs.normal_map(MIRROR),
        "texture": {"type": "diffuse", "reflectance": bsdfs.picture()},
    }
    textured, unread = ("rectangle", "obj", "ply", "cube"), COORDINATES + COLOURS

    def coated(make: Maker, coat: Description) -> Maker:
        return lambda folder: between_lights(coat) | {"plate": make(folder) | {"bsdf": coat}}

    def copied(make: Maker, coat: Description) -> Maker:
        return lambda folder: grouped(coated(make, coat)(folder), np.eye(4))

    for name, make in shapes.shapes().items():
        for inside, coat in coats.items():
            if inside in ("normal map over a mirror", "texture"):
                if name in textured:
                    yield Setting("shape", name, inside, coated(make, coat), ("plate.",), without=COLOURS)
            elif inside != "mirror" or name not in FACETED:
                yield Setting("shape", name, inside, coated(make, coat), ("plate.",), without=unread)
        if name not in shapes.NOT_IN_GROUPS:
            yield Setting("shape", name, "instance", copied(make, matte()), GROUP, without=unread)
            if name not in FACETED:
                yield Setting("shape", name, "instance, mirror", copied(make, MIRROR), GROUP, without=unread)


def emitter_settings() -> Iterator[Setting]:
    """Lights that stand alone, and every area light on every shape that takes one."""
    for name, light in lights.emitters().items():
        yield Setting("emitter", name, "", lambda _, e=light, d=name in lights.DISTANT: lit_by(e(), d), LAMP)
    for name, light in lights.area_emitters().items():
        for shape, make in shapes.lamp_shapes().items():
            yield Setting(
                "emitter",
                name,
                shape,
                lambda folder, e=light, m=make: lit_by(m(folder) | {"emitter": e()}),
                LAMP,
                without=PAINT_OF_LAMPS + COORDINATES + COLOURS,
            )
    for name in lights.area_emitters():
        yield Setting("emitter", name, "small sphere", lambda _, n=name: _small_lamp(n), LAMP, without=PAINT_OF_LAMPS)
    for name in ("area", "directionalarea"):
        for shape in ("rectangle", "ply", "sphere") if name == "area" else ("rectangle",):
            make = lambda folder, n=name, s=shape: _picture_lamp(folder, n, s)  # noqa: E731
            yield Setting("emitter", name, f"{shape}, textured", make, LAMP, without=PAINT_OF_LAMPS + COLOURS)


def _small_lamp(emitter: str) -> Description:
    """A millimetre, as bright as the larger lamps."""
    light = lights.area_emitters()[emitter]() | {"radiance": bsdfs.rgb(9e4, 8e4, 7e4)}
    return lit_by({"type": "sphere", "center": [0.8, 0.3, 2.5], "radius": 0.001, "emitter": light})


def _picture_lamp(folder: Path, emitter: str, shape: str) -> Description:
    light = {"type": emitter, "radiance": bsdfs.picture(3, 5.0, 9.0)}
    return lit_by(shapes.lamp_shapes()[shape](folder) | {"emitter": light})


def sensor_settings() -> Iterator[Setting]:
    """Sensors before paint and before a mirror."""
    for name, sensor in lights.sensors().items():
        # No light comes back from the shape that carries one.
        yield Setting("sensor", name, "", lambda _, s=sensor: seen_by(s), SENSOR, without=("sensor.bsdf.",))
        if name in ("perspective", "thinlens", "orthographic"):
            yield Setting(
                "sensor", name, "before a mirror", lambda _, s=sensor: between_lights(MIRROR) | {"sensor": s}, SENSOR
            )


def texture_settings() -> Iterator[Setting]:
    """Textures and spectra in every kind of slot."""
    for slot_name, slot in textures.slots().items():
        for name, texture in textures.textures().items():
            if slot.takes(name):
                yield Setting(
                    "texture",
                    name,
                    slot_name,
                    lambda folder, s=slot, t=texture: _on_a_mesh(folder, s.make(t(s.low, s.high, s.channels))),
                    (f"plate.bsdf.{slot.key}.", *(_read_attributes(slot) if name == "mesh_attribute" else ())),
                )
        for name, spectrum in textures.spectra().items():
            if slot.channels == 3:
                yield Setting(
                    "spectrum",
                    name,
                    slot_name,
                    lambda _, s=slot, t=spectrum: between_lights(s.make(t(s.low, s.high, 3))),
                    (f"plate.bsdf.{slot.key}.",),
                    SPECTRAL,
                )
    for map_name, surface in textures.maps_of_normals().items():
        for name, texture in textures.normal_textures().items():
            yield Setting(
                "texture",
                name,
                f"normal map over {map_name}",
                lambda _, s=surface, t=texture: between_lights(s(t)),
                ("plate.bsdf.normalmap.",),
            )
    mirror = textures.maps_of_normals()["mirror"]({"type": "mesh_attribute", "name": "vertex_tilt"})
    yield Setting(
        "texture",
        "mesh_attribute",
        "normal map over mirror",
        lambda _: _with_normals_of_its_own(mirror),
        ("plate.vertex_tilt.",),
    )
    for name, spectrum in textures.spectra().items():
        yield Setting("spectrum", name, "radiance", lambda _, t=spectrum: _spectral_lamp(t), LAMP, SPECTRAL)


def _read_attributes(slot: textures.Slot) -> tuple[str, ...]:
    return ("plate.vertex_color",) if slot.channels == 3 else ("plate.vertex_share",)


def _on_a_mesh(folder: Path, bsdf: Description) -> Description:
    """The plate as a mesh that has colours at its vertices."""
    plate = shapes.shapes()["ply"](folder) | {"bsdf": bsdf, "face_normals": True}
    return between_lights(bsdf) | {"plate": plate}


def _with_normals_of_its_own(bsdf: Description) -> Description:
    """The plate as a shape that has a texture of normals for an attribute."""
    scene = between_lights(bsdf)
    return {**scene, "plate": scene["plate"] | {"vertex_tilt": bsdfs.normals()}}


def _spectral_lamp(spectrum: textures.Number) -> Description:
    return lit_by({"type": "point", "position": [0.8, 0.5, 3.0], "intensity": spectrum(5.0, 10.0, 3)})


def medium_settings() -> Iterator[Setting]:
    """Phase functions and volumes in both kinds of media."""
    constants = media.volumes()["constvolume"]
    thin, bright = constants(0.4, 0.8), constants(0.6, 0.9)
    for kind in ("homogeneous", "heterogeneous"):
        for name, phase in media.phase_functions().items():
            yield Setting("phase", name, kind, _fog(kind, thin, bright, phase()), MEDIUM)
            if name != "blendphase":
                blended = media.blended(phase())
                yield Setting("phase", name, f"blendphase, {kind}", _fog(kind, thin, bright, blended), MEDIUM)
        for name, volume in media.volumes().items():
            if kind == "heterogeneous" or name.startswith("constvolume"):
                phase = {"type": "hg", "g": 0.4}
                yield Setting(
                    "medium", kind, f"{name} as extinction", _fog(kind, volume(0.3, 0.8), bright, phase), MEDIUM
                )
            yield Setting("medium", kind, f"{name} as albedo", _fog(kind, thin, volume(0.5, 0.9), phase), MEDIUM)


def _fog(kind: str, sigma_t: Description, albedo: Description, phase: Description) -> Maker:
    return lambda _: filled(media.medium(kind, sigma_t, albedo, phase))


def velocity_settings() -> Iterator[Setting]:
    """Motions of bodies of every kind, and velocities at the vertices of a mesh."""

    def setting(inside: str, body: str, make: Maker) -> Setting:
        return Setting("velocity", "rigid_motion", inside, lambda folder: moving(make(folder), body), ("velocity.",))

    plate = between_lights(matte())
    for name, shape in shapes.shapes().items():
        yield setting(name, "plate", lambda folder, m=shape: plate | {"plate": m(folder) | {"bsdf": matte()}})
    yield setting("instance", "copy", lambda _: grouped(plate))
    yield setting("rectangle, mirror", "plate", _between_lights(MIRROR))
    for name in ("point", "spot"):
        yield setting(name, "lamp", lambda _, n=name: lit_by(lights.emitters()[n]()))
    for name in ("rectangle", "sphere"):
        make = shapes.lamp_shapes()[name]
        yield setting(
            f"area light, {name}", "lamp",
            lambda folder, m=make: lit_by(m(folder) | {"emitter": lights.area_emitters()["area"]()}),
        )  # fmt: skip
    for name in ("perspective", "thinlens", "orthographic"):
        yield setting(name, "sensor", lambda _, n=name: seen_by(lights.sensors()[n]))
    thin, bright = (media.volumes()["constvolume"](*bounds) for bounds in ((0.4, 0.8), (0.6, 0.9)))
    for kind in ("homogeneous", "heterogeneous"):
        fog = media.medium(kind, thin, bright, {"type": "hg", "g": 0.4}) | {"id": "mist"}
        yield setting(kind, "mist", lambda _, f=fog: filled(f))
        yield Setting("velocity", "gridvolume", kind, lambda _, f=fog: _blown(f), ("mist.velocity.",))
    yield Setting("velocity", "mesh_arrays", "", _bending, ("plate.vertex_velocity",))
    yield Setting("velocity", "mesh_arrays", "area light", _bending_lamp, ("lamp.vertex_velocity",))


def _bending(folder: Path) -> Description:
    """A plate with velocities at its vertices."""
    mesh = shapes.shapes()["mesh_arrays"](folder) | {"bsdf": matte()}
    speeds = np.random.default_rng(5).normal(size=np.shape(mesh["vertices"]))
    scene = between_lights(matte())
    return {**scene, "plate": mesh | {"vertex_velocity": speeds}, "sensor": with_rates(scene["sensor"])}


def _bending_lamp(folder: Path) -> Description:
    """A lamp with velocities at its vertices."""
    mesh = shapes.shapes()["mesh_arrays"](folder) | {"emitter": lights.area_emitters()["area"]()}
    speeds = np.random.default_rng(6).normal(size=np.shape(mesh["vertices"]))
    pose = shapes.lamp_shapes()["rectangle"](folder)["to_world"]
    scene = lit_by(mesh | {"to_world": pose, "vertex_velocity": speeds})
    return {**scene, "sensor": with_rates(scene["sensor"])}


def _blown(fog: Description) -> Description:
    """Fog with a wind on a grid."""
    data = np.random.default_rng(7).normal(size=(3, 4, 4, 3)).astype(np.float32)
    wind = {"type": "gridvolume", "data": data, "to_world": move(-3.0, -3.0, 0.0) @ stretch(6.0, 6.0, 2.5)}
    scene = filled({**fog, "velocity": wind})
    return {**scene, "sensor": with_rates(scene["sensor"])}


def scan_settings() -> Iterator[Setting]:
    """Captures around a corner: of every type, and of what light does there."""
    for one in scans.captures():
        yield Setting("scan", one.kind, one.words, lambda _, c=one: c.make(), one.keys, one.variant, one.without)


def all_settings() -> list[Setting]:
    """The whole sweep."""
    return [
        *bsdf_settings(),
        *shape_settings(),
        *emitter_settings(),
        *sensor_settings(),
        *texture_settings(),
        *medium_settings(),
        *velocity_settings(),
        *scan_settings(),
    ]
