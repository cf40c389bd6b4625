"""Copies of BSDFs that hold one other (two-sided, bump and normal maps), around another nested one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.host_numbers import host_numbers
from torchtransient.plugins.mitsuba_compat import HIDDEN_FLAGS, is_two_sided_itself, normal_texture
from torchtransient.plugins.node_walk import objects_below, objects_of, shown_by


def can_be_rebuilt(wrapper: Any) -> bool:
    """Whether a BSDF is one that :func:`rebuild_wrapper` knows."""
    return is_two_sided_itself(wrapper) or normal_texture(wrapper) is not None


def rebuild_wrapper(wrapper: Any, nested: Any, flags: dict[str, bool]) -> Any:
    """A BSDF that does to ``nested`` what ``wrapper`` (two-sided, bump or normal map) does to the one it holds. Shares
    the textures. ``flags``: see :func:`flags_of`.
    """
    slot = normal_texture(wrapper)
    if slot is None:
        return mi.load_dict({"type": "twosided", "allow_transmission": True, "nested": nested})
    plain = {shown.key: shown.read(wrapper) for shown in shown_by(wrapper)[0]}
    texture = dict(objects_of(wrapper))[slot]
    return mi.load_dict({"type": wrapper.class_name().lower(), slot: texture, **plain, **flags, "nested": nested})


def flags_of(wrapper: Any) -> dict[str, bool]:
    """Properties of a bump or normal map that a built one does not show.

    They are told by what it samples, with values of textures by which all choices differ: not with those of now, since
    a map that is flat or a surface that is black now may be changed.
    """
    if normal_texture(wrapper) is None:
        return {}
    own = next(value for _, value in objects_of(wrapper) if isinstance(value, mi.BSDF))
    with _telling_values(wrapper):
        reference = samples_of(wrapper)
        for number in reversed(range(2 ** len(HIDDEN_FLAGS))):
            flags = {name: bool(number >> place & 1) for place, name in enumerate(HIDDEN_FLAGS)}
            if samples_of(rebuild_wrapper(wrapper, own, flags)) == reference:
                return flags
    raise SceneError(
        f"{wrapper.class_name()} '{wrapper.id()}': expected one that samples as those of Mitsuba with some choice of "
        f"{', '.join(HIDDEN_FLAGS)}, got other samples. Put it into the parts of the mixture that it holds."
    )


@contextmanager
def _telling_values(wrapper: Any) -> Iterator[None]:
    """For the time of a question: random numbers in all textures below a BSDF, and a scale that is not zero."""
    rng, before = np.random.default_rng(0), []
    try:
        with dr.resume_grad():
            for node in (wrapper, *objects_below(wrapper, mi.Texture)):
                params = mi.traverse(node)
                for key in {"value", "data", "scale"} & set(params.keys()):
                    value = params[key]
                    before.append((params, key, type(value)(value)))
                    params[key] = _random(value, rng)
                params.update()
        yield
    finally:
        with dr.resume_grad():
            for params, key, value in before:
                params[key] = value
                params.update()


def _random(value: Any, rng: np.random.Generator) -> Any:
    """Numbers between 0.6 and 1 (of the range of whole ones) of the shape of a parameter."""
    numbers = host_numbers(value, None)
    drawn = rng.uniform(0.6, 1.0, numbers.shape)
    if np.issubdtype(numbers.dtype, np.integer):
        drawn = drawn * np.iinfo(numbers.dtype).max
    return type(value)(drawn.astype(numbers.dtype) if dr.is_array_v(value) else float(drawn))


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
