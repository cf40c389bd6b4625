"""Messages about numbers, transforms and windows, at the edges and one beside them. No scene is built."""

import warnings

import numpy as np
import pytest
import torch

from torchtransient.errors import PhysicsError, PhysicsWarning
from torchtransient.plugins.parameters import SHARE
from torchtransient.scene.physics import (
    PhysicsWatch,
    are_finite,
    is_singular,
    smallest_and_largest,
)


def messages(function, *arguments):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        function(*arguments)
    assert all(one.category is PhysicsWarning for one in caught)
    return [str(one.message) for one in caught]


def watch(mode="warn"):
    return PhysicsWatch(mode, set())


# ------------------------------------------------------------------------------------------------------------ ranges


def test_both_ends_of_a_range_are_said_once_each():
    each = watch()
    each.ranges = {"k": SHARE}
    value = torch.tensor([0.0])
    assert messages(each.check_value, "k", value, 0.0, 1.0) == []
    assert len(messages(each.check_value, "k", value, 0.0, 1.5)) == 1
    assert len(messages(each.check_value, "k", value, -0.5, 1.0)) == 1
    assert messages(each.check_value, "k", value, -0.5, 1.5) == []
    assert messages(each.check_value, "other", value, -9.0, 9.0) == []


# -------------------------------------------------------------------------------------------------------- transforms


def test_flat_transforms_of_a_batch_that_has_a_gradient():
    each = watch()
    each.transforms = frozenset(["pose"])
    poses = torch.stack([torch.eye(4), torch.eye(4), torch.eye(4)]).requires_grad_()
    assert messages(each.check_value, "pose", poses, 0.0, 1.0) == []
    flat = torch.stack([torch.eye(4), torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0]))]).requires_grad_()
    assert len(messages(each.check_value, "pose", flat, 0.0, 1.0)) == 1
    assert messages(each.check_value, "pose", flat, 0.0, 1.0) == []
    assert messages(each.check_value, "other", flat, 0.0, 1.0) == []


def test_directions_without_a_length():
    """One of a batch, too."""
    each = watch()
    each.directions = {"sky.sun_direction": np.array([0.0, 1.0, 0.0])}
    across = torch.tensor([[0.0, 0.0, -2.0], [1.0, 0.0, 0.0]])
    assert messages(each.check_value, "sky.sun_direction", across, -2.0, 1.0) == []
    given = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    assert "'sky.sun_direction' is a direction and has no length" in messages(
        each.check_value, "sky.sun_direction", given, -2.0, 0.0
    )[0]
    assert messages(each.check_value, "other", given, -2.0, 0.0) == []
    along = torch.tensor([0.0, -3.0, 0.0])
    assert messages(each.check_value, "sky.sun_direction", along, -3.0, 0.0) == []
    (said,) = messages(each.check_value, "sky.sun_direction", along.requires_grad_(), -3.0, 0.0)
    assert "points along the axis of its sky" in said


def test_flat_transforms_are_errors_each_time():
    each = watch("error")
    each.transforms = frozenset(["pose"])
    for _ in range(2):
        with pytest.raises(PhysicsError, match="'pose' has no inverse"):
            each.check_value("pose", torch.zeros(4, 4), 0.0, 0.0)


@pytest.mark.parametrize(
    ("sizes", "flat"),
    [((3.0, 2.0, 3e-7), True), ((3.0, 2.0, 3.1e-7), False), ((1e-9, 1e-9, 1e-9), False), ((np.inf, 1.0, 0.0), False)],
)
def test_flat_up_to_single_precision(sizes, flat):
    """A ten millionth of the longest side. What a plane of a matrix moves to counts for nothing."""
    matrix = np.diag([*sizes, 1.0])
    matrix[:3, 3] = 5.0
    turned = matrix if np.isinf(sizes[0]) else matrix[[1, 2, 0, 3]]
    assert is_singular(turned) == flat
    assert not is_singular(np.array([[2.0, 0.5, 9.0], [0.0, 3.0, 9.0], [0.0, 0.0, 1.0]]))
    assert is_singular(np.array([[2.0, 4.0, 9.0], [1.0, 2.0, 9.0], [0.0, 0.0, 1.0]]))


# ----------------------------------------------------------------------------------------------------------- numbers


def test_smallest_and_largest():
    assert smallest_and_largest(torch.tensor([[2.0, -3.0], [7.0, 1.0]]).requires_grad_()) == (-3.0, 7.0)
    assert smallest_and_largest(torch.zeros(0, 3)) == (0.0, 0.0)
    assert not are_finite(*smallest_and_largest(torch.tensor([1.0, float("nan")])))
    assert are_finite(-1.0, 2.0)
    assert not are_finite(-np.inf, 2.0) and not are_finite(-1.0, np.inf)


# ----------------------------------------------------------------------------------------------------------- windows


def window(each, before, after, total=40.0):
    return messages(each.check_window, total, before, after)


@pytest.mark.parametrize(("before", "after"), [(2.0, 0.0), (0.0, 2.0), (0.5, 1.5), (0.0, 0.0)])
def test_a_twentieth_may_be_missed(before, after):
    each = watch()
    each.window_name = "window"
    assert window(each, before, after) == []
    if before + after:
        assert len(window(each, before * 1.01, after * 1.01)) == 1


def test_what_a_window_misses_in_numbers():
    each = watch()
    each.window_name = "window"
    (said,) = window(each, 3.0, 7.0)
    assert said.startswith(
        "the window misses 25.0% of the light: 7.5% arrives before it, 17.5% after it. tt.plan(scene) finds a window;"
    )
    # Once for each window, by name.
    assert window(each, 3.0, 7.0) == []
    each.window_name = "other"
    assert len(window(each, 3.0, 7.0)) == 1


def test_windows_that_are_not_looked_at():
    assert window(watch(), 3.0, 7.0) == []
    each = watch()
    each.window_name = "window"
    assert window(each, 3.0, 7.0, total=0.0) == []
    assert window(each, -1.0, 0.5) == []


def test_windows_are_errors_each_time():
    each = watch("error")
    each.window_name = "window"
    for _ in range(2):
        with pytest.raises(PhysicsError, match=r"misses 25\.0% of the light.*With physics='warn'"):
            each.check_window(40.0, 3.0, 7.0)


def test_warnings_point_at_the_line_outside():
    """Lines of the library and of torch are passed over, however many calls are in between."""
    calls = (
        lambda: watch().warn("a", "b"),
        lambda: watch().check_description({"a": "b"}),
        lambda: torch.func.vmap(lambda x: (watch().check_description({"a": "b"}), x)[1])(torch.ones(2)),
    )
    for call in calls:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
        line = call.__code__.co_firstlineno
        assert [(one.filename, one.lineno) for one in caught][:1] == [(__file__, line)]
