"""The Cornell box, in metres."""

from __future__ import annotations

from torchtransient.checks import positive
from torchtransient.errors import ArgumentError
from torchtransient.scenes.parts import SceneDict, diffuse, perspective, transient_film, transient_path
from torchtransient.scenes.transforms import look_at, rotate, scale, translate

WHITE = (0.885809, 0.698859, 0.666422)
GREEN = (0.105421, 0.37798, 0.076425)
RED = (0.570068, 0.0430135, 0.0443706)


def cornell_box(
    resolution: int | tuple[int, int] = 256,
    *,
    num_bins: int = 300,
    start_opl: float = 3.5,
    bin_width_opl: float = 0.02,
    spp: int = 64,
    max_depth: int = 8,
    mirror: bool = False,
    glass: bool = False,
    index: float = 1.5,
    sampler: str = "independent",
) -> SceneDict:
    """Return the standard Cornell box as Mitsuba ships it, with a transient film and integrator.

    The room is the cube [-1, 1]^3 without its front face, the camera sits at z = 3.90 and looks along -z. `large-box`
    stands on the left, a centimetre deep in the floor (derivatives by its pose lack the line in which they meet, and
    warn of it).

    Args:
        resolution: one side in pixels, or (width, height).
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
        mirror: make `large-box` an ideal mirror.
        glass: make `large-box` a smooth dielectric.
        index: index of refraction of the glass.
        sampler: plugin name of the sampler.

    Returns:
        Scene dictionary with transforms as (4, 4) arrays and the keys `white`, `red`, `green` (BSDFs), `light`,
        `small-box`, `large-box`.

    Raises:
        ArgumentError: for both `mirror` and `glass`.

    Source of the numbers: the scene `cbox` of Mitsuba 3.
    """
    if mirror and glass:
        raise ArgumentError("cornell_box: expected at most one of mirror=True and glass=True, got both; choose one")
    white, ior = {"type": "ref", "id": "white"}, positive("index", index)
    large: SceneDict = white
    if mirror:
        large = {"type": "conductor", "material": "none"}
    elif glass:
        large = {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0}
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    camera = perspective(look_at([0.0, 0.0, 3.90], [0.0, 0.0, 0.0]), 39.3077, film, spp, sampler)

    def wall(to_world: object, bsdf: str) -> SceneDict:
        return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "ref", "id": bsdf}}

    light = wall(translate([0.0, 0.99, 0.01]) @ rotate([1, 0, 0], 90) @ scale([0.23, 0.19, 0.19]), "white")
    light["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": [18.387, 13.9873, 6.75357]}}
    small_to_world = translate([0.335, -0.7, 0.38]) @ rotate([0, 1, 0], -17) @ scale(0.3)
    large_to_world = translate([-0.33, -0.4, -0.28]) @ rotate([0, 1, 0], 18.25) @ scale([0.3, 0.61, 0.3])
    return {
        "type": "scene",
        "integrator": transient_path(max_depth),
        "sensor": camera,
        "white": diffuse(WHITE),
        "green": diffuse(GREEN),
        "red": diffuse(RED),
        "light": light,
        "floor": wall(translate([0.0, -1.0, 0.0]) @ rotate([1, 0, 0], -90), "white"),
        "ceiling": wall(translate([0.0, 1.0, 0.0]) @ rotate([1, 0, 0], 90), "white"),
        "back": wall(translate([0.0, 0.0, -1.0]), "white"),
        "green-wall": wall(translate([1.0, 0.0, 0.0]) @ rotate([0, 1, 0], -90), "green"),
        "red-wall": wall(translate([-1.0, 0.0, 0.0]) @ rotate([0, 1, 0], 90), "red"),
        "small-box": {"type": "cube", "to_world": small_to_world, "bsdf": white},
        "large-box": {"type": "cube", "to_world": large_to_world, "bsdf": large},
    }
