"""``owen``: samples that fill every dimension and every pair evenly, and are uniform and independent otherwise."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import PhysicsWarning


def points(count, pixels=50, seed=0, calls=4, name="owen"):
    """Points (calls, pixels, count, 2) of ``next_2d``."""
    mi.set_variant("llvm_ad_rgb")
    sampler = mi.load_dict({"type": name, "sample_count": count})
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed, pixels * count)
    return np.array([np.array(sampler.next_2d()).T.reshape(pixels, count, 2) for _ in range(calls)])


def test_every_pair_is_a_net():
    """Of 32 points every box of 2^-a by 2^(a - 5) holds one."""
    mi.set_variant("llvm_ad_spectral")
    sampler = mi.load_dict({"type": "owen", "sample_count": 32})
    sampler.set_samples_per_wavefront(32)
    sampler.seed(3, 20 * 32)
    for _ in range(3):
        pixels = np.array(sampler.next_2d()).T.reshape(20, 32, 2)
        for a in range(6):
            boxes = np.floor(pixels * [2**a, 2 ** (5 - a)]) @ [64, 1]
            assert all(len(set(row)) == 32 for row in boxes)
        strata = np.floor(np.array(sampler.next_1d()).reshape(20, 32) * 32)
        assert all(len(set(row)) == 32 for row in strata)


def test_two_calls_are_a_net_in_four_dimensions():
    """Of 2^12 points every box of volume 2^-8 holds 16 (t = 4): more points fill more boxes."""
    first, second = points(2**12, pixels=3, calls=2)
    x = np.concatenate([first, second], 2)
    for sides in (sides for sides in itertools.product(range(9), repeat=4) if sum(sides) == 8):
        number = np.zeros(x.shape[:2], int)
        for k, side in enumerate(sides):
            number = (number << side) + np.floor(x[..., k] * 2**side).astype(int)
        assert all((np.bincount(pixel, minlength=256) == 16).all() for pixel in number)


def test_any_number_of_samples():
    """Of 7 points no two lie in one eighth; further ones follow with `advance`."""
    x = points(7)
    assert all(len(set(row)) == 7 for row in np.floor(x[..., 0].reshape(-1, 7) * 8))
    mi.set_variant("llvm_ad_rgb")
    sampler = mi.load_dict({"type": "owen", "sample_count": 8})
    sampler.set_samples_per_wavefront(4)
    sampler.seed(0, 40)
    first = np.array(sampler.next_1d()).reshape(10, 4)
    sampler.advance()
    both = np.concatenate([first, np.array(sampler.next_1d()).reshape(10, 4)], 1)
    assert all(len(set(row)) == 8 for row in np.floor(both * 8))


@pytest.mark.parametrize("count", [1, 7])
def test_numbers_are_uniform_and_independent(count):
    """Products of waves along two dimensions have the mean zero, over pixels as over seeds: 5 standard errors.

    Mitsuba's ``ldsampler`` fails by 50: dimensions of consecutive vertices are correlated.
    """
    x = np.concatenate([points(count, pixels=3000, seed=seed, calls=3) for seed in (0, 1, 77)], 1)
    x = np.moveaxis(x, 3, 1).reshape(6, 9000, count)
    assert (x > 0).all() and (x < 1).all()
    waves = [w(2 * np.pi * k * x) for k in (1, 2, 3) for w in (np.cos, np.sin)]
    for wave in waves:
        assert (np.abs(wave.mean(2).mean(1)) < 5 * wave.mean(2).std(1) / np.sqrt(9000) + 1e-7).all()
    for a, b in itertools.combinations(range(6), 2):
        for u, v in itertools.product(waves, waves):
            product = (u[a] * v[b]).mean(1)
            assert abs(product.mean()) < 5 * product.std() / np.sqrt(9000) + 1e-6


def test_pixels_seeds_and_calls_differ():
    x = points(16, pixels=40, seed=0)
    assert len(np.unique(x[:, :, 0, 0])) == 160
    assert np.isin(points(16, pixels=40, seed=1), x).mean() < 0.01  # of 23 bits, some are equal by chance


def test_a_clone_draws_the_same_numbers():
    mi.set_variant("llvm_ad_rgb")
    sampler = mi.load_dict({"type": "owen", "sample_count": 8, "seed": 5})
    sampler.set_samples_per_wavefront(8)
    sampler.seed(1, 64)
    sampler.next_2d()
    twin = sampler.clone()
    assert twin.wavefront_size() == 64 and twin.sample_count() == 8
    assert np.array_equal(np.array(twin.next_1d()), np.array(sampler.next_1d()))
    other = sampler.fork()
    other.seed(1, 64)
    other.next_2d()
    assert not np.array_equal(np.array(other.next_1d()), np.array(sampler.next_1d()))


# ------------------------------------------------------------------------------------------------------- the default


def room(sampler, resolution=8):
    scene = tt.scenes.cornell_box(resolution=resolution, num_bins=60, bin_width_opl=0.15)
    if sampler is None:
        del scene["sensor"]["sampler"]
    else:
        scene["sensor"]["sampler"] = {"type": sampler, "sample_count": 4}
    return tt.load(scene, variant="llvm_ad_rgb")


@pytest.mark.parametrize(
    "named, asked, used",
    [(None, None, "owen"), ("multijitter", None, "multijitter"), ("multijitter", "owen", "owen")],
)
def test_which_sampler_is_used(named, asked, used):
    out = tt.TransientRenderer(room(named), spp=4, sampler=asked, physics="ignore")(seed=0)
    assert out.stats.sampler == used and out.stats.spp == 4


def test_samplers_whose_numbers_depend_on_each_other_are_warned_of():
    with pytest.warns(PhysicsWarning, match="ldsampler"):
        tt.TransientRenderer(room("ldsampler"))


def test_calls_are_recorded_and_agree():
    renderer = tt.TransientRenderer(room("owen"), ["red.reflectance.value"], spp=7, physics="ignore")
    outs = [renderer(seed=3) for _ in range(3)]
    assert outs[-1].stats.recorded == ("launched",)
    torch.testing.assert_close(outs[-1].transient, outs[0].transient, rtol=1e-5, atol=1e-7)


def test_less_noise_and_the_same_mean():
    """64 samples: a tenth of the variance of steady images, and means within 4 standard errors."""
    found = {}
    for name in ("independent", "owen"):
        renderer = tt.TransientRenderer(room(None, 16), spp=64, sampler=name, physics="ignore")
        with torch.no_grad():
            images = torch.stack([renderer(seed=seed).steady for seed in range(16)])
        found[name], found[name + " variance"] = images.mean((1, 2, 3)), float(images.var(0).mean())
    a, b = found["independent"], found["owen"]
    assert abs(a.mean() - b.mean()) < 4 * torch.sqrt((a.var() + b.var()) / 16)
    assert found["owen variance"] < 0.25 * found["independent variance"]
