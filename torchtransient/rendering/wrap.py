"""``tt.wrap``: any function of Dr.Jit and Mitsuba as a differentiable function of torch tensors.

A call keeps no graph of Dr.Jit. Its derivatives are *replays*: they call the function again with the saved arguments,
attached, and with the scenes as they were at the call. Every run takes the engine's lock and puts the scenes back.

Scenes are found by a walk over the variables of the function, so that users need not name them; ``state`` names those
that the walk does not find. Nothing else would find a scene that was not named: plugins in C++ read it without a trace
in Python.
"""

from __future__ import annotations

import dis
import functools
import gc
import inspect
import os
import random
import re
import sys
import types
from collections import UserDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch.autograd import forward_ad

from torchtransient.checks import as_whole, is_one_of, shown
from torchtransient.errors import ArgumentError, GradientError, ShapeError, UnitError, VariantError
from torchtransient.plugins.guards import interrupts_wait, no_collection
from torchtransient.rendering.autograd import Request, run
from torchtransient.rendering.broken_numbers import spread_nan
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.values import (
    Slot,
    as_tensor,
    as_torch,
    computable,
    detached,
    drjit_copy,
    flatten,
    fresh,
    is_typed_structure,
    put_back,
    same_structure,
    shapes_of,
    unflatten,
    values_of,
    variant_of,
    write,
)
from torchtransient.scene.opaque import opaque
from torchtransient.scene.parameters import is_transform
from torchtransient.scene.physics import all_finite
from torchtransient.scene.values import as_float
from torchtransient.scene.variant import active_variant, at_work, device_type, is_differentiable, take_over

Tensors = tuple[torch.Tensor, ...]


