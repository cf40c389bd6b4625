"""A call of a function of Dr.Jit, carried out and replayed for its derivatives, without any graph that lives on.

Every run takes the engine's lock, brings the variant and the scene's parameters back to what they were at the call,
calls the function on tensors of Dr.Jit, and puts everything back at its end.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch

from torchtransient._collection import no_collection
from torchtransient.errors import GradientError, ShapeError, UnitError, VariantError
from torchtransient.plugins.unfinished import afterwards
from torchtransient.rendering.arrays import as_tensor, as_torch, fresh, handle, own
from torchtransient.rendering.broken_numbers import carried_on
from torchtransient.rendering.derivatives import Asked
from torchtransient.rendering.generators import Generators
from torchtransient.rendering.interrupts import ends_frames
from torchtransient.rendering.scene_state import put_back, values_of, write
from torchtransient.rendering.seeds import mix_seed
from torchtransient.rendering.surroundings import is_typed_structure
from torchtransient.rendering.trees import Tree, taken_apart
from torchtransient.rendering.variant import active_variant, at_work, in_variant, is_differentiable, take_over
from torchtransient.scene.parameters import is_transform
from torchtransient.scene.physics import are_finite, smallest_and_largest

Tensors = tuple[torch.Tensor, ...]

# The process in which functions have run: Dr.Jit does not survive a fork, whether Mitsuba was in use or not.
_ran = {"in": 0}
# Python's errors where an array of Dr.Jit is used as a tensor of torch.
_TAKEN_FOR_TORCH = re.compile(r"must be Tensor, not TensorX|'TensorX\w+' object has no attribute")


@dataclass(frozen=True)
class TensorLeaf:
    """Where tensor ``number`` of a call stands among its arguments."""

    number: int


@dataclass(frozen=True)
class SeedLeaf:
    """A seed of a call, which derivatives replace by another one that follows from it."""

    seed: int


@dataclass(frozen=True)
class Returned:
    """What a function has returned beside numbers: its structure, and its leaves that are no arrays."""

    tree: Tree
    leaves: tuple[Any, ...]


@dataclass(frozen=True)
class ScenesAtCall:
    """``SceneParameters`` that a function reads or writes, and the values that they held at its call."""

    params: tuple[Any, ...]
    values: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Call:
    """Everything about a call that is not a tensor (:class:`.derivatives.Replayable`).

    ``leaves``: the arguments ``(args, kwargs)`` of ``tree`` with a :class:`TensorLeaf` for each tensor. ``keys``: the
    first tensors are values of these keys of ``scenes.params[0]``, which is then the function's first argument.
    ``generators``: their states at the call. ``frozen``:
    what of the function is frozen, if anything. ``returned`` collects what each primal run returned: under
    ``vmap`` a call is several runs.
    """

    function: Callable[..., Any]
    name: str
    tree: Tree
    leaves: tuple[Any, ...]
    keys: tuple[str, ...] | None
    variant: str | None
    scenes: ScenesAtCall
    generators: Generators
    frozen: str | None
    returned: list[Returned] = field(default_factory=list)

    @property
    def what(self) -> str:
        return f"the wrapped function {self.name}"

    # ------------------------------------------------------------------------------------------------------- runs

    # What a run has made of Dr.Jit's is let go of inside of the lock: a graph that is freed beside the work of another
    # thread waits for it, and it for the graph.

    @ends_frames
    def primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        """The arrays that the function returns."""
        import drjit as dr

        self._check_finite(tensors)
        with self._at_work(), dr.resume_grad():
            return self._primal(tensors)

    @ends_frames
    def pullback(self, asked: Asked, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]) -> Tensors:
        """Gradients of <cotangents, outputs>, of the tensors that need one. What cotangents that are not finite
        touch is NaN.
        """
        import drjit as dr

        def run(given: Sequence[torch.Tensor]) -> Tensors:
            with self._at_work(), dr.resume_grad():
                return self._pullback(asked, tensors, given)

        return carried_on(run, cotangents)

    @ends_frames
    def pushforward(self, asked: Asked, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]) -> Tensors:
        """Derivatives of the real outputs along tangents of the tensors that need one. What tangents that are not
        finite touch is NaN.
        """
        import drjit as dr

        def run(given: Sequence[torch.Tensor]) -> Tensors:
            with self._at_work(), dr.resume_grad():
                return self._pushforward(asked, tensors, given)

        return carried_on(run, tangents)

    def _primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        returned, arrays = self._outputs([own(tensor) for tensor in tensors], derivative=False)
        self.returned.append(returned)
        return as_torch([fresh(array) for array in arrays])

    def _pullback(self, asked: Asked, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]) -> Tensors:
        import drjit as dr

        leaves, wanted = self._attached(asked, tensors)
        outputs = self._real_outputs(leaves, wanted, len(asked.given))
        asking = [output for output, is_given in zip(outputs, asked.given, strict=True) if is_given]
        self._check_dependence(asking)
        for output, cotangent in zip(asking, cotangents, strict=True):
            if dr.grad_enabled(output):
                # two outputs may be one array; no memory of torch's, which Dr.Jit would free under a lock of its own
                dr.accum_grad(output, own(cotangent))
        # Of all that leads to the outputs, what the wanted leaves lead to: nobody else gets a gradient.
        for leaf in wanted:
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Backward)
        return as_torch([_derivative(leaf) for leaf in wanted])

    def _pushforward(self, asked: Asked, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]) -> Tensors:
        import drjit as dr

        leaves, wanted = self._attached(asked, tensors)
        outputs = self._real_outputs(leaves, wanted, None)
        self._check_dependence(outputs)
        for leaf, tangent in zip(wanted, tangents, strict=True):
            dr.set_grad(leaf, own(tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
        # Outputs keep their tangents, though others may be computed from them.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        return as_torch([_derivative(output) for output in outputs])

    # ------------------------------------------------------------------------------------------------------ steps

    def _check_finite(self, tensors: Sequence[torch.Tensor]) -> None:
        """Raise ``UnitError`` for values of a scene that are not finite."""
        for key, value in zip(self.keys or (), tensors, strict=False):
            if not are_finite(*smallest_and_largest(value)):
                raise UnitError(
                    f"{self.name}: value of {key!r}: expected finite numbers, got some that are NaN or infinite."
                )

    def _attached(self, asked: Asked, tensors: Sequence[torch.Tensor]) -> tuple[list[Any], list[Any]]:
        """All leaves, and those that need a derivative."""
        import drjit as dr

        if self.frozen is not None:
            raise GradientError(
                f"{self.name}: {self.frozen} is frozen (dr.freeze), and Dr.Jit has no derivatives of frozen functions: "
                "they would be zero. Leave out dr.freeze, or detach the arguments."
            )
        leaves = [own(tensor) for tensor in tensors]
        wanted = [leaf for leaf, need in zip(leaves, asked.needs, strict=True) if need]
        dr.enable_grad(wanted)
        return leaves, wanted

    def _real_outputs(self, leaves: list[Any], wanted: Sequence[Any], count: int | None) -> list[Any]:
        import drjit as dr

        returned, arrays = self._outputs(leaves, derivative=True)
        if any(map(_has_gradient, wanted)):
            raise GradientError(
                f"{self.name}: the function differentiates by itself (dr.backward), and by an argument that wants a "
                "derivative: that of the result would be a second one, which Dr.Jit does not have. Use dr.detach on "
                "the argument in what is differentiated inside, where it is meant as a constant there."
            )
        outputs = [array for array in arrays if dr.is_float_v(array)]
        if (self.returned and returned.tree != self.returned[0].tree) or (count or len(outputs)) != len(outputs):
            raise GradientError(
                f"{self.name}: the function returned another structure when it was replayed for its derivative. "
                "Expected a function that does the same with the same arguments."
            )
        return outputs

    def _outputs(self, leaves: list[Any], derivative: bool) -> tuple[Returned, list[Any]]:
        """(structure, arrays as tensors) of what the function returns for tensors of Dr.Jit."""
        given: list[Any] = []
        for leaf in self.leaves:
            if isinstance(leaf, TensorLeaf):
                given.append(handle(leaves[leaf.number]))
            elif isinstance(leaf, SeedLeaf):
                given.append(mix_seed(leaf.seed, 0x5EED) if derivative else leaf.seed)
            else:
                given.append(handle(leaf))
        args, kwargs = self.tree.put_together(iter(given))
        if self.keys is not None:
            params = self.scenes.params[0]
            write(params, {key: leaf.array for key, leaf in zip(self.keys, leaves, strict=False)}, self.name)
            args = (params, *args)
        try:
            result = self.function(*args, **kwargs)
        except (TypeError, AttributeError) as error:
            if _TAKEN_FOR_TORCH.search(str(error)):
                error.add_note(
                    f"tt.wrap: tensors arrive in {self.name} as arrays of Dr.Jit (TensorXf), which functions and "
                    "methods of torch do not take. Inside, write dr.sin(x), dr.sum(x) and so on (import drjit as dr); "
                    "functions of torch alone need no tt.wrap."
                )
            raise
        return self._returned(result)

    def _returned(self, result: Any) -> tuple[Returned, list[Any]]:
        import drjit as dr

        tree, leaves = taken_apart(result, is_leaf=lambda part: is_transform(part) or is_typed_structure(part))
        plain: list[Any] = []
        arrays: list[Any] = []
        for leaf in leaves:
            value = leaf.matrix if is_transform(leaf) else leaf
            if isinstance(value, torch.Tensor):
                raise GradientError(
                    f"{self.name}: expected arrays of Dr.Jit, got a torch tensor from the function, which derivatives "
                    "cannot pass. Return the array; for a part in torch, drjit.wrap(source='drjit', target='torch')."
                )
            if is_typed_structure(value):
                raise ShapeError(
                    f"{self.name}: expected arrays of Dr.Jit or structures of Python, got a {type(value).__name__}, "
                    "whose fields cannot be tensors. Return them in a dictionary: "
                    f"{', '.join(type(value).DRJIT_STRUCT)}."
                )
            is_array = dr.is_array_v(value)
            if is_array and dr.scalar_t(value) not in (float, int, bool):
                raise ShapeError(
                    f"{self.name}: expected arrays of numbers, got a {type(value).__name__} among what the function "
                    "returned, as interactions and emitter samples have one. Return the fields that are numbers, in a "
                    "dictionary."
                )
            plain.append(TensorLeaf(len(arrays)) if is_array else value)
            if is_array:
                arrays.append(as_tensor(value))
        return Returned(tree, tuple(plain)), arrays

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
        with ExitStack() as stack:
            stack.enter_context(working_in(self.variant))
            stack.enter_context(no_collection(of_call=True))
            # A part in torch inside of the function differentiates itself, and in all runs alike.
            stack.enter_context(torch.enable_grad())
            stack.enter_context(_without_autocast())
            if self.returned:  # not the first run
                stack.enter_context(self.generators.again())
            with self._scenes_as_at_call():
                yield

    @contextmanager
    def _scenes_as_at_call(self) -> Iterator[None]:
        import drjit as dr

        before = [values_of(params) for params in self.scenes.params]

        def as_before() -> None:
            with dr.resume_grad():
                for params, values in zip(self.scenes.params, before, strict=True):
                    put_back(params, values)

        with afterwards(in_variant(self.variant, as_before)):
            for params, values, now in zip(self.scenes.params, self.scenes.values, before, strict=True):
                put_back(params, values, now)
            yield

    def result(self, tensors: Tensors) -> Any:
        """What the function returned, with tensors for its arrays. Raises ``ShapeError`` where the entries of a
        ``vmap`` have returned different things.
        """
        first = self.returned[0]
        for other in self.returned[1:]:
            same = other.tree == first.tree and all(map(_equal, first.leaves, other.leaves))
            if not same:
                raise ShapeError(
                    f"{self.name}: under torch.func.vmap every entry must return the same structure, and the same "
                    f"values that are no arrays; got {first.leaves} and {other.leaves}. Return arrays."
                )
        leaves = (tensors[leaf.number] if isinstance(leaf, TensorLeaf) else leaf for leaf in first.leaves)
        return first.tree.put_together(iter(leaves))


@contextmanager
def working_in(variant: str | None) -> Iterator[None]:
    """Hold the engine lock with a variant active, where it is one that derivatives are computed in. Raises
    ``VariantError`` in a process that was forked from one in which Dr.Jit was at work.
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
        _check_fork()
        yield


def _derivative(tensor: Any) -> Any:
    """What has arrived at a tensor; where it has no entries Dr.Jit has a single zero for it."""
    import drjit as dr

    return fresh(dr.grad(tensor)) if dr.width(tensor) else tensor


def _has_gradient(leaf: Any) -> bool:
    """Whether something has arrived at a leaf."""
    import drjit as dr

    found = dr.grad(leaf).array
    return bool(dr.width(found)) and (found.state != dr.VarState.Literal or bool(dr.any(found != 0)))


def _equal(a: Any, b: Any) -> bool:
    try:
        return a is b or bool(a == b)
    except (TypeError, ValueError, RuntimeError):
        return False


def _check_fork() -> None:
    if _ran["in"] not in (0, os.getpid()):
        raise VariantError(
            "this process was forked from one in which a wrapped function had run, and Dr.Jit does not survive a fork. "
            "Expected a fresh process: use multiprocessing.get_context('spawn'), or DataLoader(..., "
            "multiprocessing_context='spawn')."
        )
    _ran["in"] = os.getpid()


@contextmanager
def _without_autocast() -> Iterator[None]:
    with ExitStack() as stack:
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        yield
