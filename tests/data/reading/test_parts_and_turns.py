"""Windows, rectangles, turns of workers and places of a ring, in small whole numbers."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.data.reading.online_schedule import Schedule
from torchtransient.data.reading.parts import axis_of, bins_of, cut_axis, image_size, pixels_of
from torchtransient.data.reading.stream import TransientStream, _buffered, _checked_rank, _share
from torchtransient.errors import StorageError, TorchTransientError

AXIS = tt.TimeAxis(3.0, 0.5, 10)


# ---------------------------------------------------------------------------------------------------------- windows


@pytest.mark.parametrize(
    ("window", "bins"),
    [
        ((3.0, 8.0), (0, 10)), ((None, None), (0, 10)), ((4.0, None), (2, 10)), ((None, 4.0), (0, 2)),
        # All bins that are touched; the border of a bin is not beyond it, up to a millionth of one.
        ((4.1, 5.1), (2, 5)), ((4.0, 5.0), (2, 4)), ([4.0 - 4e-7, 5.0 + 4e-7], (2, 4)),
        ((4.0 - 6e-7, 5.0 + 6e-7), (1, 5)),
        ((3.0 - 4e-7, 8.0 + 4e-7), (0, 10)), ((4.0, 4.0 + 1e-7), (2, 3)), ((7.9999999, 8.0), (9, 10)),
        (slice(2, 5), (2, 5)), (slice(None), (0, 10)), (slice(-3, None), (7, 10)), (slice(8, 99), (8, 10)),
    ],
)  # fmt: skip
def test_bins_of_a_window(window, bins):
    found = bins_of(window, AXIS)
    assert (found.start, found.stop) == bins
    cut = cut_axis(AXIS, found)
    assert cut == tt.TimeAxis(3.0 + 0.5 * bins[0], 0.5, bins[1] - bins[0])


@pytest.mark.parametrize(
    ("window", "words"),
    [
        ((3.0 - 6e-7, 5.0), "to lie between 3 m and 8 m"), ((3.0, 8.0 + 6e-7), "to lie between"),
        ((5.0, 5.0), "to lie between"), ((5.0, 4.0), "to lie between"), ((3.0,), r"window as \(start_opl, end_opl\)"),
        (5.0, r"window as \(start_opl, end_opl\)"), (("a", 5.0), r"window as \(start_opl, end_opl\)"),
        (slice(0, 4, 2), "some of 10 bins"), (slice(4, 4), "some of 10 bins"), (slice(10, 12), "some of 10 bins"),
    ],
)  # fmt: skip
def test_windows_that_are_none(window, words):
    with pytest.raises(StorageError, match=words):
        bins_of(window, AXIS)


def test_without_a_window_or_an_axis():
    assert bins_of(None, None) is None and bins_of(None, AXIS) is None
    with pytest.raises(StorageError, match="have no time axis"):
        bins_of((3.0, 4.0), None)
    assert cut_axis(None, slice(0, 2)) is None and cut_axis(AXIS, None) is AXIS
    plain = {"start_opl": 3.0, "bin_width_opl": 0.5, "num_bins": 10}
    assert axis_of({"axis": plain}) == AXIS
    for other in (None, [1], {"frequencies": 2}):
        assert axis_of({"axis": other}) is None
    for wrong in (plain | {"num_bins": -1}, {"num_bins": 3}):
        with pytest.raises(StorageError, match="time axis of the shards is none"):
            axis_of({"axis": wrong})


def test_rectangles():
    assert pixels_of(None, (4, 6)) is None
    assert pixels_of((slice(1, 3), slice(-2, None)), (4, 6)) == (slice(1, 3), slice(4, 6))
    assert pixels_of([slice(3, 9), slice(None)], (4, 6)) == (slice(3, 4), slice(0, 6))
    rows = slice(0, 2)
    for wrong in ((rows, slice(0, 4, 2)), (slice(2, 2), rows), (rows, slice(6, 7))):
        with pytest.raises(StorageError, match=r"some of \(4, 6\) without steps"):
            pixels_of(wrong, (4, 6))
    for wrong, size in (
        (rows, (4, 6)),
        ((rows,), (4, 6)),
        ((rows, 2), (4, 6)),
        ((rows, rows), (4,)),
        ((rows,) * 3, (4, 6)),
    ):
        with pytest.raises(StorageError, match=r"slices \(rows, columns\)"):
            pixels_of(wrong, size)


def test_the_size_of_images():
    """Of the steady image, of labels, of what was measured."""
    shapes = {"transient": (3, 9, 4, 6), "depth": (5, 7), "index": (), "steady": (3, 2, 8)}
    assert image_size(shapes, ["transient"]) == (2, 8)
    del shapes["steady"]
    assert image_size(shapes, ["transient"]) == (5, 7)
    del shapes["depth"]
    assert image_size(shapes, ["phasor", "transient"]) == (4, 6)
    assert image_size({"index": (3,)}, ["transient"]) == ()


# -------------------------------------------------------------------------------------------------------------- turns


def test_shares_differ_by_one():
    assert [_share(11, part, 4) for part in range(4)] == [(0, 2), (2, 5), (5, 8), (8, 11)]


class Alone(TransientStream):
    """A stream of so many samples."""

    def __init__(self, samples):
        self._samples = samples

    num_samples = property(lambda self: self._samples)


@pytest.mark.parametrize(
    ("batches", "given", "turn"),
    [
        # Shares of 3, 4 and 4 samples, by two: two batches each, the last one of the first worker a smaller one.
        (0, [0, 0, 0], 0), (1, [2, 0, 0], 1), (2, [2, 2, 0], 2), (3, [2, 2, 2], 0), (4, [4, 2, 2], 1),
        (6, [4, 4, 4], 0), (9, [4, 4, 4], 0),
    ],
)  # fmt: skip
def test_workers_take_turns(batches, given, turn):
    assert Alone(11)._given(batches, 2, 3) == (given, turn)


def test_who_has_no_more_is_left_out():
    """Shares of 1, 2 and 2, one at a time."""
    assert [Alone(5)._given(batches, 1, 3) for batches in (3, 4, 5)] == [
        ([1, 1, 1], 0), ([1, 2, 1], 2), ([1, 2, 2], 0),
    ]  # fmt: skip


@pytest.mark.parametrize(("count", "size"), [(0, 3), (1, 3), (7, 3), (7, 7), (7, 20), (50, 1)])
def test_a_buffer_shuffles_what_it_holds(count, size):
    """Everything once, nothing sooner than the buffer reaches."""
    numbers = np.arange(count, dtype=np.int64) * 3
    found = _buffered(numbers, size, np.random.default_rng(0))
    assert sorted(found) == numbers.tolist()
    assert all(found[place] <= 3 * (place + size - 1) for place in range(count))
    if size == 1:
        assert found.tolist() == numbers.tolist()
    if size < count:
        drawn = {int(_buffered(numbers, size, np.random.default_rng(seed))[0]) for seed in range(40)}
        assert drawn == set((np.arange(size) * 3).tolist())


def test_ranks():
    assert _checked_rank(0, 1) == (0, 1) and _checked_rank(2, 3) == (2, 3)
    with pytest.raises(StorageError, match="rank below world_size = 3, got 3"):
        _checked_rank(3, 3)
    for rank, size in ((-1, 2), (0, 0)):
        with pytest.raises(TorchTransientError):
            _checked_rank(rank, size)


# --------------------------------------------------------------------------------------------------------------- ring


@pytest.mark.parametrize(
    ("capacity", "producers", "ahead"), [(64, 2, 8), (7, 2, 1), (8, 2, 1), (16, 2, 2), (10_000, 1, 64), (256, 1, 64)]
)
def test_a_quarter_of_the_ring_is_ordered_ahead(capacity, producers, ahead):
    schedule = Schedule(capacity, producers, 2.0, 1, first=0, seed=0)
    assert schedule.ahead == ahead
    orders = [order for _ in range(ahead + 1) if (order := schedule.order(1)) is not None]
    assert [order.index for order in orders] == [order.slot for order in orders] == list(range(ahead))


def filled(uses, warm=2):
    """A ring of three whose places are all readable: made of samples 5, 6 and 7."""
    schedule = Schedule(3, 1, uses, warm, first=5, seed=0)
    for number in (5, 6, 7):
        assert not schedule.can_draw() or schedule.made >= warm
        assert schedule.finished(schedule.order(0).index) == number - 5
    assert (schedule.made, schedule.next_index) == (3, 8)
    return schedule


def test_readers_wait_for_enough_samples():
    """Until ``warm`` are made; two draws for each that was made."""
    schedule = Schedule(3, 1, 2.0, 2, first=0, seed=0)
    assert not schedule.can_draw()
    schedule.finished(schedule.order(0).index)
    assert not schedule.can_draw()
    schedule.finished(schedule.order(0).index)
    for _ in range(4):
        assert schedule.can_draw()
        assert schedule.draw() in (0, 1)
    assert not schedule.can_draw() and schedule.drawn == 4


def test_the_last_readable_sample_stays():
    """Whoever has one place writes it once, without a bound of the uses, too."""
    schedule = Schedule(1, 1, float("inf"), 1, first=0, seed=0)
    schedule.finished(schedule.order(0).index)
    assert schedule.order(0) is None and schedule.can_draw() and schedule.draw() == 0


def test_the_oldest_is_replaced_once_it_has_served():
    """Of two uses: at the third draw one that has gone would not be missed."""
    schedule = filled(2.0)
    for _ in range(2):
        assert schedule.order(0) is None
        schedule.draw()
    order = schedule.order(0)
    assert (order.index, order.slot, schedule.replaced) == (8, 0, 1)
    assert {schedule.draw() for _ in range(2)} <= {1, 2}
    schedule.finished(8)
    assert (order := schedule.order(0)) is not None and (order.index, order.slot) == (9, 1)


def test_what_failed_or_was_lost_leaves_its_place():
    schedule = Schedule(16, 2, 2.0, 1, first=5, seed=0)
    orders = [schedule.order(0), schedule.order(1), schedule.order(0)]
    schedule.failed(orders[1].index)
    assert schedule.lost(0) == [5, 7] and not schedule.orders
    again = [schedule.order(1) for _ in range(2)]
    assert [order.index for order in again] == [5, 7] and schedule.next_index == 8
    assert schedule.order(0).index == 8
    # Free places come first come, first served: those that were never used before.
    assert [order.slot for order in again] == [3, 4]