def wrap(
    function: Callable[..., Any] | None = None,
    parameters: Any = None,
    *,
    source: str | types.ModuleType = "torch",
    target: str | types.ModuleType = "drjit",
    state: Any = (),
    reseed: str | None = None,
) -> Callable[..., Any]:
    """Wrap a function of Dr.Jit and Mitsuba as a differentiable function of torch tensors, as ``drjit.wrap`` does.

    As a decorator, with or without arguments, or as a call::

        @tt.wrap                                            # or @tt.wrap(source="torch", target="drjit")
        def loss(image, target):                            # mi.TensorXf inside, torch tensors outside
            return dr.mean(dr.square(image - target), axis=None)

        render = tt.wrap(lambda params, seed: mi.render(scene, params, spp=16, seed=seed), mi.traverse(scene))
        steady, transient = render({"red.reflectance.value": x}, seed=0)

    Arguments and results are PyTrees: lists, tuples, dictionaries, dataclasses, classes with ``DRJIT_STRUCT``. Tensors
    among the arguments arrive as Dr.Jit tensors of the same shape; everything else as it is. Dr.Jit arrays among the
    results become tensors: those of width one (1,), vectors (3, N), matrices (4, 4, N), transforms their matrix.
    float32, float64, int32, int64, uint32, uint64 and bool keep their type; float16 and bfloat16 are computed in
    float32, with a gradient of their own type; smaller whole numbers are int32. Whole numbers have no gradient.

    A derivative is a replay: it calls the function once more with the arguments that were saved and the scene as it
    was at the call, attached, and keeps nothing. So the function has to do the same for the same arguments. Seeds are
    the same in both, since the code after the render in the function, a loss for instance, needs the image that was
    returned; ``mi.render`` itself takes another seed for its adjoint.

    Every scene that the function reaches is put back after each call and derivative: ``mitsuba.SceneParameters`` and
    objects of Mitsuba among its arguments, its variables and defaults, those of the functions and methods that it
    calls, and entries and attributes of these, four deep.

    Two backwards, several calls before one, edits in place (an error, as torch's own), threads, autocast, ``no_grad``,
    forward mode and ``torch.func`` work as for the renderer. Second derivatives are refused. Not supported: complex
    tensors (``torch.view_as_real``), other directions than torch to Dr.Jit (``drjit.wrap`` does them well), torch
    tensors as results of the function, derivatives by values that are no arguments.

    Args:
        function: a function of Dr.Jit arrays.
        parameters: a ``mitsuba.SceneParameters``. The first argument of the wrapped function is then a mapping from
            its keys to values: these are written to the scene, in the shapes that ``tt.Scene.parameters`` lists,
            without a batch, and the function gets ``parameters`` in their place.
        source: ``"torch"``.
        target: ``"drjit"``.
        state: ``SceneParameters``, or a list of them, of scenes that the function reaches in another way.
        reseed: name of an argument that is a seed, which derivatives replace by another one: for functions that sample
            by themselves and return a result that is linear in the samples, it makes gradients of squared losses
            unbiased.

    Returns:
        The wrapped function. It raises ``ShapeError``, ``DeviceError``, ``UnitError`` and ``UnknownKeyError`` for
        values that do not fit, ``GradientError`` for derivatives that do not exist, ``VariantError`` in a forked
        process, and the errors of the function.

    Raises:
        ArgumentError: if an option is wrong.
    """
    names = tuple(side.__name__ if isinstance(side, types.ModuleType) else side for side in (source, target))
    if not (is_one_of(names[0], ("torch",)) and is_one_of(names[1], ("drjit",))):
        raise ArgumentError(
            f"tt.wrap: expected source='torch' and target='drjit', got {shown(names[0])} and {shown(names[1])}. Other "
            "directions are those of drjit.wrap."
        )
    if function is None:
        return lambda given: wrap(given, parameters, source=source, target=target, state=state, reseed=reseed)
    wrapped = _Wrapped(function, parameters, state, reseed)

    @functools.wraps(function, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        return wrapped(*args, **kwargs)

    found = opaque(call)
    found.__wrapped__ = function  # type: ignore[attr-defined]
    return found


class _Seed(int):
    """Seed among the arguments of a call, which derivatives replace by another one."""


class _Wrapped:
    """Wrapped function with its options."""

    def __init__(self, function: Callable[..., Any], parameters: Any, state: Any, reseed: str | None):
        if not callable(function):
            raise ArgumentError(
                f"tt.wrap: expected a function, got {function!r}. Options are written with their names: "
                "tt.wrap(source='torch', target='drjit')."
            )
        self.function = function
        self.name = str(getattr(function, "__qualname__", type(function).__name__)).replace("<locals>.", "")
        self.parameters = None if parameters is None else _scene_parameters("parameters", parameters)
        several = state if isinstance(state, (list, tuple)) else (state,)
        self.state = tuple(_scene_parameters("state", params) for params in several)
        self.reseed = reseed
        # SceneParameters of objects that the last call reached without any.
        self.traversed: dict[Any, Any] = {}
        try:
            self.signature = inspect.signature(function)
        except (TypeError, ValueError):  # functions of C
            self.signature = inspect.Signature()
        if reseed is not None and not is_one_of(reseed, self.signature.parameters):
            raise ArgumentError(
                f"tt.wrap: reseed={shown(reseed)} is no argument of {self.name}, which has "
                f"{', '.join(self.signature.parameters) or 'none'}."
            )

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if self.reseed is not None:
            args, kwargs = self._seeded(self.reseed, args, kwargs)
        given, args, kwargs = self._split(args, kwargs)
        tree, leaves = flatten((args, kwargs))
        scenes = self._scenes(leaves)
        variant = self._variant(scenes)
        with _working_in(variant):
            tensors = self._values(given)
            for n, leaf in enumerate(leaves):
                if isinstance(leaf, torch.Tensor):
                    leaves[n] = Slot(len(tensors))
                    tensors.append(computable(leaf, f"{self.name}: argument"))
                else:
                    leaves[n] = _copied(leaf)  # a replay sees the values of the call
            call = Call(
                function=self.function,
                name=self.name,
                tree=tree,
                leaves=tuple(leaves),
                keys=None if self.parameters is None else tuple(given),
                variant=variant,
                scenes=tuple((params, detached(values_of(params))) for params in scenes),
                generators=_generator_states(),
            )
        return call.result(run(call, *tensors))

    def _seeded(
        self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[tuple[Any, ...], dict[str, Any]]:
        bound = self.signature.bind(*args, **kwargs)
        bound.apply_defaults()
        number = as_whole(bound.arguments[name])
        if number is None:
            raise UnitError(
                f"{self.name}: {name}: expected a whole number as a seed, got {shown(bound.arguments[name])}."
            )
        bound.arguments[name] = _Seed(number)
        return bound.args, bound.kwargs

    def _split(
        self, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[Mapping[str, Any], tuple[Any, ...], dict[str, Any]]:
        """Return the values by key, and the other arguments."""
        if self.parameters is None:
            return {}, args, kwargs
        first = next(iter(self.signature.parameters), "")
        if not args and first in kwargs:
            args, kwargs = (kwargs[first],), {name: value for name, value in kwargs.items() if name != first}
        if not args or not isinstance(args[0], Mapping):
            got = type(args[0]).__name__ if args else "no argument"
            raise ArgumentError(
                f"{self.name}: expected a mapping from keys of `parameters` to values as the first argument, got {got}."
            )
        return args[0], args[1:], kwargs

    def _values(self, given: Mapping[str, Any]) -> list[torch.Tensor]:
        device = device_type(variant_of(self.parameters) or "") if given else "cpu"
        shapes = shapes_of(self.parameters, given, self.name)
        values = []
        for key, value in given.items():
            tensor, shape = as_float(key, value, device), shapes[key]
            flat = tensor.ndim == 1 and len(shape) == 2 and tensor.numel() == shape[0] * shape[1]
            if tuple(tensor.shape) != shape and not flat:
                raise ShapeError(
                    f"{self.name}: value of {key!r}: expected shape {shape}, got {tuple(tensor.shape)}. Batches are "
                    "torch.func.vmap, or a loop."
                )
            values.append(tensor.reshape(shape))
        return values

    def _scenes(self, arguments: Sequence[Any]) -> list[Any]:
        """Return every ``SceneParameters`` that the function reaches, ``parameters`` first.

        Raises ``GradientError`` for torch tensors that want a gradient and would get none.
        """
        import mitsuba as mi

        # A module of torch is called by a function of torch's.
        called = self.function.forward if isinstance(self.function, torch.nn.Module) else self.function
        variables, reached = surroundings(called, arguments)
        named = [(f"the variable {name!r}, which is no argument,", value) for name, value in variables]
        named += [("an argument", leaf) for leaf in arguments if not isinstance(leaf, torch.Tensor)]
        for what, value in named:
            if any(_wants_gradient(part) for part in (value, *_entries(value))):
                raise GradientError(
                    f"{self.name}: {what} wants a gradient, and would get none: those of the torch tensors among the "
                    "arguments are computed alone, in lists, tuples, dictionaries and structures. Pass it as a torch "
                    "tensor, or detach it."
                )
        scenes = [] if self.parameters is None else [self.parameters]
        scenes += (*self.state, *(value for value in reached if isinstance(value, mi.SceneParameters)))
        found = list({id(params): params for params in scenes}.values())
        traversed = {}
        for value in reached:
            if isinstance(value, mi.Object) and not any(value in params.hierarchy for params in found):
                with at_work():
                    traversed[value] = self.traversed.get(value) or mi.traverse(value)
                found.append(traversed[value])
        self.traversed = traversed
        return found

    def _variant(self, scenes: Sequence[Any]) -> str | None:
        import mitsuba as mi

        variants = {variant for variant in map(variant_of, scenes) if variant is not None}
        if len(variants) > 1:
            raise ArgumentError(
                f"{self.name}: expected parameters of scenes of one variant, got {', '.join(sorted(variants))}."
            )
        return variants.pop() if variants else mi.variant()


def _scene_parameters(name: str, given: Any) -> Any:
    import mitsuba as mi

    if not isinstance(given, mi.SceneParameters):
        raise ArgumentError(
            f"tt.wrap: {name}: expected the mitsuba.SceneParameters of a scene, mi.traverse(mi.load_dict(...)), got "
            f"{type(given).__name__}. A tt.Scene is rendered by tt.TransientRenderer."
        )
    return given


# ------------------------------------------------------------------------------------------------ runs and replays

# The process in which functions have run: Dr.Jit does not survive a fork, whether Mitsuba was in use or not.
_ran = {"in": 0}
# Python's errors where an array of Dr.Jit is used as a tensor of torch.
_USED_AS_TORCH = re.compile(r"must be Tensor, not TensorX|'TensorX\w+' object has no attribute")


@dataclass(frozen=True)
class Call:
    """Call of a wrapped function, without its tensors (:class:`.autograd.Replayable`).

    Attributes:
        tree, leaves: the arguments ``(args, kwargs)``, with a :class:`Slot` for each tensor.
        keys: keys of the first tensors, which are values of ``scenes[0]``, the first argument of the function; None
            without ``parameters``.
        scenes: ``SceneParameters`` and their values at the call.
        generators: states of the random number generators at the call.
        returned: structure and leaves of the result, with a :class:`Slot` for each array, once the function has run.
            Under ``vmap`` a call is several runs, which return the same.
    """

    function: Callable[..., Any]
    name: str
    tree: Any
    leaves: tuple[Any, ...]
    keys: tuple[str, ...] | None
    variant: str | None
    scenes: tuple[tuple[Any, Mapping[str, Any]], ...]
    generators: tuple[Any, ...]
    returned: list[tuple[Any, list[Any]]] = field(default_factory=list)

    @property
    def what(self) -> str:
        return f"the wrapped function {self.name}"

    # Arrays of Dr.Jit are freed inside of the lock, at the end of the inner functions: a graph that is freed beside the
    # work of another thread waits for it, and it for the graph.

    def primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        """Return the arrays that the function returns."""
        for key, value in zip(self.keys or (), tensors, strict=False):
            if not all_finite(value):
                raise UnitError(
                    f"{self.name}: value of {key!r}: expected finite numbers, got some that are NaN or infinite."
                )
        with self._at_work():
            return self._primal(tensors)

    def pullback(
        self, request: Request, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return gradients of <cotangents, outputs>; NaN where a cotangent that is not finite arrives."""

        def replay(given: Sequence[torch.Tensor]) -> Tensors:
            with self._at_work():
                return self._pullback(request, tensors, given)

        return spread_nan(replay, cotangents)

    def pushforward(
        self, request: Request, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return derivatives of the real outputs; NaN where a tangent that is not finite arrives."""

        def replay(given: Sequence[torch.Tensor]) -> Tensors:
            with self._at_work():
                return self._pushforward(request, tensors, given)

        return spread_nan(replay, tangents)

    def result(self, tensors: Tensors) -> Any:
        """Return the result of the function, with tensors in place of its arrays."""
        tree, leaves = self.returned[0]
        return unflatten(tree, [tensors[leaf.number] if isinstance(leaf, Slot) else leaf for leaf in leaves])

    def _primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        import drjit as dr

        tree, leaves, arrays = self._outputs([drjit_copy(tensor) for tensor in tensors], derivative=False)
        if any(dr.grad_enabled(array) for array in arrays):
            raise GradientError(
                f"{self.name}: the result depends on arrays of Dr.Jit that want a gradient, and would get none: those "
                "of the torch tensors among the arguments are computed alone. Pass them as torch tensors, or detach "
                "them, dr.detach(array). If they are parameters of a scene: tt.wrap(..., state=params)."
            )
        if self.returned:
            first, values = self.returned[0]
            if not (same_structure(tree, first) and all(map(_equal, leaves, values))):
                raise ShapeError(
                    f"{self.name}: under torch.func.vmap every entry must return the same structure, and the same "
                    f"values that are no arrays; got {values} and {leaves}. Return arrays."
                )
        else:
            self.returned.append((tree, leaves))
        return as_torch([fresh(array) for array in arrays])

    def _pullback(
        self, request: Request, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]
    ) -> Tensors:
        import drjit as dr

        leaves, wanted = _attached(request, tensors)
        outputs = self._real_outputs(leaves, wanted, len(request.has_cotangent))
        pulled = [output for output, is_given in zip(outputs, request.has_cotangent, strict=True) if is_given]
        self._check_dependence(pulled)
        for output, cotangent in zip(pulled, cotangents, strict=True):
            if dr.grad_enabled(output):
                # two outputs may be one array; no memory of torch's, which Dr.Jit would free under a lock of its own
                dr.accum_grad(output, drjit_copy(cotangent))
        # Of all that leads to the outputs, the part that starts at the wanted leaves.
        for leaf in wanted:
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Backward)
        return as_torch([_derivative(leaf) for leaf in wanted])

    def _pushforward(
        self, request: Request, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
    ) -> Tensors:
        import drjit as dr

        leaves, wanted = _attached(request, tensors)
        outputs = self._real_outputs(leaves, wanted, None)
        self._check_dependence(outputs)
        for leaf, tangent in zip(wanted, tangents, strict=True):
            dr.set_grad(leaf, drjit_copy(tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
        # Outputs keep their tangents, though others may be computed from them.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        return as_torch([_derivative(output) for output in outputs])

    def _real_outputs(self, leaves: list[Any], wanted: Sequence[Any], count: int | None) -> list[Any]:
        import drjit as dr

        # Derivatives of frozen functions (dr.freeze) are zero without a word.
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            tree, _, arrays = self._outputs(leaves, derivative=True)
        if any(map(_has_gradient, wanted)):
            raise GradientError(
                f"{self.name}: the function differentiates by itself (dr.backward), and by an argument that wants a "
                "derivative: that of the result would be a second one, which Dr.Jit does not have. Use dr.detach on "
                "the argument in what is differentiated inside, where it is meant as a constant there."
            )
        outputs = [array for array in arrays if dr.is_float_v(array)]
        is_same = not self.returned or same_structure(tree, self.returned[0][0])
        if not is_same or (count or len(outputs)) != len(outputs):
            raise GradientError(
                f"{self.name}: the function returned another structure when it was replayed for its derivative. "
                "Expected a function that does the same with the same arguments."
            )
        return outputs

    def _outputs(self, tensors: list[Any], derivative: bool) -> tuple[Any, list[Any], list[Any]]:
        """Call the function. Return the structure and leaves of the result, and its arrays as tensors."""
        leaves: list[Any] = []
        for leaf in self.leaves:
            if isinstance(leaf, _Seed):
                leaves.append(mix_seed(leaf, 0x5EED) if derivative else int(leaf))
            else:
                leaves.append(_copied(tensors[leaf.number] if isinstance(leaf, Slot) else leaf))
        args, kwargs = unflatten(self.tree, leaves)
        if self.keys is not None:
            params = self.scenes[0][0]
            write(params, {key: value.array for key, value in zip(self.keys, tensors, strict=False)}, self.name)
            args = (params, *args)
        try:
            result = self.function(*args, **kwargs)
        except (TypeError, AttributeError) as error:
            if _USED_AS_TORCH.search(str(error)):
                error.add_note(
                    f"tt.wrap: tensors arrive in {self.name} as arrays of Dr.Jit (TensorXf), which functions and "
                    "methods of torch do not take. Inside, write dr.sin(x), dr.sum(x) and so on (import drjit as dr); "
                    "functions of torch alone need no tt.wrap."
                )
            raise
        return self._returned(result)

    def _returned(self, result: Any) -> tuple[Any, list[Any], list[Any]]:
        import drjit as dr

        tree, leaves = flatten(result)
        arrays: list[Any] = []
        for n, leaf in enumerate(leaves):
            if isinstance(leaf, torch.Tensor):
                raise GradientError(
                    f"{self.name}: expected arrays of Dr.Jit, got a torch tensor from the function, which derivatives "
                    "cannot pass. Return the array; for a part in torch, drjit.wrap(source='drjit', target='torch')."
                )
            if is_transform(leaf):
                leaf = leaf.matrix
            if is_typed_structure(leaf):
                raise ShapeError(
                    f"{self.name}: expected arrays of Dr.Jit or structures of Python, got a {type(leaf).__name__}, "
                    "whose fields cannot be tensors. Return them in a dictionary: "
                    f"{', '.join(type(leaf).DRJIT_STRUCT)}."
                )
            if dr.is_array_v(leaf):
                leaves[n] = Slot(len(arrays))
                arrays.append(as_tensor(leaf))
        return tree, leaves, arrays

    def _check_dependence(self, outputs: Sequence[Any]) -> None:
        import drjit as dr

        outputs = [output for output in outputs if dr.width(output)]
        if outputs and not any(dr.grad_enabled(output) for output in outputs):
            raise GradientError(
                f"{self.name}: nothing that the function returned depends on an argument that wants a derivative. "
                "Numbers that are read out of an array (x[0], float(x), x.numpy()), dr.detach, and indices carry none: "
                "use dr.gather, dr.unravel or slices. Nor does mi.render without its parameters: mi.render(scene, "
                "params, ...). Where zero is meant, detach the argument."
            )

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        import drjit as dr

        with (
            _working_in(self.variant),
            no_collection(),
            dr.resume_grad(),
            # A part in torch inside of the function differentiates itself, and in all runs alike.
            torch.enable_grad(),
            _without_autocast(),
            _generators_at(self.generators) if self.returned else nullcontext(),
            self._scenes_as_at_call(),
        ):
            yield

    @contextmanager
    def _scenes_as_at_call(self) -> Iterator[None]:
        before = [(params, values_of(params)) for params, _ in self.scenes]
        try:
            for (params, values), (_, now) in zip(self.scenes, before, strict=True):
                put_back(params, values, now)
            yield
        finally:
            with interrupts_wait():
                for params, values in before:
                    put_back(params, values)


@contextmanager
def _working_in(variant: str | None) -> Iterator[None]:
    """Hold the engine lock with a variant active, if derivatives are computed in it.

    Raises:
        VariantError: in a process that was forked from one in which Dr.Jit was at work.
    """
    with ExitStack() as stack:
        if variant is not None and is_differentiable(variant):
            stack.enter_context(active_variant(variant))
        else:
            outermost = stack.enter_context(at_work())
            if outermost:
                take_over("cpu")
            if outermost and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
                take_over("cuda")
        if _ran["in"] not in (0, os.getpid()):
            raise VariantError(
                "this process was forked from one in which a wrapped function had run, and Dr.Jit does not survive a "
                "fork. Expected a fresh process: use multiprocessing.get_context('spawn'), or DataLoader(..., "
                "multiprocessing_context='spawn')."
            )
        _ran["in"] = os.getpid()
        yield


@contextmanager
def _without_autocast() -> Iterator[None]:
    with ExitStack() as stack:
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        yield


def _generator_states() -> tuple[Any, ...]:
    """Return the states of the generators that functions draw from without an argument, a seed for instance."""
    return torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002


def _set_generators(states: tuple[Any, ...]) -> None:
    torch.set_rng_state(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    random.setstate(states[2])


@contextmanager
def _generators_at(states: tuple[Any, ...]) -> Iterator[None]:
    before = _generator_states()
    try:
        _set_generators(states)
        yield
    finally:
        _set_generators(before)


def _attached(request: Request, tensors: Sequence[torch.Tensor]) -> tuple[list[Any], list[Any]]:
    """Return all tensors as leaves of Dr.Jit's graph, and those that need a derivative."""
    import drjit as dr

    leaves = [drjit_copy(tensor) for tensor in tensors]
    wanted = [leaf for leaf, need in zip(leaves, request.needs, strict=True) if need]
    dr.enable_grad(wanted)
    return leaves, wanted


def _derivative(tensor: Any) -> Any:
    """Return the derivative of a tensor; where it has no entries, Dr.Jit has a single zero for it."""
    import drjit as dr

    return fresh(dr.grad(tensor)) if dr.width(tensor) else tensor


def _has_gradient(leaf: Any) -> bool:
    """Return whether a gradient has arrived at a leaf."""
    import drjit as dr

    found = dr.grad(leaf).array
    return bool(dr.width(found)) and (found.state != dr.VarState.Literal or bool(dr.any(found != 0)))


def _copied(value: Any) -> Any:
    """Copy an array, so that changes in place stay with the copy. A Dr.Jit array stays attached; others pass."""
    import drjit as dr

    if isinstance(value, np.ndarray):
        return value.copy()
    return type(value)(value) if dr.is_array_v(value) or is_typed_structure(value) else value


def _equal(a: Any, b: Any) -> bool:
    try:
        return a is b or bool(np.all(a == b))
    except (TypeError, ValueError, RuntimeError):
        return False


# ------------------------------------------------------------------------------------- the surroundings of a function

# Entries and attributes are followed so deep below a variable; of long lists only the entries: they hold data.
_DEPTH = 4
_LONG = 1000
_DATA = (str, bytes, int, float, complex, type(None), torch.Tensor, np.ndarray, np.generic, range, slice)
_FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial)


def surroundings(function: Any, arguments: Sequence[Any] = ()) -> tuple[list[tuple[str, Any]], list[Any]]:
    """Return the variables of a function and of those that it calls by name, and the scenes in its reach.

    Args:
        function: any callable.
        arguments: its arguments.

    Returns:
        Names and values of variables, and every ``mitsuba.SceneParameters`` and object of Mitsuba among variables,
        arguments, and entries, attributes, classes and methods below them. The code of installed packages is not
        followed: it holds no scene of the user's.
    """
    import mitsuba as mi

    kinds = mi.SceneParameters, mi.Object
    variables: list[tuple[str, Any]] = []
    found: list[Any] = []
    seen: dict[int, Any] = {}  # with the values, so that no other one gets their addresses
    level, below = [function], list(arguments)
    for depth in range(_DEPTH + 1):
        for value in level:  # which grows at depth zero
            if isinstance(value, _DATA) or id(value) in seen:
                continue
            seen[id(value)] = value
            if isinstance(value, kinds):
                found.append(value)
            elif depth == 0 and isinstance(value, _FUNCTIONS):
                is_code = isinstance(value, types.FunctionType) and value is not function
                named = [] if is_code and _is_library(value.__module__) else list(_variables(value))
                variables += named
                level += [held for _, held in named]
            else:
                parts = _parts(value)
                below += parts if len(parts) <= _LONG else [part for part in parts if isinstance(part, kinds)]
        level, below = below, []
    return variables, found


def _parts(value: Any) -> list[Any]:
    """Return entries and attributes, the variables of a function, or the members of a class."""
    if isinstance(value, types.ModuleType):  # whose attributes are variables of the functions that name them
        return []
    if isinstance(value, type):
        own_bases = [base for base in value.__mro__ if not _is_library(base.__module__)]
        return [held for base in own_bases for held in vars(base).values()]
    if isinstance(value, types.FunctionType):
        return [] if _is_library(value.__module__) else [held for _, held in _variables(value)]
    if type(value).__module__.startswith("torchtransient."):  # whose scenes are put back by the library
        return []
    return [*getattr(value, "__dict__", {}).values(), *gc.get_referents(value)]


def _variables(function: Any) -> Iterator[tuple[str, Any]]:
    """Yield names and values of variables, defaults, bound arguments and attributes of a function of Python."""
    if isinstance(function, functools.partial):
        yield from ((f"argument {n}", value) for n, value in enumerate(function.args))
        yield from function.keywords.items()
        yield "func", function.func
        return
    if isinstance(function, types.MethodType):
        yield "self", function.__self__
        yield "func", function.__func__
        return
    code = function.__code__
    yield from vars(function).items()
    defaults = function.__defaults__ or ()
    yield from zip(code.co_varnames[code.co_argcount - len(defaults) : code.co_argcount], defaults, strict=True)
    yield from (function.__kwdefaults__ or {}).items()
    global_names, attributes = _names(code)
    variables = {name: function.__globals__[name] for name in global_names if name in function.__globals__}
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            variables[name] = cell.cell_contents
        except ValueError:  # not assigned yet
            continue
    yield from variables.items()
    for name, module in variables.items():
        if isinstance(module, types.ModuleType):
            yield from ((f"{name}.{one}", vars(module)[one]) for one in attributes if one in vars(module))


@functools.lru_cache(maxsize=4096)
def _names(code: types.CodeType) -> tuple[list[str], list[str]]:
    """Return the names of globals and attributes in code, and in that of functions and comprehensions inside."""
    codes = [code]
    for one in codes:
        codes += [constant for constant in one.co_consts if isinstance(constant, types.CodeType)]
    # `co_names` has the names of globals and of attributes together.
    steps = (step for one in codes for step in dis.get_instructions(one))
    global_names = dict.fromkeys(step.argval for step in steps if step.opname == "LOAD_GLOBAL")
    return list(global_names), list(dict.fromkeys(name for one in codes for name in one.co_names))


@functools.lru_cache(maxsize=4096)
def _is_library(module: str | None) -> bool:
    """Return whether a module is Python's, of an installed package, or of this one."""
    top = (module or "").partition(".")[0]
    path = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    in_packages = "site-packages" in path or "dist-packages" in path
    return in_packages or top == "torchtransient" or top in sys.stdlib_module_names


# --------------------------------------------------------------------------------------------------- lost gradients


def _wants_gradient(value: Any) -> bool:
    """Return whether a value is a torch tensor that is to be differentiated by."""
    return isinstance(value, torch.Tensor) and (
        (value.requires_grad and torch.is_grad_enabled()) or _is_transformed(value)
    )


def _is_transformed(tensor: torch.Tensor) -> bool:
    """Return whether a tensor carries a tangent, or belongs to a ``grad`` or ``vmap`` of torch.func."""
    private: Any = torch._C
    if private._functorch.is_functorch_wrapped_tensor(tensor):
        return True
    return forward_ad.unpack_dual(tensor).tangent is not None  # type: ignore[no-untyped-call]


def _entries(value: Any) -> tuple[Any, ...]:
    """Return the entries of a container of Python, or of a list of parameters of torch."""
    if isinstance(value, (list, tuple, set, frozenset, deque, torch.nn.ParameterList)):
        return tuple(value)
    if isinstance(value, (dict, types.MappingProxyType, UserDict, torch.nn.ParameterDict)):
        return tuple(value.values())
    return tuple(vars(value).values()) if isinstance(value, types.SimpleNamespace) else ()
