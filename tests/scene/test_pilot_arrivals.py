"""Shares, blocks, depth, window and axis of a list of arrivals, in numbers that can be followed by hand."""

import numpy as np
import pytest

import torchtransient as tt
from support.pilot_arrivals import arrivals
from torchtransient.scene.pilot import axis_over


def at_random(seed, size=(20, 3), paths=400, count=700):
    """Several arrivals a path, few of them deep or late, all of a path in one pixel."""
    generator = np.random.default_rng(seed)
    path = generator.integers(0, paths, count)
    depth = 1 + generator.geometric(0.4, count)
    return arrivals(
        opl=depth + generator.random(count).round(2),
        energy=generator.random(count) * 0.3**depth,
        depth=depth,
        path=path,
        pixel=path % (size[0] * size[1]),
        paths=paths,
        size=size,
    )


def share_of(found, chosen, energy_of=slice(None), paths=None):
    """Mean over paths, those without an event included, and its standard error, over the mean of all light."""
    paths = paths or found.paths
    sums = np.bincount(found.path[chosen], found.energy[chosen])
    total = found.energy[energy_of].sum()
    return sums.sum() / total, np.sqrt(np.sum(sums**2) - sums.sum() ** 2 / paths) / total


def negligible(found, chosen, share):
    """Apply the rule of the docstring block by block."""
    part, error = share_of(found, chosen)
    if part + 2 * error > share:
        return False
    for block in range(found.blocks):
        inside = found.block == block
        if found.energy[inside & chosen].sum() > 0:
            part, error = share_of(found, chosen & inside, inside, found.paths / found.blocks)
            if part - 2 * error > 10 * share:
                return False
    return True


# ------------------------------------------------------------------------------------------------------------ shares


def test_a_share_and_its_standard_error():
    """Five paths bring 3, 0, 4, 0 and 5, of which 2, 0, 4, 0 and 0 are chosen."""
    found = arrivals([1, 2, 3, 4], [1, 2, 4, 5], path=[0, 0, 2, 4], paths=5)
    part, error = found.share(np.array([False, True, True, False]))
    assert part == pytest.approx(6 / 12)
    assert error == pytest.approx(np.sqrt(5 * np.var([2, 0, 4, 0, 0])) / 12)
    assert found.relative_error() == pytest.approx(np.sqrt(5 * np.var([3, 0, 4, 0, 5])) / 12)


def test_what_is_the_same_in_all_paths_has_no_error():
    """Nor a negative square of one, where rounding makes the sum of the squares the smaller one."""
    found = arrivals(np.ones(10), np.full(10, 0.1))
    assert found.share(np.ones(10, bool)) == (1.0, pytest.approx(0.0, abs=1e-8))
    assert found.relative_error() < 1e-8


def test_dark_is_what_has_no_light():
    assert arrivals([1.0], [0.0]).dark
    assert not arrivals([1.0], [1e-300]).dark


@pytest.mark.parametrize(
    ("size", "across", "down"), [((20, 3), 8, 3), ((3, 20), 3, 8), ((5, 2), 5, 2), ((9, 16), 8, 8)]
)
def test_blocks_of_the_image(size, across, down):
    """At most eight along a side, of the same size up to a pixel, numbered row by row."""
    width, height = size
    pixels = np.arange(width * height)
    found = arrivals(np.ones(len(pixels)), 1.0 + pixels, pixel=pixels, size=size)
    expected = [int(y * down / height) * across + int(x * across / width) for y in range(height) for x in range(width)]
    assert found.blocks == across * down
    assert found.block.tolist() == expected
    assert found.block_total.tolist() == [
        sum(1.0 + p for p in pixels if expected[p] == b) for b in range(across * down)
    ]


def test_gates_weigh_each_arrival():
    """Sensitivities of gates that overlap add up; what no gate sees has no energy. The list itself stays as it was."""
    found = arrivals([1.5, 2.5, 3.5, 9.0], [2, 3, 5, 7], pixel=[0, 1, 1, 0], size=(2, 1))
    gated = found.through([tt.Gate.rectangular(1.0, 3.0), tt.Gate.rectangular(2.0, 4.0)])
    assert gated.energy.tolist() == [2, 6, 5, 0]
    assert gated.total == 13
    assert gated.block_total.tolist() == [2, 11]
    assert (found.total, found.energy.tolist(), found.block_total.tolist()) == (17, [2, 3, 5, 7], [9, 8])


# ------------------------------------------------------------------------------------------------------- negligible


def test_a_share_without_an_error_at_its_bound():
    """Four paths that all lose a quarter of their light."""
    found = arrivals(np.ones(8), [3, 3, 3, 3, 1, 1, 1, 1], path=[0, 1, 2, 3] * 2)
    lost = np.arange(8) >= 4
    assert found.negligible(lost, 0.25)
    assert not found.negligible(lost, np.nextafter(0.25, 0))


def test_two_standard_errors_are_spared():
    """One path in 100 loses 1 of 100: a share of 0.01 with an error of almost as much."""
    found = arrivals(np.ones(101), [*np.full(100, 0.99), 1.0], path=[*range(100), 7])
    lost = np.arange(101) == 100
    bound = 0.01 + 2 * np.sqrt(1 - 1 / 100) / 100
    assert found.negligible(lost, bound * (1 + 1e-9))
    assert not found.negligible(lost, bound * (1 - 1e-9))


