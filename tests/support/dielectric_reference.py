"""Textbook dielectric interfaces in double precision with torch's autograd: what the plugins are compared with.

Written from the equations without the rearrangements that single precision needs, and without Mitsuba. Directions
are rows ``(..., 3)`` in the shading frame, pointing away from the surface. ``eta`` is the inside index over the
outside one.

References: Born and Wolf, Principles of Optics, section 1.5; Walter et al. 2007, Microfacet Models for Refraction
through Rough Surfaces (the Smith masking of Beckmann is their rational fit, equation 27).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def fresnel_reflectance(cos_theta_i: Tensor, eta: Tensor) -> Tensor:
    """Unpolarised Fresnel reflectance, 1 in total internal reflection; negative cosines are inside."""
    outside = cos_theta_i >= 0
    m = torch.where(outside, eta, 1 / eta)
    c = cos_theta_i.abs()
    radicand = 1 - (1 - c * c) / (m * m)
    total = radicand <= 0
    cos_t = torch.sqrt(torch.where(total, torch.ones_like(radicand), radicand))
    r_s = (c - m * cos_t) / (c + m * cos_t)
    r_p = (m * c - cos_t) / (m * c + cos_t)
    return torch.where(total, torch.ones_like(c), 0.5 * (r_s * r_s + r_p * r_p))


def refracted_direction(wi: Tensor, eta: Tensor) -> Tensor:
    """Direction of the light refracted at the plane ``z = 0``; not meant for total internal reflection."""
    m = torch.where(wi[..., 2] >= 0, eta, 1 / eta)
    xy = -wi[..., :2] / m[..., None]
    z = torch.sqrt(1 - (xy * xy).sum(-1))
    return torch.cat([xy, (-torch.sign(wi[..., 2]) * z)[..., None]], -1)


def rough_dielectric(
    wi: Tensor, wo: Tensor, eta: Tensor, alpha_u: Tensor, alpha_v: Tensor, ggx: bool
) -> tuple[Tensor, Tensor]:
    """Value (times the cosine, transporting radiance) and density of ``wo`` under sampling of visible normals."""
    reflects = wi[..., 2] * wo[..., 2] > 0
    m_it = torch.where(wi[..., 2] > 0, eta, 1 / eta)
    h = wi + wo * torch.where(reflects, torch.ones_like(m_it), m_it)[..., None]
    length = h.norm(dim=-1)
    m = h / length[..., None]
    m = m * torch.sign(m[..., 2:3])
    wi_m, wo_m = (wi * m).sum(-1), (wo * m).sum(-1)
    valid = (wi_m * wi[..., 2] > 0) & (wo_m * wo[..., 2] > 0)

    D = _density(m, alpha_u, alpha_v, ggx)
    G_i, G_o = _masking(wi, alpha_u, alpha_v, ggx), _masking(wo, alpha_u, alpha_v, ggx)
    F = fresnel_reflectance(wi_m, eta)
    F = torch.where(reflects, F, 1 - F)
    jacobian = torch.where(reflects, 0.25 / wo_m.abs(), m_it**2 * wo_m.abs() / length**2)
    pdf = D * G_i * wi_m.abs() / wi[..., 2].abs() * jacobian * F
    value = pdf * G_o / torch.where(reflects, torch.ones_like(m_it), m_it**2)
    zero = torch.zeros_like(pdf)
    return torch.where(valid, value, zero), torch.where(valid, pdf, zero)


def _density(m: Tensor, alpha_u: Tensor, alpha_v: Tensor, ggx: bool) -> Tensor:
    slope2 = (m[..., 0] / alpha_u) ** 2 + (m[..., 1] / alpha_v) ** 2
    z2 = m[..., 2] ** 2
    if ggx:
        return 1 / (math.pi * alpha_u * alpha_v * (slope2 + z2) ** 2)
    return torch.exp(-slope2 / z2) / (math.pi * alpha_u * alpha_v * z2**2)


def _masking(v: Tensor, alpha_u: Tensor, alpha_v: Tensor, ggx: bool) -> Tensor:
    tan2 = ((alpha_u * v[..., 0]) ** 2 + (alpha_v * v[..., 1]) ** 2) / v[..., 2] ** 2
    if ggx:
        return 2 / (1 + torch.sqrt(1 + tan2))
    a = tan2.rsqrt()
    fit = (3.535 * a + 2.181 * a * a) / (1 + 2.276 * a + 2.577 * a * a)
    return torch.where(a < 1.6, fit, torch.ones_like(a))
