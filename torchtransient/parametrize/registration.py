"""Parametrizations of a module's parameters by their keys: Mitsuba's, with dots, or torch's."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchtransient.errors import ArgumentError, SceneError, ShapeError, TorchTransientError, UnknownKeyError
from torchtransient.floating import without_autocast
from torchtransient.modules import let_copy
from torchtransient.parametrize.bounded import Roughness


@without_autocast
def register(module: nn.Module, key: str, parametrization: nn.Module) -> nn.Module:
    """Register a parametrization by a key: `torch.nn.utils.parametrize.register_parametrization`.

    The value stays as it is, by `right_inverse`; a parametrization without that function takes the present value for
    the underlying numbers. Make optimisers afterwards: `module.parameters()` then has the underlying numbers
    (`original`), and `renderer.values[key]` the value. Copies and pickles of the module keep its parametrizations, each
    copy its own (`CopiesParametrized`). A further parametrization of the same key is applied after those before it, and
    the value stays as it is.

    Args:
        module: a renderer, or any module.
        key: name of the value. For a renderer, or a module that holds one, a key of its scene, such as
            `"box.to_world"`; for other modules a path, such as `"encoder.weight"`; where a module holds several
            renderers, the path of one followed by the key.
        parametrization: module of `tt.parametrize`, or any other.

    Returns:
        The module.

    Raises:
        UnknownKeyError: for a key that is not there.
        SceneError: for a kind that the key has already, for one without `right_inverse` behind others, and for a
            `Roughness` of principled materials; everything stays as it was.
        ShapeError: where it does not fit; the errors of `right_inverse` where it cannot have that value.
    """
    if not isinstance(parametrization, nn.Module):
        raise ArgumentError(
            f"register: expected an nn.Module, tt.parametrize.Albedo() for instance, got {parametrization!r}."
        )
    owner, name = _place(module, key)
    if isinstance(parametrization, Roughness) and "roughness" in key.replace("/", ".").split("."):
        # The two clamps differ by a factor of 32, in between which a fit would stand still.
        raise SceneError(
            f"register: {key!r} is of a principled material: expected PrincipledRoughness, or Bounded, got Roughness."
        )
    kind = type(parametrization).__name__
    try:
        if parametrize.is_parametrized(owner, name):
            _append(owner, name, key, parametrization)
        else:
            parametrize.register_parametrization(owner, name, parametrization)
    except TorchTransientError:
        raise
    except (ValueError, RuntimeError) as error:
        raise ShapeError(f"register: {kind} does not fit {key!r}: {error}") from error
    let_copy(owner)
    return module


def _append(owner: nn.Module, name: str, key: str, parametrization: nn.Module) -> None:
    """One more on a key, of which the present value is made."""
    chain = _chain(owner, name)
    kind, before = type(parametrization), [type(one).__name__ for one in chain]
    cure = f"tt.parametrize.remove(module, {key!r}) takes away what is there."
    if kind in {type(one) for one in chain}:
        raise SceneError(f"register: {key!r} has {kind.__name__} already, remove it first: {cure}")
    for one in (parametrization, *chain):
        if not hasattr(one, "right_inverse"):
            raise SceneError(
                f"register: {key!r} has {', '.join(before)} already, and another after it cannot keep its value: "
                f"{type(one).__name__} has no right_inverse. {cure}"
            )
    value = getattr(owner, name).detach().clone()
    # The tensors of which a chain makes its value: parameters, or buffers.
    behind = [*chain.parameters(recurse=False), *chain.buffers(recurse=False)]
    numbers = [(one, one.detach().clone()) for one in behind]
    # Torch's own call leaves the numbers behind as they were, of which the two make another value.
    chain.append(parametrization.train(owner.training))
    try:
        chain.right_inverse(value)
        found = chain()
        if found.shape != value.shape or found.dtype != value.dtype:
            raise ShapeError(f"it makes {tuple(found.shape)} of {found.dtype}, expected the value's.")
    except BaseException as error:
        del chain[-1]
        for one, old in numbers:
            one.data = old
        if not isinstance(error, (TorchTransientError, ValueError, RuntimeError)):
            raise
        wrong = type(error) if isinstance(error, TorchTransientError) else ShapeError
        raise wrong(
            f"register: {key!r} has {', '.join(before)} already, and with {kind.__name__} after it cannot keep its "
            f"value: {error} {cure}"
        ) from error


def original(module: nn.Module, key: str) -> nn.Parameter:
    """Return the underlying numbers of a parametrized value, which optimisers change; for a buffer a tensor, which they
    do not change.

    Args:
        module: a renderer, or any module.
        key: name of the value, see `register`.

    Raises:
        UnknownKeyError: for a key that is not there.
        SceneError: for a key without a parametrization, or with one that makes the value from several tensors.
    """
    owner, name = _parametrized(module, key)
    chain = _chain(owner, name)
    if not chain.is_tensor:
        names = ", ".join(f"original{k}" for k in range(chain.ntensors))
        raise SceneError(f"{key!r} has several tensors behind its value: {names} of module.parametrizations[{name!r}].")
    return cast(nn.Parameter, chain.original)


def remove(module: nn.Module, key: str) -> nn.Module:
    """Take the parametrizations of a key away.

    Its value stays as it is, in a new `nn.Parameter` (of a buffer, a buffer): make optimisers afterwards.

    Args:
        module: a renderer, or any module.
        key: name of the value, see `register`.

    Returns:
        The module.

    Raises:
        UnknownKeyError: for a key that is not there.
        SceneError: for a key without a parametrization.
    """
    owner, name = _parametrized(module, key)
    chain = _chain(owner, name)
    behind = [*chain.parameters(recurse=False)]
    with torch.no_grad():
        value = getattr(owner, name).detach().clone()
    # Torch writes the value into the tensor behind it, which is left with a shape of its own elsewhere.
    parametrize.remove_parametrizations(owner, name, leave_parametrized=not chain.is_tensor)
    delattr(owner, name)
    if behind:
        owner.register_parameter(name, nn.Parameter(value, requires_grad=any(one.requires_grad for one in behind)))
    else:
        owner.register_buffer(name, value)
    return module


def _chain(owner: nn.Module, name: str) -> Any:
    """Torch's list of the parametrizations of a name."""
    return owner.parametrizations[name]  # type: ignore[index]


