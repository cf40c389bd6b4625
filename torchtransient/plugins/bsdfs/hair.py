"""``diff_hair``: Mitsuba's ``hair`` with lobes whose values, densities and derivatives are those of their samples.

Light that meets a fibre leaves it after p = 0, 1, 2, ... crossings. With theta the angle to the plane across the fibre
and phi that around it, the light of p crossings is scattered as

    A_p M_p(theta_i, theta_o) N_p(phi_o - phi_i)

- ``A_p``: Fresnel's reflectance f and transmittance t = 1 - f, and the absorption T of one crossing:
  ``A_0 = f``, ``A_p = t^2 T^p f^(p-1)``, and the sum of all from p = 3 on, ``t^2 T^3 f^2 / (1 - T f)``;
- ``M_p``: a von Mises-Fisher distribution around the perfect cone, of which only theta is looked at, with
  concentration ``k = 1 / v_p``: ``k / (2 sinh k) exp(-k sin sin') I0(k cos cos')``; theta_i is tilted by the scales;
- ``N_p``: a logistic distribution, cut off at half a turn, around the direction of the perfect path through the cross
  section; of the rest from p = 3 on, a uniform one.

References: d'Eon et al. 2011, An Energy-Conserving Hair Reflectance Model; d'Eon, Marschner and Hanika 2013, Importance
Sampling for Physically-Based Hair Fiber Models; Chiang et al. 2016, A Practical and Controllable Hair and Fur Model for
Production Path Tracing (the fits of variances to roughness).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial, pi, prod, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import fresnel, sqrt_with_bounded_slope
from torchtransient.plugins.bsdfs.ior import opaque, relative_index
from torchtransient.plugins.bsdfs.plastic import depolarizing
from torchtransient.plugins.parameter_effect import VALUE, declare_effects
from torchtransient.plugins.properties import number

# ----------------------------------------------------------------------------------------------------------------------
# The modified Bessel function of order zero, scaled so that it never overflows, in single precision with its slope.
#     I0(x) exp(-x),   of slope   (I1(x) - I0(x)) exp(-x)
#
# Both orders are nearly equal for large arguments, so that the difference is not taken of values but of the
# coefficients of their asymptotic series. That one is used beyond x = 10, where its last term is below rounding, and
# the power series before it.
#
# References: Abramowitz and Stegun, Handbook of Mathematical Functions, 9.6.10 and 9.7.1.

# Where one series takes over from the other.
BORDER = 10.0
_POWERS, _INVERSE_POWERS = 21, 12


def _power_coefficients(order: int) -> list[float]:
    """Return the coefficients of ``(x / 2)^order sum_k c_k (x^2 / 4)^k``."""
    return [1 / (factorial(k) * factorial(k + order)) for k in range(_POWERS)]


def _asymptotic_coefficients(order: int) -> list[float]:
    """Return the coefficients of ``exp(x) / sqrt(2 pi x) sum_k c_k / x^k``."""
    return [
        prod((2 * j - 1) ** 2 - 4 * order**2 for j in range(1, k + 1)) / (factorial(k) * 8**k)
        for k in range(_INVERSE_POWERS)
    ]


_SMALL_0, _SMALL_1 = (_power_coefficients(order) for order in (0, 1))
_LARGE_0 = _asymptotic_coefficients(0)
# The leading ones are equal.
_LARGE_DIFFERENCE = [one - zero for zero, one in zip(_LARGE_0, _asymptotic_coefficients(1), strict=True)][1:]


def _scaled_i0(x: Any) -> Any:
    """``I0(x) exp(-x)`` for x >= 0, to 1e-6 of its value, with a slope that is as good."""
    with dr.suspend_grad():
        is_large = x > BORDER
        small, large = dr.minimum(x, BORDER), dr.maximum(x, BORDER)
        quarter, inverse = 0.25 * small * small, dr.rcp(large)
        fading, root = dr.exp(-small), dr.sqrt(inverse * (0.5 / pi))
        near = _polynomial(_SMALL_0, quarter)
        value = dr.select(is_large, root * _polynomial(_LARGE_0, inverse), fading * near)
        slope_near = fading * (0.5 * small * _polynomial(_SMALL_1, quarter) - near)
        slope_far = root * inverse * _polynomial(_LARGE_DIFFERENCE, inverse)
        slope = dr.select(is_large, slope_far, slope_near)
    return dr.replace_grad(value, x * slope)


def _polynomial(coefficients: list[float], x: Any) -> Any:
    value = type(x)(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = dr.fma(value, x, coefficient)
    return value


# ----------------------------------------------------------------------------------------------------------------------

NUMBERS = ("longitudinal_roughness", "azimuthal_roughness", "scale_tilt", "eta", "eumelanin", "pheomelanin")
# Crossings that have a lobe of their own.
LOBES = 3
# How many tilts of the scales a lobe leans by (Marschner et al. 2003).
TILTS = (-2, 1, 4)
# Absorption of the pigments in linear RGB, per radius and unit of concentration (d'Eon et al. 2011, table 1).
PIGMENTS = {"eumelanin": (0.419, 0.697, 1.37), "pheomelanin": (0.187, 0.4, 1.05)}
# A fibre without roughness is not a density; this is the least, with the slope of what it is taken for.
LEAST_ROUGHNESS = 1e-3


@dataclass(frozen=True)
class Fibre:
    """Parameters of the lobes, for light from one direction. Lists have an entry for each lobe, the rest last."""

    sines: list[Any]
    """Of the tilted longitudinal angle that a lobe is reflected from."""
    cosines: list[Any]
    concentrations: list[Any]
    turns: list[Any]
    """Azimuthal angle by which the perfect path turns the light; not of the rest."""
    scale: Any
    """Of the logistic distribution around it."""
    shares: list[Any]
    """``A_p``, spectra."""


class DiffHair(mi.BSDF):
    """Scattering by a fibre, parameters as Mitsuba's ``hair``.

    ``longitudinal_roughness``, ``azimuthal_roughness`` (0.3; in [0, 1], below 1e-3 as 1e-3), ``scale_tilt`` (2
    degrees), ``int_ior`` ("amber"), ``ext_ior`` ("air") (number or material name), ``eumelanin`` (1.3) and
    ``pheomelanin`` (0.2) or, in their place, ``sigma_a`` (texture; per radius of the fibre) and ``scale`` (1), its
    factor. Differentiable: all of them but ``scale``, and ``eta`` (inside over outside index) for the two indices.
    Pigments need a variant with colours.

    Values are Mitsuba's up to its Bessel function, which is up to 0.6 % too small. ``sample`` draws a detached
    direction, its weight is value over density. Samples are Mitsuba's, but for those of three and more crossings,
    which it sends into the plane across the fibre.
    """

    # The same medium lies on both sides, although a lobe of transmission is not symmetric.
    has_equal_sides = True

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.longitudinal_roughness = _roughness(props, "longitudinal_roughness")
        self.azimuthal_roughness = _roughness(props, "azimuthal_roughness")
        self.scale_tilt = mi.Float(number(props, "scale_tilt", 2.0))
        self.eta = relative_index(props, "diff_hair", "amber")
        given = [name for name in PIGMENTS if name in props]
        self.eumelanin = mi.Float(number(props, "eumelanin", 1.3))
        self.pheomelanin = mi.Float(number(props, "pheomelanin", 0.2))
        self.sigma_a = props.get_unbounded_texture("sigma_a") if "sigma_a" in props else None
        self.scale = number(props, "scale", 1.0)
        if self.sigma_a is not None and given:
            raise SceneError(
                f"diff_hair: expected either 'sigma_a' or pigments, got 'sigma_a' and '{given[0]}'. Remove one of them."
            )
        self.pigments = _pigment_spectra() if self.sigma_a is None else {}
        self.m_components = [
            mi.BSDFFlags.Glossy | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.NonSymmetric | mi.BSDFFlags.FrontSide,
            mi.BSDFFlags.Null | mi.BSDFFlags.BackSide,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]
        self.parameters_changed()

    def traverse(self, cb: Any) -> None:
        for name in NUMBERS:
            cb.put(name, getattr(self, name), +mi.ParamFlags.Differentiable)
        if self.sigma_a is not None:
            cb.put("sigma_a", self.sigma_a, +mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        for name in NUMBERS:
            opaque(getattr(self, name))

    # ------------------------------------------------------------------------------------------------- the fibre

    def _absorption(self, si: Any, active: Any) -> Any:
        """Along one radius."""
        if self.sigma_a is not None:
            return self.sigma_a.eval(si, active) * self.scale
        return sum(getattr(self, name) * spectrum(si) for name, spectrum in self.pigments.items())

    def _shares(self, si: Any, active: Any, inside: Any, beyond: Any) -> list[Any]:
        """Attenuations ``A_p``. ``inside``: the index times the cosine of the refracted ray; ``beyond``: that of its
        projection on the plane along the fibre, squared.
        """
        # Where nothing enters, nothing is inside.
        length = 2 * self.eta * inside / dr.select(beyond > 0, beyond, 1)
        transmittance = dr.exp(-self._absorption(si, active) * length)
        interface = fresnel(dr.abs(si.wi.z), self.eta)
        f, t = interface.reflectance, interface.transmittance
        bounce = transmittance * f
        shares = [mi.UnpolarizedSpectrum(f), transmittance * (t * t)]
        shares += [shares[-1] * bounce]
        # 1 - T f, without the difference of numbers near one where little enters.
        lost = t + f * (1 - transmittance)
        often = t * (t / dr.select(lost > 0, lost, 1))
        return [*shares, often * transmittance * bounce * bounce]

    def _fibre(self, si: Any, active: Any) -> Fibre:
        x, y, z = si.wi.x, si.wi.y, si.wi.z
        cos_theta = sqrt_with_bounded_slope(x * x + z * z)
        excess = (self.eta - 1) * (self.eta + 1)
        # The index times the refracted cosines: within the cross section and along the fibre.
        squared = z * z + excess
        inside = dr.select(squared > 0, sqrt_with_bounded_slope(dr.select(squared > 0, squared, 1)), 0)
        beyond = excess + x * x + z * z
        offset, refracted = _angle(-x, z), _angle(-x, inside)

        tilt = self.scale_tilt * (pi / 180)
        sines, cosines = [], []
        for times in TILTS:
            sin_tilt, cos_tilt = dr.sincos(times * tilt)
            sines.append(y * cos_tilt + cos_theta * sin_tilt)
            cosines.append(dr.abs(cos_theta * cos_tilt - y * sin_tilt))
        v = _longitudinal_variance(self.longitudinal_roughness)
        return Fibre(
            sines=[*sines, y],
            cosines=[*cosines, cos_theta],
            concentrations=[dr.rcp(share * v) for share in (1, 0.25, 4, 4)],
            turns=[2 * p * refracted - 2 * offset + p * pi for p in range(LOBES)],
            scale=_azimuthal_scale(self.azimuthal_roughness),
            shares=self._shares(si, active, inside, beyond),
        )

    def _densities(self, fibre: Fibre, wi: Any, wo: Any) -> list[Any]:
        """Densities ``M_p N_p`` per solid angle."""
        sin_o, cos_o = wo.y, sqrt_with_bounded_slope(wo.x * wo.x + wo.z * wo.z)
        around_fibre = _angle(wo.z * wi.x - wo.x * wi.z, wo.x * wi.x + wo.z * wi.z)
        around = [_azimuthal(around_fibre - turn, fibre.scale) for turn in fibre.turns] + [mi.Float(0.5 / pi)]
        return [
            _longitudinal(sin_i, cos_i, sin_o, cos_o, concentration) * azimuthal
            for sin_i, cos_i, concentration, azimuthal in zip(
                fibre.sines, fibre.cosines, fibre.concentrations, around, strict=True
            )
        ]

    def _chances(self, fibre: Fibre, si: Any) -> list[Any]:
        """Detached probabilities of the lobes, by how bright they are."""
        shares = [dr.detach(share) for share in fibre.shares]
        bright = [_brightness(share, si) for share in shares]
        total = sum(bright)
        # Wavelengths that no eye sees.
        plain = [dr.mean(share) for share in shares]
        total_of_plain = sum(plain)
        rcp = dr.rcp(dr.select(total > 0, total, dr.select(total_of_plain > 0, total_of_plain, 1)))
        return [dr.select(total > 0, b, p) * rcp for b, p in zip(bright, plain, strict=True)]

    # ------------------------------------------------------------------------------------------------- as a BSDF

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.Glossy):
            return mi.Spectrum(0), mi.Float(0)
        fibre = self._fibre(si, active)
        return self._eval_pdf(fibre, self._chances(fibre, si), si, wo, active)

    def _eval_pdf(self, fibre: Fibre, chances: list[Any], si: Any, wo: Any, active: Any) -> Any:
        densities = self._densities(fibre, si.wi, wo)
        value = sum(share * density for share, density in zip(fibre.shares, densities, strict=True))
        pdf = sum(chance * dr.detach(density) for chance, density in zip(chances, densities, strict=True))
        return depolarizing(value) & mi.Mask(active), pdf & mi.Mask(active)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs = dr.zeros(mi.BSDFSample3f)
        if not ctx.is_enabled(mi.BSDFFlags.Glossy):
            return bs, mi.Spectrum(0)
        fibre = self._fibre(si, active)
        chances = self._chances(fibre, si)
        with dr.suspend_grad():
            bs.wo = _draw(fibre, chances, si.wi, sample1, sample2)
        value, pdf = self._eval_pdf(fibre, chances, si, bs.wo, active)
        bs.pdf = pdf
        bs.eta = mi.Float(1)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.Glossy)
        bs.sampled_component = mi.UInt32(0)
        return bs, value * dr.select(pdf > 0, dr.rcp(pdf), 0)

    def to_string(self) -> str:
        shown = ",\n".join(f"  {name} = {getattr(self, name)}" for name in (*NUMBERS, "sigma_a", "scale"))
        return f"DiffHair[\n{shown}\n]"


# -------------------------------------------------------------------------------------------------------- parameters


def _roughness(props: Any, name: str) -> Any:
    value = number(props, name, 0.3)
    if not 0 <= value <= 1:
        raise SceneError(f"diff_hair: '{name}' must be in [0, 1], got {value}.")
    return mi.Float(value)


def _pigment_spectra() -> dict[str, Any]:
    """Absorption by name of a pigment, as functions of the interaction."""
    if mi.is_monochromatic:
        raise SceneError(
            "diff_hair: pigments absorb by colour, and this variant has none. Give 'sigma_a', or take an rgb or a "
            "spectral variant."
        )
    if mi.is_spectral:
        # The smooth spectra that Mitsuba makes of the colours.
        models = {name: mi.srgb_model_fetch(mi.ScalarColor3f(colour)) for name, colour in PIGMENTS.items()}
        return {
            name: lambda si, model=model: mi.srgb_model_eval(dr.auto.ad.Array3f(model), si.wavelengths)
            for name, model in models.items()
        }
    return {name: lambda si, colour=colour: mi.Color3f(colour) for name, colour in PIGMENTS.items()}


def _at_least(roughness: Any) -> Any:
    return roughness + dr.maximum(LEAST_ROUGHNESS - dr.detach(roughness), 0)


def _longitudinal_variance(roughness: Any) -> Any:
    """Longitudinal variance of reflected light (p = 0); Chiang et al. 2016, equation 7."""
    r = _at_least(roughness)
    return dr.square(0.726 * r + 0.812 * r**2 + 3.7 * r**20)


def _azimuthal_scale(roughness: Any) -> Any:
    """Scale of the logistic distribution of azimuths; Chiang et al. 2016, equation 8."""
    r = _at_least(roughness)
    return sqrt(pi / 8) * (0.265 * r + 1.194 * r**2 + 5.372 * r**22)


# ------------------------------------------------------------------------------------------------------ distributions


def _longitudinal(sin_i: Any, cos_i: Any, sin_o: Any, cos_o: Any, concentration: Any) -> Any:
    """Longitudinal term ``M_p``, which integrates to one over the sine of the angle."""
    # 1 + sin sin' - cos cos', whose digits a concentration of thousands needs.
    deviation = 0.5 * (dr.square(sin_i + sin_o) + dr.square(cos_i - cos_o))
    peak = _scaled_i0(concentration * cos_i * cos_o) * dr.exp(-concentration * deviation)
    return peak * concentration / (1 - dr.exp(-2 * concentration))


def _azimuthal(angle: Any, scale: Any) -> Any:
    """Azimuthal term ``N_p`` at an angle from the perfect path, which integrates to one over a turn."""
    turn = 2 * pi
    angle = dr.abs(angle - turn * dr.round(angle / turn))
    fading = dr.exp(-angle / scale)
    return fading / (scale * dr.square(1 + fading) * dr.tanh(0.5 * pi / scale))


def _angle(y: Any, x: Any) -> Any:
    """Return ``atan2``, zero with a slope of zero where both are zero."""
    nowhere = (y == 0) & (x == 0)
    return dr.atan2(y, dr.select(nowhere, 1, x))


def _brightness(spectrum: Any, si: Any) -> Any:
    if mi.is_monochromatic:
        return spectrum[0]
    return mi.luminance(spectrum, si.wavelengths) if mi.is_spectral else mi.luminance(spectrum)


def _draw(fibre: Fibre, chances: list[Any], wi: Any, sample1: Any, sample2: Any) -> Any:
    """Sample a direction from the lobes; d'Eon, Marschner and Hanika 2013."""
    lobe = mi.UInt32(0)
    left, chance = mi.Float(sample1), chances[0]
    for after in range(LOBES):
        further = (lobe == after) & (left >= chances[after])
        lobe = dr.select(further, after + 1, lobe)
        left = dr.select(further, left - chances[after], left)
        chance = dr.select(further, chances[after + 1], chance)
    u = dr.clip(left / dr.select(chance > 0, chance, 1), 0, 1)

    def select_lobe(entries: list[Any]) -> Any:
        chosen = entries[-1]
        for p in range(LOBES):
            chosen = dr.select(lobe == p, entries[p], chosen)
        return chosen

    sin_i, cos_i, concentration = map(select_lobe, (fibre.sines, fibre.cosines, fibre.concentrations))
    # The polar angle of a von Mises-Fisher distribution, as one minus its cosine.
    fading = dr.exp(-2 * concentration)
    away = -dr.log(sample2.x + (1 - sample2.x) * fading) / concentration
    away = dr.clip(away, 0, 2)
    sine = dr.sqrt(away * (2 - away))
    sin_o = (away - 1) * sin_i + sine * dr.cos(2 * pi * sample2.y) * cos_i
    cos_o = dr.safe_sqrt(1 - sin_o * sin_o)

    cut = 0.5 * (1 - dr.tanh(0.5 * pi / fibre.scale))
    logistic = cut + u * (1 - 2 * cut)
    strayed = dr.clip(fibre.scale * dr.log(logistic / (1 - logistic)), -pi, pi)
    turn = dr.select(lobe == LOBES, 2 * pi * u, select_lobe([*fibre.turns, mi.Float(0)]) + strayed)
    sin_phi, cos_phi = dr.sincos(_angle(wi.z, wi.x) + turn)
    return dr.normalize(mi.Vector3f(cos_o * cos_phi, sin_o, cos_o * sin_phi))


register("bsdf", "diff_hair", DiffHair)
# Nothing is refracted onwards: the index changes how much is scattered where.
declare_effects(DiffHair, {"eta": VALUE})
