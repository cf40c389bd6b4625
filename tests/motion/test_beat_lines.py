"""Spectra of beats against the line of the window around each arrival, to a thousandth of its largest value."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.film_storage import storage
from support.marks import long_rows
from support.rates import plate, scene
from torchtransient.errors import StorageError
from torchtransient.pulses import Pulse, cumulative_of_sum

DISTANCE, SPEED = 3.217, 1.83


def wall(variant="llvm_ad_mono"):
    """A wall head on, which comes nearer: light of one length and one rate."""
    loaded = tt.load(scene(wall=plate((0, 0, DISTANCE), (0, 0, 0))), variant=variant)
    return loaded.moving({"wall": tt.Motion(linear=(0, 0, -SPEED))})


def shares(chirps, axis, temporal_filter):
    """Share of the light in each bin of both spectra, before and after them, (2, T), (2,), (2,); the largest of a bin
    in whose middle the light arrives.
    """
    pulses = [chirps.line_shape] + [Pulse.rectangular(axis.bin_width_opl)] * (temporal_filter == "tent")
    step = axis.bin_width_opl / 512
    first, values = cumulative_of_sum(pulses, step)

    def cumulative(opl):
        return np.interp(opl / step, first + np.arange(values.size), values)

    places = 2 * DISTANCE + np.array([[1], [-1]]) * chirps.rate_scale_s * -2 * SPEED
    below = cumulative(axis.edges_opl.numpy() - places)
    largest = 2 * cumulative(axis.bin_width_opl / 2) - 1
    return np.diff(below), below[:, 0], 1 - below[:, -1], largest


def compare(out, chirps, axis, temporal_filter="box"):
    expected, before, after, largest = shares(chirps, axis, temporal_filter)
    beats, steady = (x.double()[..., 0, 0].numpy() for x in (out.beats, out.steady))
    if beats.ndim == 4:  # Stokes components
        beats, steady = beats[0], steady[0]
    for light, whole in zip(beats, steady, strict=True):
        np.testing.assert_allclose(light / whole, expected, rtol=0, atol=1e-3 * largest)
    assert beats.min() >= 0
    whole, outside = steady.mean(), (out.stats.energy_before[0], out.stats.energy_after[0])
    for found, share in zip(outside, (before, after), strict=True):
        assert found == pytest.approx(whole * share.mean(), abs=1e-3 * whole)
    assert beats.mean(0).sum() / 2 + sum(outside) == pytest.approx(whole, rel=1e-5)


@pytest.mark.parametrize(
    ("window", "temporal_filter"),
    long_rows([("rectangular", "tent"), ("hann", "box"), ("blackmanharris", "tent")], [("hann", "box")]),
)
def test_windows_and_widths_of_bins(window, temporal_filter):
    """From a quarter of a line to a width of eight lines, with the arrival anywhere in its bin."""
    chirps, moving = tt.Chirps(1e9, 10e-6, 1550e-9, window=window), wall()
    line = chirps.resolution_opl
    for lines, shift in ((1 / 4, 0.13), (1, 0.71), (1, 0.13), (8, 0.71)):
        axis = tt.TimeAxis(-2.0 - shift * lines * line, lines * line, round(60 / lines))
        settings = {"chirps": chirps, "time_axis": axis, "temporal_filter": temporal_filter}
        compare(tt.render(moving, seed=0, spp=16, **settings), chirps, axis, temporal_filter)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono_polarized"])
def test_what_the_window_cuts_off(variant):
    """Both spectra have their middle near a rim of the axis, which lets part of the line through."""
    chirps = tt.Chirps(1e9, 10e-6, 1550e-9)
    width = chirps.resolution_opl / 2
    places = 2 * DISTANCE + np.array([1, -1]) * chirps.rate_scale_s * -2 * SPEED
    for before, after in ((0.4, 12), (-9, -2.3)):
        start, end = places[0] + before * width, places[1] + after * width
        axis = tt.TimeAxis(start, width, round((end - start) / width))
        settings = {"chirps": chirps, "time_axis": axis, "temporal_filter": "box", "physics": "ignore"}
        compare(tt.TransientRenderer(wall(variant), spp=16, **settings)(seed=0), chirps, axis)


def test_sums_in_double_precision():
    """More samples than single precision adds up."""
    chirps = tt.Chirps(1e9, 10e-6, 1550e-9)
    axis = tt.TimeAxis(-2.1, chirps.resolution_opl, 40)
    for variant in ("llvm_ad_mono", "llvm_ad_rgb"):
        settings = {"chirps": chirps, "time_axis": axis, "temporal_filter": "box"}
        compare(tt.render(wall(variant), seed=0, spp=2**16 + 2**12, **settings), chirps, axis)


def test_nodes_that_do_not_fit_are_refused(monkeypatch):
    """They are in memory beside the bins: bins alone would fit."""
    chirps = tt.Chirps(1e9, 10e-6, 1550e-9)
    axis = tt.TimeAxis(-2.1, chirps.resolution_opl / 2, 400)
    moving = tt.load(scene(32, 20.0, wall=plate((0, 0, DISTANCE), (0, 0, 0))), variant="llvm_ad_rgb")
    renderer = tt.TransientRenderer(moving, chirps=chirps, time_axis=axis, spp=1, physics="ignore")
    bins = 32 * 32 * 2 * 400 * 3 * 4
    for free, fits in ((2 * bins, False), (4 * bins, True)):
        monkeypatch.setattr("torchtransient.rendering.memory.available_memory", lambda free=free: free)
        if fits:
            renderer(seed=0)
            continue
        with pytest.raises(StorageError, match="of nodes beside it"):
            renderer(seed=0)


def test_batches_of_a_crop():
    """Each item of a batch is a render with its values; all pixels have the steady image's light."""
    chirps = tt.Chirps(1e9, 10e-6, 1550e-9)
    axis = tt.TimeAxis(-6.0, chirps.resolution_opl, 80)
    nodes = scene(4, 20.0, wall=plate((0, 0, DISTANCE), (0.3, 0.2, 0), half=3.0))
    nodes["sensor"]["film"] |= {"crop_width": 3, "crop_height": 2, "crop_offset_x": 1, "crop_offset_y": 1}
    moving = tt.load(nodes, variant="llvm_ad_rgb").moving({"wall": tt.Motion(linear=(0, 0, -SPEED))})
    key = "wall.bsdf.reflectance.value"
    renderer = tt.TransientRenderer(moving, [key], chirps=chirps, time_axis=axis, spp=64)
    albedos = torch.tensor([0.2, 0.7])
    with torch.no_grad():
        batch = renderer({key: albedos}, seed=[3, 3])
        assert batch.beats.shape == (2, 3, 2, 80, 2, 3)
        whole = batch.steady[:, :, None].expand(2, 3, 2, 2, 3)
        torch.testing.assert_close(batch.beats.sum(-3), whole, rtol=2e-3, atol=0)
        for albedo, beats in zip(albedos, batch.beats, strict=True):
            torch.testing.assert_close(beats, renderer({key: albedo}, seed=3).beats, rtol=1e-4, atol=1e-7)


