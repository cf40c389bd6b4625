"""Radiance along a path: one value per colour, or Stokes vectors and Mueller matrices in polarized variants.

Every function looks at the active variant while a kernel is traced; in unpolarized variants they reduce to the plain
products, so that those kernels do not change.

Frames. A Stokes vector belongs to a segment of the path, and light runs against the ray. Mitsuba's BSDFs give their
matrices between the implicit frames of the two *local* directions. Here every segment has one fixed vector instead,
computed from the ray's own direction: both of its ends see the same bits, so that no rounding can turn the frame over
between them (Mitsuba's implicit frame jumps where a direction crosses the plane z = 0). Where directions are attached,
the frame is the projection of that vector across the direction: a function of the direction alone, so what the two ends
of a segment lose or gain by its turning cancels as it must.

All rotations come from sines and cosines of twice the angle by products, without the angle: they are cheap, and have
derivatives everywhere.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def light_type():
    """Type of the light of one event: a spectrum, or in polarized variants a Stokes vector of spectra."""
    return mi.SpectrumEntry if mi.is_polarized else mi.UnpolarizedSpectrum


def intensity(light):
    """Return the power of light as a spectrum, whatever its polarization.

    Args:
        light: spectrum, in polarized variants a Stokes vector of spectra (``mi.SpectrumEntry``).
    """
    return light[0] if mi.is_polarized else light


def attenuated(β, T):
    """Return a throughput times a spectrum that acts on all of its components alike.

    Args:
        β: throughput, in polarized variants a Mueller matrix.
        T: unpolarized spectrum.
    """
    if not mi.is_polarized:
        return β * T
    return mi.Spectrum(*[β[i, j] * T for i in range(4) for j in range(4)])


def product(a, b):
    """Return ``a b``: of two spectra, of two Mueller matrices, or of a Mueller matrix and a Stokes vector.

    Args:
        a: spectrum or Mueller matrix, on the sensor's side.
        b: spectrum, Mueller matrix or Stokes vector, on the light's side.
    """
    if not mi.is_polarized:
        return a * b
    if isinstance(b, mi.Spectrum):
        return a @ b
    return mi.SpectrumEntry(*[sum(a[i, k] * b[k] for k in range(1, 4)) + a[i, 0] * b[0] for i in range(4)])


def first_column(matrix):
    """Return the Stokes vector that a throughput makes of unpolarized light of unit power.

    Mitsuba emits no other light.

    Args:
        matrix: throughput, in polarized variants a Mueller matrix.
    """
    if not mi.is_polarized:
        return matrix
    return mi.SpectrumEntry(*[matrix[i, 0] for i in range(4)])


def rotation_tangent(t_rotation):
    """Return the tangent of a throughput of one whose frame turns, in polarized variants.

    Args:
        t_rotation: tangent of twice the angle, radians, see :meth:`FrameRotation.angle`.
    """
    zero, t = mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(t_rotation)
    return mi.Spectrum(*[zero] * 6, t, *[zero] * 2, -t, *[zero] * 6)


# --------------------------------------------------------------------------------------------------------- frames


class FrameRotation:
    """Rotation of a Stokes frame by its cosine and sine of twice the angle, counter-clockwise for the receiver."""

    def __init__(self, c, s):
        self.c, self.s = c, s

    def angle(self):
        """Return zero with the derivative of twice the angle."""
        return dr.detach(self.c) * self.s - dr.detach(self.s) * self.c


def rotation_between(forward, current, target):
    """Return the rotation from the frame with x along one vector to that along another one.

    No rotation where ``target`` is parallel to the direction.

    Args:
        forward: direction in which light travels.
        current: vector across it, of any length.
        target: vector, projected across it.
    """
    return rotation_along(dr.dot(current, target), dr.dot(forward, dr.cross(current, target)))


def rotation_along(c, s):
    """Return the rotation of a frame by the angle of a point in the plane, none at the origin.

    Args:
        c, s: coordinates of the point, at any distance from the origin.
    """
    n = c * c + s * s
    there = n > 0
    scale = dr.rcp(dr.select(there, n, 1))
    return FrameRotation(dr.select(there, (c - s) * (c + s) * scale, 1), dr.select(there, 2 * c * s * scale, 0))


def stokes_frame_of(d):
    """Return the x axis of the Stokes frame of a segment, a detached unit vector.

    Args:
        d: direction of the segment's ray, away from the sensor, unit Vector3f in the world.
    """
    return mi.coordinate_system(-dr.detach(d))[0]


def rotation_to_sensor(si, d):
    """Return the rotation from the BSDF's implicit frame to the segment's, on the sensor's side of a vertex.

    Args:
        si: SurfaceInteraction3f of the vertex.
        d: direction of the ray that found it, unit Vector3f in the world; attached where ``si.wi`` is attached to it.

    Returns:
        :class:`FrameRotation`, None in unpolarized variants.
    """
    if not mi.is_polarized:
        return None
    return rotation_between(-d, si.to_world(mi.coordinate_system(si.wi)[0]), stokes_frame_of(d))


def rotation_from_light(si, wo, out=None, d=None):
    """Return the rotation from the BSDF's implicit frame to the segment's, on the side of the light.

    Args:
        si: SurfaceInteraction3f of the vertex.
        wo: direction in which the path goes on, unit Vector3f in the local frame of ``si``.
        out: direction of ``wo`` in the world, attached where ``wo`` is; None computes it as that of the next ray.
        d: direction of the next ray to the bit; None takes ``out``.

    Returns:
        :class:`FrameRotation`, None in unpolarized variants.
    """
    if not mi.is_polarized:
        return None
    out = si.to_world(wo) if out is None else out
    return rotation_between(-out, si.to_world(mi.coordinate_system(-wo)[0]), stokes_frame_of(out if d is None else d))


def rotate_stokes(light, rotation):
    """Return a Stokes vector in the rotated frame.

    Args:
        light: Stokes vector of spectra; a spectrum in unpolarized variants, which is returned as it is.
        rotation: :class:`FrameRotation`, None in unpolarized variants.
    """
    if not mi.is_polarized:
        return light
    c, s = rotation.c, rotation.s
    return mi.SpectrumEntry(light[0], light[1] * c + light[2] * s, light[2] * c - light[1] * s, light[3])


def scatter_unpolarized(value, rotation):
    """Return the Stokes vector of unpolarized light of unit power after a BSDF, in the frame of the sensor's segment.

    Args:
        value: BSDF times cosine, in polarized variants a Mueller matrix between implicit frames.
        rotation: rotation from :func:`rotation_to_sensor`.
    """
    if not mi.is_polarized:
        return mi.unpolarized_spectrum(value)
    return rotate_stokes(first_column(value), rotation)


def rotate_mueller(value, out, into):
    """Return a BSDF's value between the frames of the segments.

    Args:
        value: Mueller matrix between the implicit frames of its directions.
        out, into: rotations to the frame of the segment towards the sensor, and from that towards the light.
    """
    if not mi.is_polarized:
        return mi.unpolarized_spectrum(value)
    m = [[value[i, j] for j in range(4)] for i in range(4)]
    for row in m:
        row[1], row[2] = row[1] * into.c + row[2] * into.s, row[2] * into.c - row[1] * into.s
    m[1], m[2] = (
        [a * out.c + b * out.s for a, b in zip(m[1], m[2], strict=True)],
        [b * out.c - a * out.s for a, b in zip(m[1], m[2], strict=True)],
    )
    return mi.Spectrum(*[entry for row in m for entry in row])


def from_mirrored_frames(value, wi, wo, mirrored):
    """Return a BSDF's value between the frames of its directions, from that between mirrored ones.

    Reflected, a frame changes its hand: S2 and S3 change their signs on both sides.

    Args:
        value: Mueller matrix.
        wi, wo: local directions.
        mirrored: mask of lanes with the value between the frames of their mirror images at the surface.
    """
    m = [[value[i, j] if (i < 2) == (j < 2) else -value[i, j] for j in range(4)] for i in range(4)]
    out = rotation_between(wi, _mirror(mi.coordinate_system(_mirror(wi))[0]), mi.coordinate_system(wi)[0])
    into = rotation_between(-wo, _mirror(mi.coordinate_system(_mirror(-wo))[0]), mi.coordinate_system(-wo)[0])
    right_way = rotate_mueller(mi.Spectrum(*[entry for row in m for entry in row]), out, into)
    return dr.select(mirrored, right_way, value)


def _mirror(v):
    return mi.Vector3f(v.x, v.y, -v.z)
