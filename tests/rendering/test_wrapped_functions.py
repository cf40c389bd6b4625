"""``tt.wrap``: what functions may be, what they take and return, and what is refused."""

from __future__ import annotations

import dataclasses
import random
from collections import namedtuple

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.mitsuba_room import load_room
from tools.small_room import COLOUR, GREY
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import ArgumentError, GradientError, SceneError, ShapeError, UnitError, UnknownKeyError

START = torch.tensor([0.8, 0.5, 0.2])
POSITION, POSE = "light.position", "sensor.to_world"
Pair = namedtuple("Pair", ["first", "second"])


@pytest.fixture(scope="module")
def texture():
    """Parameters of a scene without rays: a bitmap, and a function that looks it up."""
    bitmap = mi.load_dict({"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, 3), 0.5, np.float32))})
    params = mi.traverse(bitmap)

    def look_up(params, uv, factor=1.0):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.uv = mi.Point2f(uv.array[0], uv.array[1])
        return mi.TensorXf(bitmap.eval(si)) * factor

    return params, look_up


# ------------------------------------------------------------------------------------------------------- parameters


def test_values_by_key(texture):
    params, look_up = texture
    wrapped = tt.wrap(look_up, params)
    data = torch.linspace(0, 1, 12).reshape(2, 2, 3).requires_grad_()
    out = wrapped({"data": data}, torch.tensor([0.25, 0.25]), factor=2.0)
    torch.testing.assert_close(out.squeeze(), 2 * data[0, 0])
    out.sum().backward()
    assert torch.equal(data.grad[0, 0], torch.full((3,), 2.0)) and data.grad.sum() == 6
    assert np.all(np.array(params["data"]) == 0.5)
    several = torch.rand(3, 2, 2, 3)
    each = torch.func.vmap(lambda data: wrapped({"data": data}, torch.tensor([0.25, 0.25])))(several)
    torch.testing.assert_close(each.squeeze(), several[:, 0, 0])


def test_every_kind_of_value():
    """Numbers, colours, points, poses and vertices arrive in the scene in the shapes of the table, and go back."""
    _, params = load_room()
    vertices = "box.vertex_positions"
    seen = {}

    def read(params):
        for key in (GREY, COLOUR, POSITION, POSE, vertices):
            seen[key] = np.array(params[key].matrix if key == POSE else params[key]).squeeze()
        return 0

    before = {key: mi.Float(dr.ravel(params[key])) for key in (GREY, COLOUR, POSITION, vertices)}
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, 0.2, 5.0])
    count = len(before[vertices]) // 3
    corners = torch.rand(count, 3)
    values = {GREY: 0.25, COLOUR: [0.1, 0.2, 0.3], POSITION: torch.ones(3), POSE: pose, vertices: corners}
    assert tt.wrap(read, params)(values) == 0
    np.testing.assert_allclose(seen[GREY], 0.25)
    np.testing.assert_allclose(seen[COLOUR], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(seen[POSE], pose)
    np.testing.assert_allclose(seen[vertices], corners.reshape(-1))
    for key, value in before.items():
        assert dr.all(dr.ravel(params[key]) == value), key
    with pytest.raises(SceneError, match=r"the parameter 'box\.faces' is not an array of real numbers"):
        tt.wrap(read, params)({"box.faces": torch.ones(count, 3)})


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"dota": torch.ones(3)}, UnknownKeyError, "no parameter 'dota'.*Did you mean 'data'"),
        ({"data": torch.ones(5, 2, 2, 3)}, ShapeError, "vmap, or a loop"),
        ({"data": torch.full((2, 2, 3), torch.nan)}, UnitError, "expected finite numbers"),
        (torch.ones(2, 2, 3), ArgumentError, "expected a mapping from keys .* got Tensor"),
    ],
)
def test_values_that_do_not_fit(texture, values, error, words):
    params, look_up = texture
    with pytest.raises(error, match=words):
        tt.wrap(look_up, params)(values, torch.tensor([0.25, 0.25]))
    assert np.all(np.array(params["data"]) == 0.5)


def test_attached_parameters_are_constants():
    params = mi.traverse(mi.load_dict({"type": "uniform", "value": 2.0}))
    dr.enable_grad(params["value"])
    params.update()
    x = torch.ones(1, requires_grad=True)
    tt.wrap(lambda x: x * params["value"])(x).backward()
    assert x.grad == 2 and dr.grad_enabled(params["value"]) and dr.grad(params["value"]) == 0
    # What depends on them alone depends on nothing that wants a gradient.
    with pytest.raises(GradientError, match="nothing that the function returned depends on"):
        tt.wrap(lambda x: params["value"] * 3)(x).backward()


# ------------------------------------------------------------------------------------------------------------ seeds