def _parametrized(module: nn.Module, key: str) -> tuple[nn.Module, str]:
    owner, name = _place(module, key)
    if not parametrize.is_parametrized(owner, name):
        raise SceneError(f"{key!r} has no parametrization; tt.parametrize.register(module, key, ...) gives it one.")
    return owner, name


def _place(module: nn.Module, key: str) -> tuple[nn.Module, str]:
    """The module that holds the parameter of a key, and its name there."""
    # Torch forbids dots in names: renderers have slashes for them.
    parts = key.split(".")
    for k in range(len(parts)):
        try:
            owner = module.get_submodule(".".join(parts[:k]))
        except AttributeError:
            break
        if _has(owner, "/".join(parts[k:])):
            return owner, "/".join(parts[k:])
    name = "/".join(parts)
    found = [one for one in module.modules() if _has(one, name)]
    if len(found) == 1:
        return found[0], name
    known = sorted({n.replace("/", ".") for n, _ in module.named_parameters()})  # as keys are written
    there = f"there are {', '.join(known[:8])}{' ...' if len(known) > 8 else ''}" if known else "it has none"
    what = "has no parameter" if not found else "has several modules with a parameter"
    who = parametrize.type_before_parametrizations(module).__name__
    raise UnknownKeyError(f"{who} {what} {key!r}; {there}.")


def _has(module: nn.Module, name: str) -> bool:
    own: dict[str, Tensor] = dict(module.named_parameters(recurse=False)) | dict(module.named_buffers(recurse=False))
    return name in own or parametrize.is_parametrized(module, name)
