"""Scattering by a fibre in double precision, written down as in Chiang et al. 2016: what ``diff_hair`` is held to."""

from __future__ import annotations

import numpy as np
from scipy.special import i0e


def fresnel(cosine, eta):
    root = np.sqrt(np.maximum(cosine**2 + eta**2 - 1, 0))
    s = (cosine - root) / (cosine + root)
    p = (eta**2 * cosine - root) / (eta**2 * cosine + root)
    return (s**2 + p**2) / 2


def longitudinal(theta_i, theta_o, variance, bessel=i0e):
    """``M_p``; ``bessel``: I0(x) exp(-x)."""
    k = 1 / variance
    angle = np.cos(theta_i + theta_o) - 1
    return k / (1 - np.exp(-2 * k)) * np.exp(k * angle) * bessel(k * np.cos(theta_i) * np.cos(theta_o))


def logistic(angle, scale):
    angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
    return np.exp(-angle / scale) / (scale * (1 + np.exp(-angle / scale)) ** 2 * np.tanh(np.pi / (2 * scale)))


def scattered(wi, wo, sigma, roughness=(0.3, 0.3), tilt=2.0, eta=1.55, bessel=i0e):
    """Value of the BSDF times the cosine, of unit vectors (3, N): entries (N,)."""
    wi, wo = (w / np.linalg.norm(w, axis=0) for w in (wi, wo))
    theta_i, theta_o = np.arcsin(wi[1]), np.arcsin(wo[1])
    phi_i, phi_o = np.arctan2(wi[2], wi[0]), np.arctan2(wo[2], wo[0])
    gamma_i = np.arctan2(-wi[0], wi[2])
    across = np.sqrt(eta**2 - wi[1] ** 2)
    gamma_t = np.arcsin(-wi[0] / across)
    transmittance = np.exp(-sigma * 2 * np.cos(gamma_t) / (across / eta))
    f = fresnel(np.abs(wi[2]), eta)
    shares = [f, (1 - f) ** 2 * transmittance, (1 - f) ** 2 * transmittance**2 * f]
    rest = shares[2] * f * transmittance / (1 - f * transmittance)
    r, s = roughness
    v = (0.726 * r + 0.812 * r**2 + 3.7 * r**20) ** 2
    scale = np.sqrt(np.pi / 8) * (0.265 * s + 1.194 * s**2 + 5.372 * s**22)
    value = rest * longitudinal(theta_i, theta_o, 4 * v, bessel) / (2 * np.pi)
    for p, (share, tilts, variance) in enumerate(zip(shares, (-2, 1, 4), (v, v / 4, 4 * v), strict=True)):
        tilted = theta_i + tilts * np.radians(tilt)
        # Past the end of the fibre, angles are folded back.
        tilted = np.arcsin(np.sin(tilted))
        turn = 2 * p * gamma_t - 2 * gamma_i + p * np.pi
        value += share * longitudinal(tilted, theta_o, variance, bessel) * logistic(phi_o - phi_i - turn, scale)
    return value