def draws(seed, x):
    """A sampler of one's own: the mean of x over random places."""
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(seed, 64)
    return dr.mean(dr.gather(mi.Float, x.array, mi.UInt32(sampler.next_1d() * 4)))


def test_seeds_are_the_same_in_derivatives():
    x = torch.rand(4, requires_grad=True)
    out = tt.wrap(draws)(3, x)
    out.backward()
    # Linear in x: of the same samples the gradient gives the value back.
    assert float((x.grad * x.detach()).sum()) == pytest.approx(out.item(), rel=1e-5)


def test_a_seed_of_its_own_for_derivatives():
    x = torch.rand(4, requires_grad=True)
    wrapped = tt.wrap(draws, reseed="seed")
    shares = []
    for seed in (3, 3, 4):
        out = wrapped(seed, x)
        assert torch.equal(out, tt.wrap(draws)(seed, x))
        shares.append(torch.autograd.grad(out, x)[0])
    same = torch.autograd.grad(tt.wrap(draws)(3, x), x)[0]
    assert torch.equal(shares[0], shares[1])
    assert not torch.equal(shares[0], shares[2]) and not torch.equal(shares[0], same)
    with pytest.raises(UnitError, match="whole number as a seed"):
        wrapped(1.5, x)
    with pytest.raises(ArgumentError, match=r"reseed='sead' is no argument of .*draws, which has seed, x"):
        tt.wrap(draws, reseed="sead")


def test_numbers_that_the_function_draws_are_drawn_again():
    def noisy(x):
        return x * torch.rand(3)[1].item() * random.random() * np.random.rand()  # noqa: NPY002

    x = torch.ones(1, requires_grad=True)
    out = tt.wrap(noisy)(x)
    state = torch.get_rng_state()
    out.backward()
    # other draws would be other by far more than the rounding of a product in the other order
    torch.testing.assert_close(x.grad, out.detach(), rtol=1e-6, atol=0)
    assert torch.equal(torch.get_rng_state(), state)


# --------------------------------------------------------------------------------------------------------- PyTrees


@dataclasses.dataclass
class Data:
    x: object
    scale: float = 1.0


class Struct:
    DRJIT_STRUCT = {"x": object, "y": object}  # noqa: RUF012

    def __init__(self):
        self.x = self.y = None


def test_trees_go_in_and_out():
    def f(tree, *, more):
        a, (b, *_), pair, data, struct = tree["a"], tree["b"], tree["pair"], tree["data"], tree["struct"]
        assert isinstance(pair, Pair) and isinstance(data, Data) and isinstance(struct, Struct)
        assert tree["note"] == "text" and more is None
        found = Struct()
        found.x, found.y = struct.x * 2, struct.y * 3
        return {"sum": a + b, "pair": Pair(pair.first * 2, None), "data": Data(data.x * data.scale, 7), "struct": found}

    struct = Struct()
    struct.x, struct.y = torch.ones(2, requires_grad=True), torch.ones(2)
    a, b, c, d = (torch.full((2,), n, requires_grad=True) for n in (1.0, 2.0, 3.0, 4.0))
    tree = {"a": a, "b": [b, 5], "pair": Pair(c, 1), "data": Data(d, 0.5), "struct": struct, "note": "text"}
    out = tt.wrap(f)(tree, more=None)
    assert type(out["pair"]) is Pair and type(out["data"]) is Data and type(out["struct"]) is Struct
    assert out["pair"].second is None and out["data"].scale == 7
    total = out["sum"].sum() + out["pair"].first.sum() + out["data"].x.sum() + out["struct"].x.sum()
    total.backward()
    for x, slope in ((a, 1.0), (b, 1.0), (c, 2.0), (d, 0.5), (struct.x, 2.0)):
        assert torch.equal(x.grad, torch.full((2,), slope))


