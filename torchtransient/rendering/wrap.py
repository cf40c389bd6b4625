"""``tt.wrap``: any function of Dr.Jit and Mitsuba as a function of torch tensors."""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchtransient.checks import as_whole, is_one_of, shown
from torchtransient.errors import ArgumentError, GradientError, ShapeError, UnitError
from torchtransient.rendering.arguments import as_float
from torchtransient.rendering.arrays import computable, handle
from torchtransient.rendering.derivatives import run
from torchtransient.rendering.generators import Generators
from torchtransient.rendering.opaque import opaque
from torchtransient.rendering.reached import Reached
from torchtransient.rendering.replay import Call, ScenesAtCall, SeedLeaf, TensorLeaf, working_in
from torchtransient.rendering.scene_state import detached, shapes_of, values_of, variant_of
from torchtransient.rendering.surroundings import entries_of, is_typed_structure, wants_derivative
from torchtransient.rendering.trees import taken_apart
from torchtransient.rendering.variant import at_work, device_type


def wrap(
    function: Callable[..., Any] | None = None,
    parameters: Any = None,
    *,
    source: str | types.ModuleType = "torch",
    target: str | types.ModuleType = "drjit",
    state: Any = (),
    reseed: str | None = None,
) -> Callable[..., Any]:
    """A function of Dr.Jit and Mitsuba as a differentiable function of torch tensors, in the place of ``drjit.wrap``.

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

    ``parameters``: a ``mitsuba.SceneParameters``. The first argument of the wrapped function is then a mapping from
    its keys to values: these are written to the scene, in the shapes that ``tt.Scene.parameters`` lists, without a
    batch, and the function gets ``parameters`` in their place. Every scene that the function reaches is put back after
    each call and derivative: ``SceneParameters`` and objects of Mitsuba among its arguments, its variables, defaults
    and bound arguments, those of the functions that it names and of the methods of its objects, and attributes and
    entries of these. ``state``: ``SceneParameters``, or a list of them, of scenes that it reaches in another way.

    A derivative is a replay: it calls the function once more with the arguments that were saved and the scene as it
    was at the call, attached, and keeps nothing. So the function has to do the same for the same arguments. Seeds are
    the same in both, since what follows the light in the function, a loss for instance, needs the image that was
    returned; ``mi.render`` itself takes another seed for its adjoint. ``reseed``: name of an argument that is a seed,
    which derivatives replace by another one: for functions that sample by themselves and return what is linear in it,
    it makes gradients of squared losses unbiased.

    Two backwards, several calls before one, edits in place (an error, as torch's own), threads, autocast, ``no_grad``,
    forward mode and ``torch.func`` work as for the renderer. Second derivatives are refused. Not supported: complex
    tensors (``torch.view_as_real``), other directions than torch to Dr.Jit (``drjit.wrap`` does them well), torch
    tensors as results of the function, derivatives by what the function knows otherwise than by its arguments.

    Raises ``ArgumentError`` for wrong options. The wrapped function raises ``ShapeError``, ``DeviceError``,
    ``UnitError`` and ``UnknownKeyError`` for values that do not fit, ``GradientError`` for derivatives that do not
    exist, ``VariantError`` in a forked process, and what the function raises.
    """
    _check_direction(source, target)
    if function is None:
        return lambda given: wrap(given, parameters, source=source, target=target, state=state, reseed=reseed)
    wrapped = _Wrapped(function, parameters, state, reseed)

    @functools.wraps(function, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        return wrapped(*args, **kwargs)

    shown = opaque(call)
    shown.__wrapped__ = function  # type: ignore[attr-defined]
    return shown


def _check_direction(source: Any, target: Any) -> None:
    names = tuple(given.__name__ if isinstance(given, types.ModuleType) else given for given in (source, target))
    if not (is_one_of(names[0], ("torch",)) and is_one_of(names[1], ("drjit",))):
        raise ArgumentError(
            f"tt.wrap: expected source='torch' and target='drjit', got {shown(names[0])} and {shown(names[1])}. Other "
            "directions are those of drjit.wrap."
        )


@dataclass(frozen=True)
class _Given:
    """The arguments of one call, taken apart."""

    tensors: list[torch.Tensor]
    leaves: list[Any]


class _Wrapped:
    """A function with what it is to be called with beside its arguments."""

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
        # By address, of objects that the function reaches without parameters for them. Those of the last call alone.
        self.traversed: dict[int, Any] = {}
        self.signature = self._checked_signature() if reseed is not None else None
        self.first = _first_argument(function)

    def _checked_signature(self) -> inspect.Signature:
        signature = inspect.signature(self.function)
        if not is_one_of(self.reseed, signature.parameters):
            raise ArgumentError(
                f"tt.wrap: reseed={shown(self.reseed)} is no argument of {self.name}, which has "
                f"{', '.join(signature.parameters) or 'none'}."
            )
        return signature

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if self.signature is not None:
            args, kwargs = self._seeded(self.signature, args, kwargs)
        mapping, args, kwargs = self._mapping(args, kwargs)
        tree, leaves = taken_apart((args, kwargs), is_leaf=_is_leaf)
        # what a module is called by names nothing of its own
        named = self.function.forward if isinstance(self.function, torch.nn.Module) else self.function
        reached = Reached(named, leaves)
        scenes = self._scenes(reached)
        variant = self._variant(scenes)
        with working_in(variant):
            values = self._values(mapping)
            given = self._given(leaves, values)
            held = tuple(detached(values_of(params)) for params in scenes)
            call = Call(
                function=self.function,
                name=self.name,
                tree=tree,
                leaves=tuple(given.leaves),
                keys=None if self.parameters is None else tuple(mapping),
                variant=variant,
                scenes=ScenesAtCall(scenes, held),
                generators=Generators.now(),
                frozen=self._frozen(reached),
            )
        return call.result(run(call, *given.tensors))

    # -------------------------------------------------------------------------------------------------- arguments

    def _mapping(
        self, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[Mapping[str, Any], tuple[Any, ...], dict[str, Any]]:
        """(values by key, other arguments, those by name). The values may come by the name of the first argument."""
        if self.parameters is None:
            return {}, args, kwargs
        if not args and self.first in kwargs:
            args, kwargs = (kwargs[self.first],), {name: value for name, value in kwargs.items() if name != self.first}
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

    def _seeded(
        self, signature: inspect.Signature, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """The arguments with a :class:`SeedLeaf` for the seed."""
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        seed = bound.arguments[str(self.reseed)]
        number = as_whole(seed)
        if number is None:
            raise UnitError(f"{self.name}: {self.reseed}: expected a whole number as a seed, got {shown(seed)}.")
        bound.arguments[str(self.reseed)] = SeedLeaf(number)
        return bound.args, bound.kwargs

    def _given(self, leaves: Sequence[Any], values: Sequence[torch.Tensor]) -> _Given:
        tensors, kept = list(values), []
        for leaf in leaves:
            if isinstance(leaf, torch.Tensor):
                kept.append(TensorLeaf(len(tensors)))
                tensors.append(computable(leaf, f"{self.name}: argument"))
            else:
                _check_unattached(leaf, "an argument", self.name)
                kept.append(handle(leaf))  # a replay sees what the call has seen
        return _Given(tensors, kept)

    def _scenes(self, reached: Reached) -> tuple[Any, ...]:
        """Every ``SceneParameters`` that the function has to do with, the one of ``parameters`` first."""
        for name, value in reached.named:
            _check_unattached(value, f"the variable {name!r}, which is no argument,", self.name)
        found = [] if self.parameters is None else [self.parameters]
        found += (*self.state, *reached.parameters)
        return (*{id(params): params for params in found}.values(), *self._traversed_of(reached.objects, found))

    def _traversed_of(self, objects: Sequence[Any], known: Sequence[Any]) -> tuple[Any, ...]:
        """Parameters of objects of Mitsuba that none of the ``known`` ones has: a function may traverse them itself."""
        import mitsuba as mi

        found: dict[int, Any] = {}
        for value in objects:
            if not any(value in params.hierarchy for params in (*known, *found.values())):
                with at_work():
                    found[value.ptr] = self.traversed.get(value.ptr) or mi.traverse(value)
        self.traversed = found
        return tuple(found.values())

    def _frozen(self, reached: Reached) -> str | None:
        if _is_frozen(self.function):
            return "the function"
        return next((f"the variable {name!r}" for name, value in reached.named if _is_frozen(value)), None)

    def _variant(self, scenes: Sequence[Any]) -> str | None:
        import mitsuba as mi

        variants = {variant for variant in map(variant_of, scenes) if variant is not None}
        if len(variants) > 1:
            raise ArgumentError(
                f"{self.name}: expected parameters of scenes of one variant, got {', '.join(sorted(variants))}."
            )
        return variants.pop() if variants else mi.variant()


def _scene_parameters(name: str, given: Any) -> Any:
    if not _is_scene_parameters(given):
        raise ArgumentError(
            f"tt.wrap: {name}: expected the mitsuba.SceneParameters of a scene, mi.traverse(mi.load_dict(...)), got "
            f"{type(given).__name__}. A tt.Scene is rendered by tt.TransientRenderer."
        )
    return given


def _is_scene_parameters(value: Any) -> bool:
    import mitsuba as mi

    return isinstance(value, mi.SceneParameters)


def _is_leaf(part: Any) -> bool:
    return isinstance(part, SeedLeaf) or is_typed_structure(part)


def _first_argument(function: Callable[..., Any]) -> str:
    """The name of a function's first argument; empty where it has none, or does not tell."""
    try:
        return next(iter(inspect.signature(function).parameters), "")
    except (TypeError, ValueError):
        return ""


def _is_frozen(value: Any) -> bool:
    kind = type(value)
    return kind.__name__ == "FrozenFunction" and kind.__module__.startswith("drjit")


def _check_unattached(value: Any, what: str, name: str) -> None:
    """Raise ``GradientError`` for what wants a gradient and would get none, and for containers of such."""
    if any(wants_derivative(part) for part in (value, *entries_of(value))):
        raise GradientError(
            f"{name}: {what} wants a gradient, and would get none: those of the torch tensors among the arguments are "
            "computed alone, in lists, tuples, dictionaries and structures. Pass it as a torch tensor, or detach it."
        )
