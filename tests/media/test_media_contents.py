"""What the media of a scene are like, which boundaries are open, and what a job asks of walks through them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.media_scenes import homogeneous, volume
from torchtransient.errors import GradientError
from torchtransient.plugins.transport import medium_scattering as scattering
from torchtransient.plugins.transport import scene_contents as media_contents
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"


def fog():
    return mi.load_dict(homogeneous())


def cloud():
    return mi.load_dict({"type": "heterogeneous", "sigma_t": volume(np.full((2, 2, 2), 0.7)), "albedo": 0.5})


def test_what_the_media_of_a_scene_are_like():
    two = [fog(), cloud()]
    both = media_contents.MediaContents(two, two[0], True, False, 2.5)
    assert (both.homogeneous, both.heterogeneous, both.one_stretch, both.emitter_sampling) == (True, True, False, True)
    assert (both.at_sensor, both.open_boundaries, both.shapes_in_groups, both.extent) == (two[0], True, False, 2.5)
    alone = media_contents.MediaContents([fog()], None, False, False, 2.5)
    assert (alone.homogeneous, alone.heterogeneous, alone.one_stretch) == (True, False, True)
    assert not media_contents.MediaContents([cloud()], None, False, False, 1.0).one_stretch
    assert not media_contents.MediaContents([fog()], None, True, False, 1.0).one_stretch
    dark = mi.load_dict({"type": "homogeneous", "sample_emitters": False})
    some = media_contents.MediaContents([fog(), dark], None, False, False, 1.0)
    assert not some.emitter_sampling
    some.check_spheres(False)
    alone.check_spheres(True)
    with pytest.raises(GradientError, match="sample_emitters = false"):
        some.check_spheres(True)
    some.check_sun(False)
    with pytest.raises(GradientError, match="'sun_direction' has no derivative in a scene with media"):
        some.check_sun(True)


def test_what_a_job_asks_of_walks_through_media():
    """Least rates where an extinction is differentiated, half of one over the scene's size; boundaries are kept where
    path lengths change and lines pass them.
    """
    contents = media_contents.MediaContents([fog()], None, True, False, 2.5)
    closed = media_contents.MediaContents([fog()], None, False, False, 2.5)
    render = media_contents.FlightSettings(contents, None, True)
    assert (render.recorded, render.geometry, render.extinction_changes, render.keeps_entry) == (False,) * 4
    assert render.rate_floor is None and render.hide_emitters and render.open_boundaries
    for geometry in (False, True):
        for extinction in (False, True):
            wanted = Local(geometry=geometry, extinction=extinction)
            found = media_contents.FlightSettings(contents, wanted, False)
            assert (found.geometry, found.extinction_changes) == (geometry, geometry or extinction)
            assert found.keeps_entry == geometry and found.recorded and not found.hide_emitters
            assert not media_contents.FlightSettings(closed, wanted, False).keeps_entry
            assert (found.rate_floor is not None) == extinction
            assert not extinction or found.rate_floor[0] == pytest.approx(0.2)


def test_media_of_a_scene():
    """Each once, those around the sensor and beyond shapes included; the size is the diagonal of all shapes."""
    inside, outside = ({"type": "homogeneous", "sigma_t": x, "id": f"fog{x}"} for x in (1.0, 2.0))
    sheet = {"type": "rectangle"}
    dense = {"type": "rectangle", "interior": inside, "exterior": outside, "bsdf": {"type": "null"}}
    scene = mi.load_dict({"type": "scene", "dense": dense, "sheet": sheet})
    found = media_contents.media_of(scene, None)
    assert {medium.id() for medium in found.media} == {"fog1.0", "fog2.0"} and found.at_sensor is None
    assert found.extent == pytest.approx(8**0.5) and found.open_boundaries and not found.shapes_in_groups
    assert media_contents.media_of(mi.load_dict({"type": "scene", "sheet": sheet}), None) is None
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "radiancemeter", "medium": inside, "film": film})
    alone = media_contents.media_of(mi.load_dict({"type": "scene", "sheet": sheet}), sensor)
    assert len(alone.media) == 1 and alone.at_sensor.id() == "fog1.0" and not alone.open_boundaries
    empty = media_contents.media_of(mi.load_dict({"type": "scene"}), sensor)
    assert empty.extent == 1


def test_boundaries_that_light_passes_unbent():
    """A BSDF ``null`` that emits nothing, of one shape and of many."""
    kinds = {"open": {"bsdf": {"type": "null"}}, "lamp": {"bsdf": {"type": "null"}, "emitter": {"type": "area"}},
             "wall": {}, "veil": {"bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}}}  # fmt: skip
    shapes = [mi.load_dict({"type": "rectangle"} | kind) for kind in kinds.values()]
    assert [media_contents.is_open(shape) for shape in shapes] == [True, False, False, False]
    assert np.array(media_contents.is_open(mi.ShapePtr(shapes))).tolist() == [True, False, False, False]


def test_phase_functions_too_narrow_for_single_precision():
    value = scattering.finite(mi.Float([2, np.inf, np.nan]), mi.Float(7))
    assert np.array(value).tolist() == [2, 7, 7] and np.array(scattering.finite(mi.Float(np.inf)))[0] == 0
    assert scattering.unpolarizing("as it is") == "as it is"
    with mi.variant_context("llvm_ad_mono_polarized"):
        matrix = np.array(scattering.unpolarizing(mi.UnpolarizedSpectrum(0.75)), dtype=float).reshape(4, 4)
    expected = np.zeros((4, 4))
    expected[0, 0] = 0.75
    np.testing.assert_array_equal(matrix, expected)