def test_a_block_may_lose_ten_times_as_much_and_two_of_its_errors():
    """Eight paths a block, of which one block loses half of its 8, with an error of 1/8: 1/4 is 10 times 0.025."""
    pixel = np.arange(512) // 8
    energy = np.where(pixel == 0, [1, 1, 0.5, 0.5, 0.5, 0.5, 0, 0] * 64, 16.0)
    late = arrivals(
        [*np.full(512, 2.0), 1.0], [*energy, 4.0], path=[*range(512), 7], pixel=[*pixel, 0], size=(8, 8), paths=512
    )
    lost = (late.opl == 2.0) & (late.block == 0)
    assert late.share(lost)[0] < 1e-3
    assert late.negligible(lost, 0.025)
    assert not late.negligible(lost, 0.025 * (1 - 1e-9))


@pytest.mark.parametrize("unit", [1 / 1024, 1.0, 1024.0])
def test_a_block_whose_paths_all_lose_the_same(unit):
    """A quarter of a block in 64, in whatever unit the light is."""
    pixel = np.arange(512) // 8
    energy = np.where(pixel == 0, 0.75, 16.0) * unit
    late = arrivals(
        [*np.full(512, 2.0), *np.full(8, 3.0)],
        [*energy, *np.full(8, 0.25 * unit)],
        path=[*range(512), *range(8)],
        pixel=[*pixel, *np.zeros(8, int)],
        size=(8, 8),
        paths=512,
    )
    assert late.negligible(late.opl == 3.0, 0.025)
    assert not late.negligible(late.opl == 3.0, 0.025 * (1 - 1e-9))


def test_a_block_without_light_loses_none():
    found = arrivals([1, 1, 1], [8, 0, 1], depth=[1, 2, 2], path=[0, 1, 0], pixel=[0, 1, 0], size=(2, 1), paths=2000)
    assert found.negligible(found.depth > 1, 0.4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.3, 0.03, 0.01, 0.003])
def test_depth_and_window_are_the_first_that_suffice(seed, share):
    found = at_random(seed)
    depths = range(1, found.depth.max() + 1)
    assert found.enough_depth(share) == next(d for d in depths if negligible(found, found.depth > d, share))
    for depth in (-1, 3):
        kept = found.depth <= (depth if depth > 0 else 99)
        first, last = found.window(depth, share)
        assert first == found.opl[kept].min()
        assert last == next(t for t in np.sort(found.opl[kept]) if negligible(found, kept & (found.opl > t), share))


def test_nothing_is_left_out_where_all_counts():
    found = arrivals([4.0, 1.5, 9.0, 0.5, 20.0], [1, 1, 1, 0, 0], depth=[2, 1, 5, 1, 3])
    assert found.enough_depth(0.0) == 5
    # What brings no light is at neither end.
    assert found.window(-1, 0.0) == found.window(0, 0.0) == (1.5, 9.0)
    assert found.window(4, 0.0) == (1.5, 4.0)
    assert arrivals([3.0, 2.0], [1, 1]).enough_depth(1e-3) == 1


# --------------------------------------------------------------------------------------------------------------- axis


@pytest.mark.parametrize(
    ("arguments", "axis"),
    [
        # One bin: longer than the window by a thousandth, than a thousandth of the age of the light, or a micrometre.
        ((2.0, 5.0, None, 1), (2.0, 3.01, 1)),
        ((2.0, 2.0, None, 1), (2.0, 0.002, 1)),
        ((-3.0, -3.0, None, 1), (-3.0, 0.003, 1)),
        ((0.0, 0.0, None, 1), (0.0, 1e-6, 1)),
        # 300 bins, of which one is lost to the start, or as many as are asked for. Three digits, rounded up.
        ((2.0, 5.0, None, None), (1.9998, 0.0101, 298)),
        ((2.0, 5.0, None, 10), (1.67, 0.334, 10)),
        ((0.0, 1.11, None, 2), (0.0, 1.11, 2)),
        ((0.0, 1.1101, None, 2), (0.0, 1.12, 2)),
        # Light of one moment: a thousandth of its age over the bins, at least a micrometre.
        ((5.0, 5.0, None, None), (4.9999967, 1.67e-5, 1)),
        ((5.0, 5.0, None, 10), (5.0, 0.0005, 10)),
        ((0.0, 0.0, None, None), (0.0, 1e-6, 1)),
        ((-5.0, -5.0, None, 10), (-5.0, 0.0005, 10)),
        # A width of one's own: starts at its multiples, below the first arrival, and the last one is inside.
        ((2.0, 5.0, 0.5, None), (2.0, 0.5, 7)),
        ((2.1, 4.9, 0.5, None), (2.0, 0.5, 6)),
        ((-2.1, 0.7, 0.5, None), (-2.5, 0.5, 7)),
        ((2.1, 2.2, 0.5, None), (2.0, 0.5, 1)),
        ((2.1, 4.9, 0.5, 3), (2.0, 0.5, 3)),
        ((2.1, 4.9, 0.5, 1), (2.0, 0.5, 1)),
        ((2.5, 9.0, 2.0, None), (2.0, 2.0, 4)),
        # Multiples whose quotient is a little less than their number, and those that are a little too large.
        ((109 * 0.3, 33.0, 0.3, None), (32.7, 0.3, 2)),
        ((0.6, 1.0, 0.2, None), (0.4, 0.2, 4)),
    ],
)
def test_axes_over_a_window(arguments, axis):
    found = axis_over(*arguments)
    assert (found.start_opl, found.bin_width_opl, found.num_bins) == (
        axis[0],
        pytest.approx(axis[1], rel=1e-11),
        axis[2],
    )
