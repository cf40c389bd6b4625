"""``diff_pplastic``: Mitsuba's ``pplastic`` with derivatives by the reflectances of lobes that are black."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.ior import optional_texture, specular_share
from torchtransient.plugins.node_walk import carries_derivatives, shown_by

_OTHERS = ("eta", "int_ior", "ext_ior", "distribution", "sample_visible", "alpha", "alpha_u", "alpha_v")
_DIFFUSE, _SPECULAR = "diffuse_reflectance", "specular_reflectance"


class Reflectance(mi.Texture):
    """Reflectance of a lobe. Mitsuba's plugin samples its lobes by the means of their textures; ``share`` replaces that
    mean.
    """

    def __init__(self, texture: Any) -> None:
        mi.Texture.__init__(self, mi.Properties())
        self.texture, self.share = texture, mi.Float(1)

    def eval(self, si: Any, active: Any = True) -> Any:
        return mi.UnpolarizedSpectrum(1) if self.texture is None else self.texture.eval(si, active)

    def mean(self) -> Any:
        return self.share

    def is_spatially_varying(self) -> bool:
        return self.texture is not None and self.texture.is_spatially_varying()

    def to_string(self) -> str:
        return str(self.texture)


class DiffPolarizedPlastic(mi.BSDF):
    """Parameters and values of Mitsuba's ``pplastic``, which it asks; differentiable in its textures.

    Mitsuba never samples a lobe whose reflectance is black. Here each of the two is sampled where one is, and in
    derivatives by their reflectances, see :func:`.ior.specular_share`.
    """

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.textures = {_DIFFUSE: props.get_texture(_DIFFUSE, 0.5), _SPECULAR: optional_texture(props, _SPECULAR)}
        self.lobes = {name: Reflectance(texture) for name, texture in self.textures.items()}
        given = {name: props[name] for name in _OTHERS if name in props}
        self.own = mi.load_dict({"type": "pplastic", **given, **self.lobes})
        self.m_components = [self.own.flags(i) for i in range(self.own.component_count())]
        self.m_flags = self.own.flags()
        self.parameters_changed()

    def traverse(self, cb: Any) -> None:
        for name, texture, flags in shown_by(self.own)[1]:
            shown = self.textures.get(name, texture)
            if shown is not None:
                cb.put(name, shown, flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        self._followed = None
        self.follow_derivatives(True)

    def follow_derivatives(self, asked: bool) -> None:
        """Follow derivatives as :meth:`.principled.DiffPrincipled.follow_derivatives`."""
        given = [texture for texture in self.textures.values() if texture is not None]
        followed = asked and any(carries_derivatives(texture) for texture in given)
        if followed == self._followed:
            return
        self._followed = followed
        share = specular_share(self.textures[_SPECULAR], self.textures[_DIFFUSE], followed)
        self.lobes[_SPECULAR].share, self.lobes[_DIFFUSE].share = share, 1 - share
        self.own.parameters_changed([])

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs, weight = self.own.sample(ctx, si, sample1, sample2, active)
        return bs, weight

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.own.eval(ctx, si, wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.own.pdf(ctx, si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.own.eval_pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        return f"DiffPolarizedPlastic[\n  {self.own}\n]"


register("bsdf", "diff_pplastic", DiffPolarizedPlastic)
