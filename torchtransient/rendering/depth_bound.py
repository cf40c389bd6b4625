"""A bound on the depth of paths for derivatives of scenes that state none.

A derivative keeps a record of every bounce and needs to know how many there are at most. A pilot run finds the depth
beyond which the light no longer matters, and a call whose values can have derivatives uses it for both. Renders without
derivatives have no bound: Russian roulette ends their paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd import forward_ad

from torchtransient.errors import GradientError
from torchtransient.rendering.overrides import depth_limit
from torchtransient.rendering.physics import MISSED
from torchtransient.rendering.plan_pilot import pilot_run
from torchtransient.rendering.translation import NO_LIMIT
from torchtransient.rendering.variant import active_variant

if TYPE_CHECKING:
    from torchtransient.rendering.build_options import BuildOptions
    from torchtransient.rendering.films import FilmLayout
    from torchtransient.rendering.physics import PhysicsWatch
    from torchtransient.rendering.scene_handle import Scene

# Largest share of the light that a bound leaves to deeper paths, as that of `tt.plan`.
TAIL = 1e-3


@dataclass(frozen=True)
class DepthBound:
    """``depth``: the bound. ``beyond``: share of a pilot run's light in deeper paths, the larger one of
    all light and of that in the time window; ``error``: its standard error.
    """

    depth: int
    beyond: float
    error: float


def depth_bound(
    scene: Scene, options: BuildOptions, sensors: Sequence[int], film: FilmLayout, watch: PhysicsWatch
) -> DepthBound | None:
    """The bound for derivatives of a scene, found for its described values when it is first asked for; None where its
    depth is stated. Raises GradientError where none can be found, and PhysicsError, where ``watch`` is asked for
    it, for more light beyond the bound than a time window may miss.
    """
    # One for all samplers, so that renderers that differ by theirs alone can be compared.
    options = replace(options, sampler=None)
    key = options, tuple(sensors)
    if key not in scene.depth_bounds:
        scene.depth_bounds[key] = _found(scene, options, sensors, film)
    bound = scene.depth_bounds[key]
    if bound is not None and watch.looks:
        watch.tell(
            f"max_depth {bound.depth}",
            "derivatives need a bound on the depth of paths, and the scene states none: value and derivative have "
            f"max_depth {bound.depth}, which leaves {bound.beyond:.2g} +- {bound.error:.1g} of the light to deeper "
            "paths of the described values. An optimiser that reaches brighter ones keeps the bound, with more light "
            "beyond it: give max_depth= for these then. Renders without derivatives have none.",
            is_error=bound.beyond > MISSED,
        )
    return bound


def _found(scene: Scene, options: BuildOptions, sensors: Sequence[int], film: FilmLayout) -> DepthBound | None:
    from torchtransient.rendering.scene_handle import load

    with active_variant(scene.variant):
        if depth_limit(scene.built(options).scene.integrator()) != NO_LIMIT:
            return None
    unpolarized = scene.variant.removesuffix("_polarized")
    if scene.is_shared and unpolarized != scene.variant:
        raise GradientError(
            "gradients need a bound on the depth of paths, and the integrator, which was taken as it is, has none. "
            f"Expected a max_depth: no pilot run finds one in {scene.variant}."
        )
    lit = []
    for sensor in sensors:
        _, arrivals = pilot_run(load(scene, variant=unpolarized), options, sensor, type(film), TAIL)
        lit += [part for part in film.parts(arrivals) if not part.dark]
    if not lit:
        raise GradientError(
            "gradients need a bound on the depth of paths; the scene states none, and a pilot run saw no light. Set "
            "max_depth, of the renderer or of the scene's integrator."
        )
    with active_variant(unpolarized):
        from torchtransient.plugins.integrators.pilot import PILOT_DEPTH
    beyond, error = max(arrivals.beyond(PILOT_DEPTH) for arrivals in lit)
    if beyond > TAIL / 10:
        return DepthBound(PILOT_DEPTH, beyond, error)
    depth = max(arrivals.enough_depth(TAIL) for arrivals in lit)
    return DepthBound(depth, *max(arrivals.share(arrivals.depth > depth) for arrivals in lit))


def may_have_derivative(tensor: torch.Tensor, *, graph: bool = True) -> bool:
    """Return whether autograd, forward mode or a transform of ``torch.func`` may differentiate by a tensor; without a
    ``graph`` (``torch.no_grad``) forward mode alone.
    """
    transforms = torch._C._functorch
    while not ((graph and tensor.requires_grad) or _is_dual(tensor)):
        if not transforms.is_functorch_wrapped_tensor(tensor):
            return False
        tensor = transforms.get_unwrapped(tensor)
    return True


def _is_dual(tensor: torch.Tensor) -> bool:
    try:
        unpacked: Any = forward_ad.unpack_dual(tensor)  # type: ignore[no-untyped-call]
    except RuntimeError:  # of a batch of `vmap`, which hides what it is made of
        return False
    return unpacked.tangent is not None