def splined_film(**more):
    film = mi.load_dict({
        "type": "beat_hdr_film", "width": 1, "height": 1, "temporal_bins": 64, "start_opl": 0.0, "bin_width_opl": 0.3,
        "chirp_bandwidth": 1e9, "chirp_duration": 1e-6, "chirp_wavelength": 1550e-9, **more,
    })  # fmt: skip
    assert film.splined
    return film


@pytest.mark.parametrize(("window", "width"), [("hann", 0.075), ("blackmanharris", 0.6)])
def test_lines_begin_and_end_without_a_jump(window, width):
    """What a bin receives of an arrival is the integral of its slope by the length, from one end of the line to the
    other: what came or went in a jump would be missing in gradients.
    """
    mi.set_variant("llvm_ad_mono")
    film = splined_film(chirp_window=window, temporal_filter="tent", bin_width_opl=width, temporal_bins=1)
    # of the bin of the up chirp alone
    adjoint, offset, strides = film.stored_adjoint((mi.Float([1.0, 0.0]), 0, (2, 2, 1, 1, 1)))

    def read(opl):
        base, rate = mi.UInt32(offset), mi.Float(0)
        A, slope, _ = film.read((adjoint, *strides[2:]), base, mi.Float64(opl), mi.Bool(True), rate=rate)
        dr.eval(A, slope)
        return np.array(A[0], dtype=float), np.array(slope[0], dtype=float)

    # nodes are two steps apart, and between them slopes are straight: the middle rule is exact
    step = width / (2 * film.filter.parts)
    places = np.arange(-60 * film.filter.parts, 60 * film.filter.parts) * step
    (found, _), (_, slope) = read(places), read(places + step / 2)
    assert found[0] == found[-1] == 0 < found.max()
    # single precision: three products to a value, and slopes whose moduli sum up to twice the largest value
    wanted = np.cumsum(slope[:-1] * step)
    np.testing.assert_allclose(found[1:], wanted, rtol=0, atol=16 * 2**-24 * found.max())


def test_slopes_are_put_as_they_are_read():
    """Derivatives of both modes are those of one film: by the light, by the length and by the rate of arrivals."""
    mi.set_variant("llvm_ad_rgb")
    film, rng = splined_film(), np.random.default_rng(6)
    opl, rate, light = rng.uniform(-3, 22, 300), rng.uniform(-5, 5, 300), rng.normal(size=(3, 3, 300))
    nodes = storage(film, math.prod(film.storage_shape()))
    # six numbers for each of 64 bins: both chirps, three channels
    g = mi.Float(rng.normal(size=2 * 64 * 3))
    adjoint, offset, strides = film.stored_adjoint((g, 0, (384, 384, 192, 3, 1)))
    where = mi.UInt32(0), mi.Float64(opl)
    by_light, by_opl, by_rate = ([mi.Float(channel) for channel in part] for part in light)
    film.put_slope(0, *where, by_light, by_opl, mi.Bool(True), mi.Float(rate), by_rate)
    read = film.read((adjoint, *strides[2:]), *where, mi.Bool(True), rate=mi.Float(rate))
    dr.eval(nodes, read)
    terms = np.array([[np.array(channel, dtype=float) for channel in part] for part in read]) * light
    assert offset == 0 and min(np.abs(terms).max((1, 2))) > 0.1
    found = np.vdot(np.array(nodes, dtype=float), np.array(adjoint, dtype=float))
    # sums of 300 arrivals in single precision
    assert found == pytest.approx(terms.sum(), abs=1e-6 * np.abs(terms).sum())


def test_lengths_that_are_no_numbers_are_nowhere():
    """An arrival that overflows adds to no node, before the window, in it or behind it."""
    mi.set_variant("llvm_ad_rgb")
    film = splined_film()
    nodes = storage(film, math.prod(film.storage_shape()))
    opl = mi.Float64([math.nan, math.inf, 1e300, -1e300])
    film.put(0, mi.UInt32(0), opl, [mi.Float(1)] * 3, mi.Bool(True), rate=mi.Float(0))
    dr.eval(nodes)
    assert not np.array(nodes).any()
