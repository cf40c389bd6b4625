"""Parametrizations of a module's parameters by their keys: Mitsuba's, with dots, or torch's."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn.utils import parametrize

from torchtransient.errors import SceneError, ShapeError, TorchTransientError, UnknownKeyError
from torchtransient.parametrize.bounded import Roughness


def register(module: nn.Module, key: str, parametrization: nn.Module) -> nn.Module:
    """`torch.nn.utils.parametrize.register_parametrization` by a key: of a renderer, or a module that holds one, a key
    of its scene, `"box.to_world"`; of other modules a path, `"encoder.weight"`; or one behind the other where a module
    holds several renderers. Returns the module.

    The present value is where it starts, by `right_inverse`. Optimisers are made afterwards: `module.parameters()` has
    the numbers behind the value (`original`), and `renderer.values[key]` the value. Another one on the same key is
    applied after the first. Raises UnknownKeyError, the errors of `right_inverse`, ShapeError where it does not
    fit, and SceneError for a `Roughness` of principled materials.
    """
    if not isinstance(parametrization, nn.Module):
        raise SceneError(
            f"register: expected a parametrization, an nn.Module, got {type(parametrization).__name__}; "
            "tt.parametrize.Albedo() for instance."
        )
    if isinstance(parametrization, Roughness) and "roughness" in key.replace("/", ".").split("."):
        # The two clamps differ by a factor of 32, in between which a fit would stand still.
        raise SceneError(
            f"register: {key!r} is of a principled material: expected PrincipledRoughness, or Bounded, got Roughness."
        )
    owner, name = _place(module, key)
    try:
        parametrize.register_parametrization(owner, name, parametrization)
    except TorchTransientError:
        raise
    except (ValueError, RuntimeError) as error:
        kind = type(parametrization).__name__
        raise ShapeError(f"register: {kind} does not fit {key!r}: {error}") from error
    return module


def original(module: nn.Module, key: str) -> nn.Parameter:
    """The numbers behind a parametrized value, which optimisers change. Raises UnknownKeyError, and SceneError for a
    key without a parametrization.
    """
    owner, name = _parametrized(module, key)
    behind = owner.parametrizations[name].original  # type: ignore[index, union-attr]
    assert isinstance(behind, nn.Parameter)
    return behind


def remove(module: nn.Module, key: str) -> nn.Module:
    """Take the parametrizations of a key away. Its value stays as it is, in a new `nn.Parameter`: make optimisers
    afterwards. Returns the module. Raises as `original`.
    """
    owner, name = _parametrized(module, key)
    with torch.no_grad():
        value = getattr(owner, name).detach().clone()
    wanted = original(module, key).requires_grad
    # Torch writes the value into the tensor behind it, which is left with a shape of its own elsewhere.
    parametrize.remove_parametrizations(owner, name, leave_parametrized=False)
    owner.register_parameter(name, nn.Parameter(value, requires_grad=wanted))
    return module


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
    known = sorted({n for n, _ in module.named_parameters()})
    there = f"there are {', '.join(known[:8])}{' ...' if len(known) > 8 else ''}" if known else "it has none"
    what = "has no parameter" if not found else "has several modules with a parameter"
    who = parametrize.type_before_parametrizations(module).__name__
    raise UnknownKeyError(f"{who} {what} {key!r}; {there}.")


def _has(module: nn.Module, name: str) -> bool:
    own = dict(module.named_parameters(recurse=False)) | dict(module.named_buffers(recurse=False))
    return name in own or parametrize.is_parametrized(module, name)
