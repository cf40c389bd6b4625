"""Phasor films against mitransient 1.3.1: the same frequencies, sign and origin of the phase, at its precision."""

import numpy as np
import pytest

from torchtransient import scenes

pytestmark = pytest.mark.peer

VARIANT = "llvm_ad_mono"
# Near, so that the peer's clock, which starts at the near clip plane, is 0.1 mm early at most.
NEAR_CLIP = 1e-4
FILM = {"temporal_bins": 400, "bin_width_opl": 0.05, "wl_mean": 1.0, "wl_sigma": 0.5}


def box(near_clip=NEAR_CLIP, **film):
    scene = scenes.cornell_box(6, max_depth=5)
    size = {key: scene["sensor"]["film"][key] for key in ("width", "height", "rfilter")}
    film = {"type": "phasor_hdr_film", **size, **FILM, **film}
    return {**scene, "sensor": {**scene["sensor"], "near_clip": near_clip, "film": film}}


@pytest.fixture
def phasors(ours):
    """`phasors(scene, spp)` -> (K, H, W, F) of one seed, and the film's frequencies."""

    def render(description, spp):
        found = ours(description, [3], spp)[1]
        return found[..., 0] + 1j * found[..., 1], ours.film.frequencies

    return render


@pytest.mark.parametrize("start", [0.0, 1.37])
def test_equal_samples_have_equal_phasors(phasors, peer, start):
    """With one seed both draw the same paths: what is left is 0.1 mm of path and the peer's single precision."""
    description = box(start_opl=start)
    a, frequencies = phasors(description, 64)
    _, b = peer(description, [3], 64, variant=VARIANT)
    b = b[..., 0] + 1j * b[..., 1]
    assert len(frequencies) == 41 and a.shape == b.shape
    np.testing.assert_array_equal(peer.frequencies, np.float32(frequencies))
    length, longest = NEAR_CLIP, 2 * np.pi * frequencies.max()
    scale = np.abs(a).max()
    np.testing.assert_allclose(a, b, atol=(longest * length + 5e-4) * scale)
    assert np.abs(a - np.conj(b)).max() > 0.5 * scale  # another sign would be noticed


def test_the_peers_clock_starts_at_the_near_clip_plane(phasors, peer):
    near = 0.5
    a, frequencies = phasors(box(near), 64)
    _, b = peer(box(near), [3], 64, variant=VARIANT)
    b = b[..., 0] + 1j * b[..., 1]
    early = b * np.exp(-2j * np.pi * frequencies * near)
    assert np.abs(a - b).max() > 0.5 * np.abs(a).max()
    # Off the axis the peer loses near / cos instead of near: 4 % of it in the corners of this camera.
    slant = near * (1 / np.cos(np.radians(39.3077 / 2)) ** 2 - 1)
    assert np.abs(a - early).max() < 2 * np.pi * frequencies.max() * slant * np.abs(a).max()


@pytest.mark.parametrize("film", [
    {"wl_mean": 0.5, "wl_sigma": 0.25, "temporal_bins": 301, "bin_width_opl": 0.013},
    {"wl_mean": 100.0, "wl_sigma": 1000.0, "temporal_bins": 4096, "bin_width_opl": 0.003},
])  # fmt: skip
def test_frequencies_are_the_peers(phasors, peer, film):
    _, frequencies = phasors(box(**film), 1)
    peer(box(**film), [0], 1, variant=VARIANT)
    np.testing.assert_array_equal(peer.frequencies, np.float32(frequencies))