def test_results_of_every_type():
    def f(x):
        flat = x.array
        return {
            "number": dr.sum(flat),
            "colour": dr.unravel(mi.Color3f, flat),
            "points": mi.Point3f(flat, 2 * flat, 3 * flat),
            "matrix": mi.Matrix3f(dr.gather(mi.Float, flat, mi.UInt32(0))),
            "transform": mi.Transform4f().translate(mi.Vector3f(dr.gather(mi.Float, flat, mi.UInt32(1)), 0, 0)),
            "mask": flat > 1,
            "index": mi.UInt32(flat),
            "double": mi.Float64(flat),
            "half": mi.Float16(flat),
            "plain": (1, 2.5, "text", None),
        }

    x = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    out = tt.wrap(f)(x)
    shapes = {"number": (1,), "colour": (3, 1), "points": (3, 3), "matrix": (3, 3, 1), "transform": (4, 4, 1)}
    assert {key: tuple(out[key].shape) for key in shapes} == shapes
    dtypes = {"mask": torch.bool, "index": torch.uint32, "double": torch.float64, "half": torch.float16}
    assert {key: out[key].dtype for key in dtypes} == dtypes
    assert out["plain"] == (1, 2.5, "text", None)
    assert torch.equal(out["points"][1], 2 * x) and out["transform"][0, 3] == 2
    for key, expected in {
        "number": [1, 1, 1], "colour": [1, 1, 1], "points": [6, 6, 6], "matrix": [3, 0, 0], "transform": [0, 1, 0],
        "double": [1, 1, 1], "half": [1, 1, 1],
    }.items():  # fmt: skip
        grad = torch.autograd.grad(out[key].sum(), x, retain_graph=True)[0]
        assert torch.equal(grad, torch.tensor(expected, dtype=torch.float32)), key
    assert not out["mask"].requires_grad and not out["index"].requires_grad


@pytest.mark.parametrize("kind", [lambda x: mi.Float(x), lambda x: np.array([x], np.float32)])
def test_a_function_that_changes_its_arguments(kind):
    factor = kind(3.0)

    def f(x, factor):
        before = x + 0
        x *= float(np.ravel(factor)[0])
        factor *= 2
        return before + x

    x = torch.ones(2, requires_grad=True)
    wrapped = tt.wrap(f)
    out = wrapped(x, factor)
    torch.autograd.grad(out.sum(), x, retain_graph=True)
    grad = torch.autograd.grad(out.sum(), x)[0]
    assert torch.equal(out, torch.full((2,), 4.0)) and torch.equal(grad, torch.full((2,), 4.0))
    along = torch.func.jvp(lambda x: wrapped(x, factor), (x.detach(),), (torch.ones(2),))[1]
    assert torch.equal(along, torch.full((2,), 4.0)) and torch.equal(x, torch.ones(2)) and np.all(factor == 3.0)


# ---------------------------------------------------------------------------------------------- functions of all kinds


def test_a_part_in_torch_inside():
    @dr.wrap(source="drjit", target="torch")
    def inner(x):
        return torch.sin(x)

    outer = tt.wrap(lambda x: inner(x * 2))
    x = torch.tensor([0.1, 0.2], requires_grad=True)
    outer(x).sum().backward()
    torch.testing.assert_close(x.grad, 2 * torch.cos(2 * x.detach()))


# --------------------------------------------------------------------------------------------------- what is refused


def test_what_the_function_knows_otherwise_is_refused_where_it_wants_a_gradient():
    weight, attached = torch.ones(2, requires_grad=True), mi.Float(1.0)
    x = torch.ones(2)
    with pytest.raises(GradientError, match="variable 'weight', which is no argument"):
        tt.wrap(lambda x: x * mi.TensorXf(weight))(x)
    with torch.no_grad():
        assert torch.equal(tt.wrap(lambda x: x * mi.TensorXf(weight))(x), x)
    dr.enable_grad(attached)
    with pytest.raises(GradientError, match=r"depends on arrays of Dr\.Jit that want a gradient"):
        tt.wrap(lambda x: x * attached)(x)
    with pytest.raises(GradientError, match=r"depends on arrays of Dr\.Jit that want a gradient"):
        tt.wrap(lambda x, y: x * y)(x, attached)


def test_results_that_do_not_depend_on_what_wants_a_gradient():
    x = torch.ones(2, requires_grad=True)
    out = tt.wrap(lambda x: mi.Float(x.array[0]) * 2)(x)
    with pytest.raises(GradientError, match="nothing that the function returned depends on"):
        out.backward()


@pytest.mark.parametrize("where", ["function", "entry"])
def test_frozen_functions_are_differentiated(where):
    """Dr.Jit's own derivatives of them are zero, without a word: where that changes, replays need not thaw them."""

    @dr.freeze
    def frozen(x):
        return x * x

    y = mi.Float([1.0, 2.0])
    dr.enable_grad(y)
    dr.backward(frozen(y))
    assert dr.all(dr.grad(y) == 0)
    entries = [frozen]
    way, more = (frozen, 0) if where == "function" else (lambda x: entries[0](x) + 2 * x, 2)
    wrapped = tt.wrap(way)
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    for factor in (1.0, 3.0):
        z = x.detach() * factor
        torch.testing.assert_close(wrapped(z), z.square() + more * z)
    wrapped(x).sum().backward()
    torch.testing.assert_close(x.grad, 2 * x.detach() + more)
    along = torch.func.jvp(wrapped, (x.detach(),), (torch.ones(2),))[1]
    torch.testing.assert_close(along, 2 * x.detach() + more)
    assert dr.flag(dr.JitFlag.KernelFreezing)
