"""Cases of `gpu_cases.py` of longer paths: the Cornell box, glass, a medium, captures around a corner.

1e-2, the default, unless a case says otherwise: 12 to 64 pixels or points of 64 to 1024 samples, of which rounding may
turn over one or two.
"""

from __future__ import annotations

from typing import Any

from _gpu_cases_registry import Found, Side, case
from _gpu_cases_renders import several_calls

import torchtransient as tt
from tools.small_room import make_room


@case()
def deep_paths(side: Side) -> Found:
    """Depth 8: the records of long paths lie in local memory.

    6e-4 was the most seen of all cases: the longer a path, the more of its turns rounding may turn over.
    """
    scene = tt.load(tt.scenes.cornell_box(8, num_bins=60, bin_width_opl=0.1), variant=side.variant)
    keys = ["red.reflectance.value", "red-wall.to_world"]
    renderer = tt.TransientRenderer(scene, parameters=keys, spp=256, max_depth=8, temporal_filter="tent")
    return several_calls(side, renderer, calls=3)


@case(rtol=2e-2)
def glass(side: Side) -> Found:
    """Smooth dielectrics. 2e-2: a draw beside the Fresnel term reflects or refracts, all or nothing; 2e-6 was seen."""
    scene = tt.load(tt.scenes.cornell_box(8, num_bins=60, bin_width_opl=0.1, glass=True), variant=side.variant)
    renderer = tt.TransientRenderer(scene, parameters=["red.reflectance.value"], spp=256)
    return several_calls(side, renderer, calls=3)


@case(rtol=2e-2)
def medium(side: Side) -> Found:
    """A scattering cube, with the gradient by its density. 2e-2: a free flight ends before the border or beyond it."""
    description = make_room()
    description["integrator"] = {"type": "transient_volpath", "max_depth": 4}
    description["box"] = {
        "type": "cube",
        "to_world": description["box"]["to_world"],
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.8},
    }
    scene = tt.load(description, variant=side.variant)
    density = next(key for key in scene.parameters() if key.endswith("sigma_t.value.value"))
    return several_calls(side, tt.TransientRenderer(scene, parameters=[density], spp=1024), calls=3)


def scan_of(kind: str, **more: Any) -> tt.nlos.Scan:
    """Six points of a wall."""
    return tt.nlos.Scan.grid(tt.nlos.Wall.plane(2.0, 1.6, albedo=0.9), (3, 2), kind=kind, **more)


def captured(side: Side, scan: tt.nlos.Scan, **more: Any) -> Found:
    """A capture of the letter Z around a corner."""
    axis = tt.TimeAxis(1.9, 0.02, 100)
    settings = {"time_axis": axis, "spp": 64, "progress": False, "seed": 3, "variant": side.variant, **more}
    capture = tt.nlos.simulate(tt.scenes.nlos_z(), scan, **settings)
    return {
        "transient": capture.transient,
        "of this variant": capture.metadata["variant"] == side.variant,
        "on the device": capture.transient.device.type == side.device,
    }


@case("mono", quick=True)
def corner_confocal(side: Side) -> Found:
    """The third-bounce fast path, confocal: samples that a scan shares."""
    return captured(side, scan_of("confocal"))


@case("mono")
def corner_exhaustive(side: Side) -> Found:
    """The same, every laser point with every point that is seen."""
    return captured(side, scan_of("exhaustive", laser_grid=(2, 1)))


@case("mono")
def corner_late_light(side: Side) -> Found:
    """Chains of four and five bounces."""
    return captured(side, scan_of("confocal"), bounces=[3, 4, 5])


@case("mono")
def corner_gradients(side: Side) -> Found:
    """Gradients of a capture by the vertices of what is hidden."""
    description = tt.nlos.capture_scene(tt.scenes.nlos_z(), scan_of("confocal"))
    film = description["wall"]["sensor"]["film"]
    film |= {"start_opl": 1.9, "bin_width_opl": 0.02, "temporal_bins": 100}
    scene = tt.load(description, variant=side.variant)
    key = next(key for key in scene.parameters() if key.endswith("vertex_positions"))
    return several_calls(side, tt.TransientRenderer(scene, parameters=[key], spp=256, temporal_filter="tent"), calls=3)
