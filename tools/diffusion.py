"""Light in turbid slabs by the diffusion equation: what a path tracer must approach where scattering is strong.

Contini, Martelli and Zaccanti, "Photon migration through a turbid slab described by a model based on diffusion
approximation", Applied Optics 36 (1997); the length behind the boundary at which the fluence is taken to vanish after
Zhu, Pine and Weitz, Physical Review A 44 (1991). Times are optical path lengths: `opl = c t` in metres, which is the
index times the travelled length.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchtransient.errors import UnitError

Array = NDArray[np.float64]
IMAGES = 20


@lru_cache
def internal_reflection(index: float) -> float:
    """Share of diffuse light that the boundary of a medium of relative index `index` >= 1 sends back into it.

    The effective reflectance (3 C2 + 2 C1) / (3 C2 - 2 C1 + 2) of Zhu et al., with the unpolarized Fresnel reflectance
    from the inside.
    """
    if not index >= 1:
        raise UnitError(f"index: expected a relative index of at least 1, got {index!r}")
    nodes, weights = np.polynomial.legendre.leggauss(400)
    cos_i = 0.5 * (nodes + 1)
    sin_t2 = index**2 * (1 - cos_i**2)
    cos_t = np.sqrt(np.maximum(1 - sin_t2, 0))
    rs = (index * cos_i - cos_t) / (index * cos_i + cos_t)
    rp = (cos_i - index * cos_t) / (cos_i + index * cos_t)
    fresnel = np.where(sin_t2 < 1, 0.5 * (rs**2 + rp**2), 1.0)
    c1 = float(np.sum(0.5 * weights * fresnel * cos_i))
    c2 = float(np.sum(0.5 * weights * fresnel * cos_i**2))
    return (3 * c2 + 2 * c1) / (3 * c2 - 2 * c1 + 2)


def extrapolation_length(reduced_scattering: float, index: float) -> float:
    """Distance behind the boundary at which the fluence vanishes, metres; `reduced_scattering` in 1/m."""
    reflected = internal_reflection(index)
    return 2 / (3 * reduced_scattering) * (1 + reflected) / (1 - reflected)


def slab_transmittance(
    opl: ArrayLike,
    thickness: float,
    reduced_scattering: float,
    absorption: float,
    index: float = 1.0,
    *,
    rho: float | None = None,
    extrapolation: float | None = None,
) -> Array:
    """Time-resolved transmittance of a slab for a pencil beam, at optical path lengths `opl` (metres), shape of `opl`.

    `thickness` in metres, coefficients in 1/m. `rho`: lateral distance of the exit from the beam, then per square metre
    and metre of optical path; None integrates over the whole face, then per metre. `extrapolation` defaults to
    :func:`extrapolation_length`. Zero for `opl <= 0`.
    """
    for name, value in (("thickness", thickness), ("reduced_scattering", reduced_scattering)):
        if not value > 0:
            raise UnitError(f"{name}: expected a number greater than zero, got {value!r}")
    tau = np.asarray(opl, dtype=np.float64)
    path = np.where(tau > 0, tau, np.nan) / index
    z0 = 1 / reduced_scattering
    ze = extrapolation_length(reduced_scattering, index) if extrapolation is None else float(extrapolation)
    four_d = 4 / (3 * (absorption + reduced_scattering)) * path
    total = np.zeros_like(path)
    for m in range(-IMAGES, IMAGES + 1):
        z1 = thickness * (1 - 2 * m) - 4 * m * ze - z0
        z2 = thickness * (1 - 2 * m) - (4 * m - 2) * ze + z0
        total += z1 * np.exp(-(z1**2) / four_d) - z2 * np.exp(-(z2**2) / four_d)
    # Per metre of travelled length s: 1/2 (4 pi D)^(-1/2) s^(-3/2). The share at rho spreads as a Gaussian of variance
    # 2 D s along each axis.
    result = 0.5 / np.sqrt(np.pi * four_d) / path * total * np.exp(-absorption * path)
    if rho is not None:
        result = result * np.exp(-(rho**2) / four_d) / (np.pi * four_d)
    return np.nan_to_num(result / index, nan=0.0)
