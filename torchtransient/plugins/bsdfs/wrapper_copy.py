"""Copies of BSDFs that hold one other (two-sided, bump and normal maps), around another nested one."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import is_two_sided_itself, normal_texture
from torchtransient.plugins.node_walk import objects_of, shown_by


def rebuild_wrapper(wrapper: Any, nested: Any) -> Any:
    """A BSDF that does to ``nested`` what ``wrapper`` (two-sided, bump or normal map) does to the one it holds. Shares
    the textures. Raises SceneError for other BSDFs.
    """
    name, slot = wrapper.class_name(), normal_texture(wrapper)
    if is_two_sided_itself(wrapper):
        return mi.load_dict({"type": "twosided", "allow_transmission": True, "nested": nested})
    if slot is None:
        raise SceneError(
            f"BSDF '{wrapper.id()}': expected mask and blendbsdf outermost or inside twosided, bumpmap and normalmap, "
            f"got one inside {name}. Put {name} inside the mixture."
        )
    held = dict(objects_of(wrapper))
    own = next(value for value in held.values() if isinstance(value, mi.BSDF))
    plain = {shown.key: shown.read(wrapper) for shown in shown_by(wrapper)[0]}
    candidates = []
    for flips, shadows in ((True, True), (True, False), (False, True), (False, False)):
        plain |= {"flip_invalid_normals": flips, "use_shadowing_function": shadows}
        kind = {"type": name.lower(), slot: held[slot], **plain}
        candidates.append(kind)
    # A built plugin does not show these two flags: the first that samples alike.
    reference = samples_of(wrapper)
    found = (kind for kind in candidates if samples_of(mi.load_dict({**kind, "nested": own})) == reference)
    return mi.load_dict({**next(found, candidates[0]), "nested": nested})


def samples_of(bsdf: Any) -> list[bytes]:
    """Directions and weights that a BSDF draws from many sides at many places."""
    rng = mi.PCG32(size=4096)
    u = [rng.next_float32() for _ in range(7)]
    si = dr.zeros(mi.SurfaceInteraction3f, 4096)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(u[0], u[1])
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(u[2], u[3]))
    si.wavelengths = mi.sample_rgb_spectrum(mi.sample_shifted(u[4]))[0] if mi.is_spectral else []
    with dr.suspend_grad():
        bs, weight = bsdf.sample(mi.BSDFContext(), si, u[4], mi.Point2f(u[5], u[6]))
        return [np.array(bs.wo).tobytes(), np.array(mi.unpolarized_spectrum(weight)).tobytes()]
