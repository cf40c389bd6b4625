"""Polarization cameras: analysers in front of pixels, the mosaic of a sensor chip, and Stokes vectors back from both.

An analyser is the first row of the Mueller matrix of what stands before the pixel, a row ``(r0, r1, r2, r3)`` of
weights of the Stokes components. A linear one at angle a with extinction e (power across over power along) and
transmission t weighs with ``t/2 (1 + e, (1 - e) cos 2a, (1 - e) sin 2a, 0)``. Stokes tensors are (..., 4, C, T, H, W)
in the frame of `torchtransient.stokes`: angles counter-clockwise from the picture's horizontal for the receiver. A
steady image takes T = 1.

Sources: Goldstein, "Polarized Light" (2011); Tyo et al., "Review of passive imaging polarimetry for remote sensing
applications" (Appl. Opt. 2006); Gao & Gruev, "Bilinear and bicubic interpolation methods for division of focal plane
polarimeters" (Opt. Express 2011).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from torchtransient.checks import Numbers
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single, product, without_autocast
from torchtransient.sensing.checks import check_count, check_number, check_tensor, reals, refuse_cut_off
from torchtransient.sensing.sensor import Sensor
from torchtransient.stokes import TRANSIENT_DIM, circular_polarizer, linear_polarizer

# Angles in degrees of the 2 x 2 pixels of Sony's IMX250MZR, first row on top (Sony's data sheet, "Polarsens").
POLARSENS_DEG = ((90.0, 45.0), (135.0, 0.0))

# Light behind crossed polarizers is a difference of equal numbers: what it may be below zero, relative to S0.
_ROUNDING = 1e-5


def linear_analyzers(angles_deg: Numbers, extinction_ratio: float = math.inf, transmission: float = 1.0) -> Tensor:
    """Rows of linear analysers.

    Args:
        angles_deg: angles in degrees, (A,).
        extinction_ratio: power along over power across, at least 1; 100 to 400 in sensor chips, infinite when ideal.
        transmission: transmission of light polarized along the analyser, in [0, 1].

    Returns:
        (A, 4) float64.

    Raises:
        UnitError: for numbers out of range.
    """
    me = "linear_analyzers"
    share = _extinction(extinction_ratio, me)
    factor = check_number(transmission, "transmission", me, high=1.0)
    angles = [math.radians(check_number(a, "angles_deg", me, low=-360.0, high=360.0)) for a in angles_deg]
    return factor * linear_polarizer(torch.tensor(angles, dtype=torch.float64), share)[:, 0]


def circular_analyzers(extinction_ratio: float = math.inf, transmission: float = 1.0) -> Tensor:
    """Rows of the analysers of right and of left circular light.

    Args:
        extinction_ratio: power of the one over power of the other, at least 1.
        transmission: transmission of light of the analyser's own handedness, in [0, 1].

    Returns:
        (2, 4) float64.

    Raises:
        UnitError: for numbers out of range.
    """
    share = _extinction(extinction_ratio, "circular_analyzers")
    factor = check_number(transmission, "transmission", "circular_analyzers", high=1.0)
    right, left = (circular_polarizer(hand)[0].double() for hand in (False, True))
    return factor * torch.stack([right + share * left, left + share * right])


@in_single
@without_autocast
def analyze(stokes: Tensor, rows: Tensor) -> Tensor:
    """Light behind every analyser.

    Args:
        stokes: Stokes vectors (..., 4, C, T, H, W).
        rows: analysers (A, 4).

    Returns:
        (..., A, C, T, H, W).

    Raises:
        ShapeError: for other shapes.
    """
    _check_stokes(stokes, "analyze")
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise ShapeError(f"analyze: expected rows (A, 4), got {tuple(rows.shape)}.")
    return _by_rows(rows.to(stokes), stokes)


@in_single
@without_autocast
def stokes_from(measurements: Tensor, rows: Tensor) -> Tensor:
    """Least-squares Stokes vectors of measurements behind analysers.

    Components that the analysers cannot see (S3 behind linear ones) are zero. For 0, 45, 90, 135 degrees it is ``S0 =
    sum / 2, S1 = I0 - I90, S2 = I45 - I135``. Not constrained: noise can make S0 < |S123|, see `project_physical`.

    Args:
        measurements: (..., A, C, T, H, W).
        rows: analysers (A, 4).

    Returns:
        (..., 4, C, T, H, W).
    """
    (measurements,) = reals("stokes_from", measurements=measurements)
    inverse = torch.linalg.pinv(rows.double(), rtol=1e-9)
    return _by_rows(inverse.to(measurements), measurements)


def _by_rows(matrix: Tensor, x: Tensor) -> Tensor:
    """(..., M, C, T, H, W): a matrix (M, K) times the components of (..., K, C, T, H, W)."""
    mixed = product(matrix, x.flatten(TRANSIENT_DIM + 1))
    return mixed.reshape(*mixed.shape[:-1], *x.shape[TRANSIENT_DIM + 1 :])


# ------------------------------------------------------------------------------------------------------ physicality


@in_single
def unphysical_part(stokes: Tensor, dim: int = TRANSIENT_DIM) -> Tensor:
    """Excess of polarized over all light, ``max(|S123| - S0, 0)``: zero for every Stokes vector that light can have.

    Args:
        stokes: Stokes vectors, four components along ``dim``.
        dim: dimension of the components.

    Returns:
        The shape without ``dim``.

    Raises:
        ShapeError: for another number of components.
    """
    s0, length = _parts(stokes, dim)
    return (length - s0).clamp_min(0)


@in_single
def project_physical(stokes: Tensor, dim: int = TRANSIENT_DIM) -> Tensor:
    """Nearest Stokes vectors that light can have (S0 >= |S123|).

    Euclidean projection onto the cone: with excess ``|S123| > S0`` both become ``(S0 + |S123|) / 2``, and zero where
    that is negative. Continuous, with gradients that are finite everywhere (zero in dark).

    Args:
        stokes: Stokes vectors, four components along ``dim``.
        dim: dimension of the components.

    Returns:
        Shape of ``stokes``.

    Raises:
        ShapeError: for another number of components.
    """
    s0, length = _parts(stokes, dim)
    inside = length <= s0
    nearest = ((s0 + length) / 2).clamp_min(0)
    scale = torch.where(inside, 1.0, nearest / torch.where(length > 0, length, 1.0))
    first = torch.where(inside, s0, nearest)
    rest = stokes.narrow(dim, 1, 3) * scale.unsqueeze(dim)
    return torch.cat([first.unsqueeze(dim), rest], dim)


def _parts(stokes: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """S0 and |S123|, the latter with derivative zero where it is zero."""
    if stokes.size(dim) != 4:
        raise ShapeError(f"stokes: expected four components along dim={dim}, got shape {tuple(stokes.shape)}.")
    part = stokes.narrow(dim, 1, 3)
    largest = part.detach().abs().amax(dim, keepdim=True)
    there = largest > torch.finfo(stokes.dtype).tiny
    scale = torch.where(there, largest, 1.0)
    square = (torch.where(there, part, 1.0) / scale).square().sum(dim, keepdim=True)
    length = torch.where(there, square.sqrt() * scale, 0.0)
    return stokes.select(dim, 0), length.squeeze(dim)


# ---------------------------------------------------------------------------------------------------------- mosaics


class PolarizationMosaic(Sensor):
    """Sensor chip with one analyser per pixel: Stokes (..., 4, C, T, H, W) to raw light (..., C, T, H, W).

    A gather: every pixel sees its own analyser, nothing is interpolated. Differentiable. Values that rounding leaves
    below zero (within 1e-5 of S0) become zero; light that no Stokes vector can have stays as it is, for the photon
    counting behind to refuse: see `project_physical`. Crosstalk between pixels is a spatial spread behind this stage.

    Args:
        rows: (P, Q, 4), the analysers of a block of P x Q pixels that repeats from the top left pixel; `polarsens` and
            `mosaic_rows` make them.

    Raises:
        ShapeError: for other shapes.
    """

    rows: Tensor

    def __init__(self, rows: Tensor) -> None:
        super().__init__()
        if rows.ndim != 3 or rows.shape[-1] != 4:
            raise ShapeError(f"PolarizationMosaic: expected rows (P, Q, 4), got {tuple(rows.shape)}.")
        self.register_buffer("rows", rows.detach().double())

    @classmethod
    def polarsens(cls, extinction_ratio: float = 300.0, transmission: float = 1.0) -> PolarizationMosaic:
        """Make the arrangement of Sony's IMX250MZR: 90, 45 over 135, 0 degrees.

        Args:
            extinction_ratio: power along over power across, at least 1, see `linear_analyzers`.
            transmission: transmission of light polarized along the analyser, in [0, 1].
        """
        return cls(mosaic_rows(POLARSENS_DEG, extinction_ratio, transmission))

    def weights(self, height: int, width: int) -> Tensor:
        """Analyser of every pixel, (4, H, W).

        Args:
            height: height of the image in pixels.
            width: width of the image in pixels.
        """
        p, q = self.rows.shape[:2]
        tiles = self.rows.repeat(-(-height // p), -(-width // q), 1)
        return tiles[:height, :width].movedim(-1, 0)

    def expected(self, x: Tensor) -> Tensor:
        _check_stokes(x, "PolarizationMosaic")
        # No product of matrices, which autocast would round.
        raw = (self.weights(*x.shape[-2:]).to(x)[:, None, None] * x).sum(TRANSIENT_DIM)
        return _without_rounding(raw, x.select(TRANSIENT_DIM, 0))

    def demosaic(self, raw: Tensor) -> Tensor:
        """Light behind each analyser everywhere, interpolated; see `demosaic`.

        Args:
            raw: (..., C, T, H, W).

        Returns:
            (..., P Q, C, T, H, W).
        """
        return demosaic(raw, (int(self.rows.shape[0]), int(self.rows.shape[1])))

    def stokes(self, raw: Tensor) -> Tensor:
        """Stokes vectors of raw light, by `demosaic` and least squares.

        Args:
            raw: (..., C, T, H, W).

        Returns:
            (..., 4, C, T, H, W).
        """
        return stokes_from(self.demosaic(raw), self.rows.flatten(0, 1))


def mosaic_rows(
    angles_deg: Sequence[Sequence[float]], extinction_ratio: float = math.inf, transmission: float = 1.0
) -> Tensor:
    """Rows of linear analysers of a block of pixels.

    Args:
        angles_deg: (P, Q) angles in degrees.
        extinction_ratio: power along over power across, at least 1, see `linear_analyzers`.
        transmission: transmission of light polarized along the analyser, in [0, 1].

    Returns:
        (P, Q, 4) float64.

    Raises:
        UnitError: for numbers out of range.
    """
    return torch.stack([linear_analyzers(line, extinction_ratio, transmission) for line in angles_deg])


@in_single
@without_autocast
def demosaic(raw: Tensor, block: tuple[int, int] = (2, 2)) -> Tensor:
    """Interpolate the pixels of each kind in a mosaic over all others.

    Linear interpolation between the pixels of one kind, P and Q apart; at the rim, of those there are, weighted the
    same. A constant picture stays constant, and the pixels themselves keep their values for 2 x 2. Linear in the light.

    Args:
        raw: (..., C, T, H, W).
        block: sizes P and Q of a block.

    Returns:
        (..., P Q, C, T, H, W), row by row within the block.

    Raises:
        ShapeError: for less than one block.
    """
    (raw,) = reals("demosaic", raw=raw)
    p, q = (check_count(size, "block", "demosaic") for size in block)
    if raw.ndim < 4 or raw.shape[-2] < p or raw.shape[-1] < q:
        raise ShapeError(f"demosaic: expected raw light (..., C, T, H >= {p}, W >= {q}), got {tuple(raw.shape)}.")
    h, w = raw.shape[-2:]
    kernel = torch.outer(_tent(p), _tent(q)).to(raw)[None, None]
    padding = (p - 1, q - 1)
    images = []
    for i in range(p):
        for j in range(q):
            mask = torch.zeros(h, w, dtype=raw.dtype, device=raw.device)
            mask[i::p, j::q] = 1
            spread = functional.conv2d((raw * mask).reshape(-1, 1, h, w), kernel, padding=padding).reshape(raw.shape)
            there = functional.conv2d(mask[None, None], kernel, padding=padding)[0, 0]
            images.append(spread / there)
    return torch.stack(images, dim=TRANSIENT_DIM)


def _tent(period: int) -> Tensor:
    return 1 - torch.arange(1 - period, period, dtype=torch.float64).abs() / period


class Analyzers(Sensor):
    """Pictures one after another behind analysers: (..., 4, C, T, H, W) to (..., A, C, T, H, W).

    A rotating polarizer, or a set of filters. As in `PolarizationMosaic`, rounding below zero becomes zero.

    Args:
        rows: analysers (A, 4).
    """

    rows: Tensor

    def __init__(self, rows: Tensor) -> None:
        super().__init__()
        self.register_buffer("rows", rows.detach().double())

    def expected(self, x: Tensor) -> Tensor:
        return _without_rounding(analyze(x, self.rows), x.select(TRANSIENT_DIM, 0).unsqueeze(TRANSIENT_DIM))

    def stokes(self, measurements: Tensor) -> Tensor:
        """Least-squares Stokes vectors of the pictures.

        Args:
            measurements: (..., A, C, T, H, W).

        Returns:
            (..., 4, C, T, H, W).
        """
        return stokes_from(measurements, self.rows)


def _without_rounding(light: Tensor, s0: Tensor) -> Tensor:
    """Light behind analysers; what rounding has left below zero is zero, with its own slope."""
    return light - torch.where((light < 0) & (light >= -_ROUNDING * s0), light.detach(), 0.0)


def _extinction(extinction_ratio: float, where: str) -> float:
    refuse_cut_off(extinction_ratio, "extinction_ratio", where)
    if not extinction_ratio >= 1:
        raise UnitError(
            f"{where}: expected extinction_ratio >= 1 (power along over power across), got {extinction_ratio!r}."
        )
    return 1 / float(extinction_ratio)


def _check_stokes(stokes: Tensor, where: str) -> None:
    if check_tensor(stokes, where).ndim < 5 or stokes.shape[TRANSIENT_DIM] != 4 or not stokes.dtype.is_floating_point:
        raise ShapeError(
            f"{where}: expected Stokes vectors (..., 4, C, T, H, W), got {stokes.dtype} {tuple(stokes.shape)}. Give "
            "a steady image a T of one: stokes.unsqueeze(-3)."
        )
