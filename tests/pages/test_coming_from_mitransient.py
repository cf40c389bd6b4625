"""docs/coming_from_mitransient.md: what it says of scenes that load, and of those that are refused."""

from __future__ import annotations

import re

import pytest

import torchtransient as tt
from support.pages import Page

VARIANT = "llvm_ad_mono"
REFUSED = Page("docs/coming_from_mitransient.md").text.split("## Scenes that are refused")[1].split("\n## ")[0]
move = tt.scenes.transforms


def scene(shape="rectangle", integrator=None, meter=None, given_film=None):
    """A capture as mitransient 1.x writes it, single, with a projector for a laser."""
    film = {
        "type": "transient_hdr_film", "width": 2, "height": 2, "temporal_bins": 60, "bin_width_opl": 0.2,
        "start_opl": 0.0, "rfilter": {"type": "box"}, **(given_film or {}),
    }  # fmt: skip
    sensor = {"type": "nlos_capture_meter", "sensor_origin": [-0.5, 0, 0.25], "film": film, **(meter or {})}
    aim = move.look_at(origin=[-0.5, 0, 0.25], target=[-0.3, 0.1, 0], up=[0, 1, 0])
    hidden = move.translate([0, 0, 1]) @ move.rotate([0, 1, 0], 180) @ move.scale(0.3)
    settings = {
        "type": "transient_nlos_path", "nlos_laser_sampling": True, "nlos_hidden_geometry_sampling": True,
        "nlos_hidden_geometry_sampling_do_rroulette": False, "nlos_hidden_geometry_sampling_includes_relay_wall": True,
        "capture_type": "single", "force_equal_illumination_scanning": True, "illumination_scan_fov": 0.2,
        "account_first_and_last_bounces": True, "discard_direct_paths": True, "camera_unwarp": False,
        "temporal_filter": "box", "gaussian_stddev": 2.0, "max_depth": 4, "rr_depth": 5, "hide_emitters": False,
    }  # fmt: skip
    return {
        "type": "scene",
        "integrator": settings | (integrator or {}),
        "laser": {"type": "projector", "irradiance": 1.0, "fov": 0.2, "to_world": aim},
        "wall": {"type": shape, "bsdf": {"type": "diffuse"}, "sensor": sensor},
        "hidden": {"type": "rectangle", "to_world": hidden},
    }


def render(description):
    return tt.render(tt.load(description, variant=VARIANT), spp=16, seed=0)


@pytest.mark.slow
def test_all_its_other_parameters_load():
    assert float(render(scene()).transient.sum()) > 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"integrator": {"nlos_hidden_geometry_sampling_max_depth": 3}}, "Leave 'nlos_.*' out: hidden geometry is"),
        ({"meter": {"original_film_width": 8, "original_film_height": 8}}, "Leave 'original_film_width' out"),
        ({"integrator": {"capture_type": "exhaustive", "nlos_laser_sampling": False}}, "need nlos_laser_sampling"),
        ({"given_film": {"laser_scan_width": 2, "laser_scan_height": 2}}, "have no effect without exhaustive_scan"),
        ({"shape": "disk"}, "a rectangle, a mesh with texture coordinates, or 'points'"),
    ],
)
def test_refused(change, said):
    named = [name for part in ("integrator", "meter", "given_film") for name in change.get(part, {})]
    named += change.get("shape", "").split()
    assert all(re.search(rf"\b{name}\b", REFUSED) for name in named)
    description = scene(**change)
    if description["integrator"]["capture_type"] == "exhaustive":
        film = description["wall"]["sensor"]["film"]
        film |= {"exhaustive_scan": True, "laser_scan_width": 2, "laser_scan_height": 2}
    with pytest.raises(tt.errors.SceneError, match=said):
        render(description)
