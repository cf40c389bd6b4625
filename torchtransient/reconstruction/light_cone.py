"""The light cone in the coordinates v = r^2 and u = z^2, where it is one convolution (O'Toole, Lindell, Wetzstein,
"Confocal non-line-of-sight imaging based on the light-cone transform", Nature 555, 2018).

Light of hidden points of strength rho per m^3 arrives as H(tau) = int rho r^-p delta(tau - 2 r) dV, p = 4 of diffuse
and 2 of retroreflective points. With v = (tau / 2)^2,

    H dtau = r^-p dv int rho / (2 sqrt u) delta(v - u - x^2 - y^2) du dx dy .

The bins of time and depth are resampled to equal bins of v and u by overlaps of intervals, which lose no light. Per
frequency w of v, the kernel is exp(-i w x^2) exp(-i w y^2): a product of two small tables.

The directional transform (Young, Lindell, Girod, Taubman, Wetzstein, "Non-line-of-sight surface reconstruction using
the directional light-cone transform", CVPR 2020) finds albedo and normals. A hidden point of strength rho and normal n
sends light by the cosine towards the wall point,

    H(tau) = int nu . w r^-p delta(tau - 2 r) dV,    nu = rho n,    w = (x' - x, y' - y, -z) / r .

In v and u that is the sum of three convolutions of the components of nu, the third multiplied by z, with the cone
times (x' - x), (y' - y) and -1. The regularised inverse, 3 x 3 for each frequency, has a closed form, since three
kernels make one number: nu_i = conj(a_i) H / (sum |a|^2 + noise).
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis, fast_length
from torchtransient.capture import Capture, Scan
from torchtransient.checks import count, finite
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction.capture_checks import SNR, one_of, within
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.transient_operator import (
    InvertibleOperator,
    chunk_rows,
    reconstructed,
)
from torchtransient.reconstruction.voxels import PlanarScan

# Longest padded axis of v over the axis itself: what a cone reaches far behind the record costs memory and time.
LONGEST = 8


@dataclass(frozen=True)
class ConeGrid:
    """Equal bins of v between the ends of a time axis.

    ``edges`` (V + 1,) of v, m^2; ``radii`` (T + 1,) half the edges of the time axis, metres; ``padded``: length of the
    transforms along v, so that no cone comes round.
    """

    edges: Tensor
    radii: Tensor
    padded: int

    @staticmethod
    def of(axis: TimeAxis, grid: PlanarScan, v_bins: int, who: str) -> ConeGrid:
        """Make the bins of a time axis.

        Args:
            axis: time axis, from zero on.
            grid: points of the wall.
            v_bins: number of bins.
            who: begins the message.

        Raises:
            ShapeError: where the cone is far longer than the record.
        """
        radii = axis.edges_opl / 2
        near, far = float(radii[0]) ** 2, float(radii[-1]) ** 2
        edges = torch.linspace(near, far, v_bins + 1, dtype=torch.float64, device="cpu")
        length = float(edges[-1] - edges[0])
        reach = sum((n * pitch) ** 2 for n, pitch in zip(grid.size, grid.pitch, strict=True))
        needed = v_bins * (1 + reach / length)
        if needed > LONGEST * v_bins:
            raise ShapeError(
                f"{who}: expected a record that is not short beside the wall, got one of {length:.3g} m^2 in squared "
                f"distance with a scan whose diagonal squared is {reach:.3g} m^2. Let the time axis end later, or crop "
                "the scan."
            )
        return ConeGrid(edges, radii, fast_length(max(2 * v_bins, math.ceil(needed)), multiple=2))

    @property
    def width(self) -> float:
        """Width of a bin of v, m^2."""
        return float(self.edges[-1] - self.edges[0]) / (len(self.edges) - 1)

    def overlaps(self, of_depth: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return (index of v, index of time, overlap) of all bins that overlap.

        Args:
            of_depth: lengths of overlaps in r, metres, instead of v, m^2.
        """
        squares = self.radii**2
        # Both partitions together cut the axis into intervals, each of which lies in one bin of either.
        cuts = torch.cat([squares, self.edges[1:-1]]).sort().values
        middles = (cuts[1:] + cuts[:-1]) / 2
        v = (torch.bucketize(middles, self.edges, right=True) - 1).clamp(0, len(self.edges) - 2)
        t = (torch.bucketize(middles, squares, right=True) - 1).clamp(0, len(squares) - 2)
        size = (cuts.sqrt() if of_depth else cuts).diff()
        kept = size > 0
        return v[kept], t[kept], size[kept]

    def window(self) -> Tensor:
        """Return the factors (V' / 2 + 1,) of the frequencies of v, a mean of neighbours, (1, 4, 6, 4, 1) / 16.

        A cone that is band-limited alone rings as far as the record is long, and the r^-4 of early bins makes more of
        that than there is light.
        """
        turn = math.pi / (self.padded // 2) * torch.arange(self.padded // 2 + 1, dtype=torch.float64, device="cpu")
        return ((1 + turn.cos()) / 2) ** 2

    def kernel_tables(self, count: int, pitch: float, moment: int = 0, *, windowed: bool = False) -> Tensor:
        """Return the transform along one side of the wall of q^moment exp(-i w q^2) for every frequency w of v.

        Args:
            count: number of points along the side.
            pitch: distance between the points, metres.
            moment: power of the offset.
            windowed: multiply by :meth:`window`.

        Returns:
            (V' / 2 + 1, 2 count, 2), real and imaginary.
        """
        w = torch.arange(self.padded // 2 + 1, dtype=torch.float64, device="cpu")
        w = w * (2 * math.pi / (self.padded * self.width))
        turns = -w[:, None] * _offset_powers(count, pitch, 2)
        size = _offset_powers(count, pitch, moment) * (self.window()[:, None] if windowed else torch.ones_like(turns))
        return torch.view_as_real(torch.fft.fft(torch.polar(torch.ones_like(turns), turns) * size))


def _offset_powers(count: int, pitch: float, moment: int) -> Tensor:
    """Return powers (2 count,) of the offsets along one side of the wall, in the order of transforms.

    The farthest offset stands for both signs: its odd powers are zero.
    """
    q = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device="cpu") * pitch
    powers: Tensor = q**moment
    if moment % 2:
        powers[count] = 0
    return powers


FALL = {"diffuse": 4, "retroreflective": 2}
DEFAULT_SNR = 10.0


class ConeOperator(InvertibleOperator):
    """Base of light-cone transforms: resampling in depth and time, and a sum of convolutions over components.

    ``moments``: for each component of the volume, the powers (y, x) of the offset from the hidden point to the wall in
    its kernel; ``scales``: the factors of the kernels. Classes say with :meth:`components` and :meth:`volume_of` how
    volumes are made of components. For the arguments see :class:`LCT`.
    """

    depth_v: Tensor
    depth_t: Tensor
    by_v: Tensor
    by_t: Tensor
    moments: tuple[tuple[int, int], ...]
    scales: tuple[float, ...] = (1.0,)

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        snr: float = DEFAULT_SNR,
        v_bins: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        who = type(self).__name__
        self.target, self.snr = one_of(f"{who}: target", target, FALL), within(f"{who}: snr", snr, *SNR)
        self.v_bins = time_axis.num_bins if v_bins is None else count(f"{who}: v_bins", v_bins, 4)
        self.cone = ConeGrid.of(time_axis, self.wall, self.v_bins, who)
        self._set_tables()

    def fall(self) -> int:
        """Return the power of the distance with which light falls."""
        return FALL[self.target]

    def tables(self) -> dict[str, Tensor]:
        """Return entries of the resampling matrices (places ``*_v``, ``*_t``; values ``volume``, ``data`` and
        inverses), and the tables of the kernels along y and x.
        """
        cone, (rows, columns) = self.cone, self.grid.size
        area = self.grid.pitch[0] * self.grid.pitch[1]
        by_v, by_t, in_v = cone.overlaps(of_depth=False)
        depth_v, depth_t, in_z = cone.overlaps(of_depth=True)
        middle = (cone.radii[1:] + cone.radii[:-1]) / 2
        fall = middle ** -self.fall()
        shell = (cone.radii**2).diff()
        tables = {
            "by_v": by_v,
            "by_t": by_t,
            "depth_v": depth_v,
            "depth_t": depth_t,
            # rho per m^3 to means of rho / (2 sqrt u), and those to masses in bins of time
            "volume": in_z / cone.width,
            "data": in_v * fall[by_t] * area,
            # masses in bins of time to means over v, and means over u to means over depth
            "data_inverse": in_v / (cone.width * (fall * shell)[by_t] * area),
            "volume_inverse": in_v / cone.radii.diff()[by_t],
        }
        for power in sorted({y for y, _ in self.moments}):
            tables[f"along_y{power}"] = cone.kernel_tables(rows, self.grid.pitch[0], power, windowed=True)
        for power in sorted({x for _, x in self.moments}):
            tables[f"along_x{power}"] = cone.kernel_tables(columns, self.grid.pitch[1], power)
        return tables

    def kernels(self, first: int, last: int) -> list[tuple[Tensor, Tensor]]:
        """Return tables (w, 2 Y, 1) and (w, 1, 2 X) of every component for frequencies ``first`` to ``last``."""
        found = []
        for (y, x), scale in zip(self.moments, self.scales, strict=True):
            along_y = torch.view_as_complex(cast(Tensor, getattr(self, f"along_y{y}"))[first:last])
            along_x = torch.view_as_complex(cast(Tensor, getattr(self, f"along_x{x}"))[first:last])
            found.append((along_y[:, :, None], along_x[:, None, :] * scale))
        return found

    @abstractmethod
    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        """Return the components (V, Y, X) of a volume, resampled by the matrix "volume" or "volume_inverse"."""

    @abstractmethod
    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        """Return the volume of components, the adjoint of :meth:`components`."""

    def map_(self, x: Tensor) -> Tensor:
        return each(lambda volume: self._model(volume, inverse=False), x, len(self.volume_shape))

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(lambda data: self._back(data, inverse=False), y, 3)

    def _model(self, volume: Tensor, *, inverse: bool) -> Tensor:
        """The model of a volume, or the adjoint of the inverse."""
        volume_matrix, data_matrix = ("volume_inverse", "data_inverse") if inverse else ("volume", "data")
        v = self._convolved(self.components(volume, volume_matrix), regularised=inverse)
        return self._resampled(v, data_matrix, transposed=True, to_v=False)

    def _back(self, data: Tensor, *, inverse: bool) -> Tensor:
        """The adjoint of the model, or the inverse."""
        volume_matrix, data_matrix = ("volume_inverse", "data_inverse") if inverse else ("volume", "data")
        v = self._resampled(data, data_matrix, transposed=False, to_v=True)
        return self.volume_of(self._correlated(v, regularised=inverse), volume_matrix)

    def invert(self, data: Tensor) -> Tensor:
        return self._back(data, inverse=True)

    def invert_adjoint(self, volume: Tensor) -> Tensor:
        return self._model(volume, inverse=True)

    # --------------------------------------------------------------------------- resampling, (Z or T, ...) <-> (V, ...)

    def _resampled(self, x: Tensor, values: str, *, transposed: bool, to_v: bool) -> Tensor:
        """``x`` (n, Y, X) times the sparse matrix ``values``, whose rows are bins of v, or its transpose."""
        v, t = (self.depth_v, self.depth_t) if values == "volume" else (self.by_v, self.by_t)
        rows, columns = (t, v) if transposed else (v, t)
        entries, flat = getattr(self, values)[:, None], x.reshape(len(x), -1)
        out = x.new_zeros(self.v_bins if to_v else self.axis.num_bins, flat.shape[1])
        # In pieces, so that the products stay small.
        step = max(1, 4 * chunk_rows(len(rows), x.device))
        for first in range(0, flat.shape[1], step):
            part = flat[:, first : first + step]
            out[:, first : first + step].index_add_(0, rows, part.index_select(0, columns).mul_(entries))
        return out.reshape(len(out), *self.grid.size)

    # ---------------------------------------------------------------------------------------- convolutions in (V, Y, X)

    def _spectrum(self, x: Tensor) -> Tensor:
        """The transform along v of (V, Y, X), as (V' / 2 + 1, Y, X)."""
        rows, columns = self.grid.size
        flat: Tensor = torch.fft.rfft(x.reshape(len(x), -1).T.contiguous(), n=self.cone.padded)
        return flat.T.reshape(-1, rows, columns)

    def _of_spectrum(self, spectrum: Tensor) -> Tensor:
        """The (V, Y, X) of a transform along v; to be divided by nothing: its inverse."""
        flat: Tensor = torch.fft.irfft(spectrum.reshape(len(spectrum), -1).T, n=self.cone.padded)
        return flat[:, : self.v_bins].T.reshape(-1, *self.grid.size)

    def _convolved(self, components: list[Tensor], *, regularised: bool) -> Tensor:
        """The sum of the convolutions of components (V, Y, X); ``regularised``: over its power and noise."""
        spectra = [self._spectrum(x) for x in components]
        out = torch.empty_like(spectra[0])
        for part, first, last in self._frequencies(out):
            kernels = zip(spectra, self.kernels(first, last), strict=True)
            terms = (self._plane_fft(spectrum[first:last]).mul_(y).mul_(x) for spectrum, (y, x) in kernels)
            sum_ = functools.reduce(Tensor.add_, terms)
            if regularised:
                sum_.div_(self._power(first, last))
            part.copy_(self._plane_ifft(sum_))
        return self._of_spectrum(out)

    def _correlated(self, x: Tensor, *, regularised: bool) -> list[Tensor]:
        """Return components (V, Y, X) of (V, Y, X), the adjoint of :meth:`_convolved`."""
        spectrum = self._spectrum(x)
        out = [torch.empty_like(spectrum) for _ in self.moments]
        for part, first, last in self._frequencies(spectrum):
            of_plane = self._plane_fft(part)
            if regularised:
                of_plane.div_(self._power(first, last))
            kernels = self.kernels(first, last)
            for component, (along_y, along_x) in zip(out, kernels, strict=True):
                term = of_plane if len(kernels) == 1 else of_plane.clone()
                component[first:last] = self._plane_ifft(term.mul_(along_y.conj()).mul_(along_x.conj()))
        return [self._of_spectrum(component) for component in out]

    def _power(self, first: int, last: int) -> Tensor:
        """Power of the kernels and of noise: one over the signal-to-noise ratio times the kernels' mean power, so that
        the ratio has no unit and means the same for every size of wall and volume.
        """
        terms = (y.abs().square() * x.abs().square() for y, x in self.kernels(first, last))
        return functools.reduce(Tensor.add_, terms).add_(self.mean_power() / self.snr)

    def mean_power(self) -> float:
        """Mean of the kernels' power over all frequencies."""
        sums = [
            scale**2
            * math.prod(
                float(_offset_powers(n, pitch, power).square().sum())
                for n, pitch, power in zip(self.grid.size, self.grid.pitch, powers, strict=True)
            )
            for powers, scale in zip(self.moments, self.scales, strict=True)
        ]
        return sum(sums) * float(self.cone.window().square().mean())

    def _frequencies(self, spectrum: Tensor) -> list[tuple[Tensor, int, int]]:
        rows, columns = self.grid.size
        step = chunk_rows(4 * rows * columns, spectrum.device)
        starts = range(0, len(spectrum), step)
        return [(spectrum[i : i + step], i, min(i + step, len(spectrum))) for i in starts]

    def _plane_fft(self, x: Tensor) -> Tensor:
        over_x: Tensor = torch.fft.fft(x, n=2 * self.grid.size[1], dim=2)
        plane: Tensor = torch.fft.fft(over_x, n=2 * self.grid.size[0], dim=1)
        return plane

    def _plane_ifft(self, x: Tensor) -> Tensor:
        rows, columns = self.grid.size
        over_y: Tensor = torch.fft.ifft(x, dim=1)[:, :rows]
        plane: Tensor = torch.fft.ifft(over_y, dim=2)
        return plane[..., :columns]


class LCT(ConeOperator):
    """The light-cone transform, for confocal captures of a flat wall.

    ``operator(volume)``: strengths (..., Z, Y, X) of hidden points per m^3 to their light in each bin (..., T, Y, X);
    ``operator.adjoint``: its adjoint; ``operator.inverse``: the Wiener inverse, a linear operator itself;
    ``operator.reconstruct(transient)``: the inverse of a capture, in the units of the volume.

    Args:
        scan: confocal scan on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients, from zero on.
        target: kind of the hidden surface: "diffuse", light falls with the fourth power of the distance, or
            "retroreflective", with the second.
        snr: ratio of signal to noise power at the mean power of the kernel, without a unit; larger is sharper and
            noisier.
        v_bins: number of bins of squared distance, None for as many as bins of time. They are equal, and coarse in
            depth near the wall: v_max / (2 z v_bins).
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans, and for records that are far shorter than the wall is wide.
        UnitError: for time axes that begin before zero and for an ``snr`` beyond 1e-20 to 1e20.
        ArgumentError: for an unknown target.

    Results of the inverse go below zero; clamp them for display only. The kernel is band-limited: sharp volumes ring by
    some percent. Not supported: scans that are not confocal, curved walls, cosines of wall and hidden surfaces, hiding
    of points by others.
    """

    moments = ((0, 0),)

    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        return [self._resampled(volume, matrix, transposed=False, to_v=True)]

    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        return self._resampled(components[0], matrix, transposed=True, to_v=False)


def lct(capture: Capture, **options: Any) -> Tensor:
    """Invert a confocal capture: :meth:`LCT.reconstruct` by its own scan and axis.

    Args:
        capture: confocal capture of a flat wall.
        options: options of :class:`LCT`.

    Returns:
        Volume (C, Z, Y, X), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(capture, LCT, who="lct", **options)


DEFAULT_TAPER = 0.1


class DirectionalLCT(ConeOperator):
    """The light-cone transform of surfaces with normals, for confocal captures of a flat wall.

    ``operator(volume)``: vectors (..., 3, Z, Y, X), strength per m^3 times unit normal in world coordinates, to the
    light in each bin (..., T, Y, X), falling with the cosine at the surface and r^-4 or r^-2; ``operator.adjoint``,
    ``operator.inverse`` and ``operator.reconstruct`` as in :class:`LCT`, from transients to such vectors. Their lengths
    are the albedo, their directions the normals, towards the wall.

    Args:
        scan: confocal scan on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients, from zero on.
        target: "diffuse" or "retroreflective", see :class:`LCT`.
        snr: ratio of signal to noise power at the mean power of the kernel, see :class:`LCT`.
        v_bins: number of bins of squared distance, None for as many as bins of time, see :class:`LCT`.
        taper: share of each side of the scan over which the inverse fades light out towards the border, 0 (not at all)
            to 0.5. Light that ends at the border is otherwise explained by vectors that point across it: a bright rim,
            in measured captures as bright as the inside. ``forward`` and ``adjoint`` do not fade.
        dtype: float32 or float64.

    Raises:
        ShapeError, UnitError, ArgumentError: as :class:`LCT`.

    The three components are regularised alike at the middle of the volume's depth; where nothing is measured, normals
    are noise. Of all vectors that explain the light these are the shortest, which lean towards the wall: a plate tilted
    by 17 degrees comes out at 13, one by 34 at 21. Not supported: the same as in :class:`LCT`; the squared cosine of
    confocal light, for which the linear one stands.
    """

    moments = ((0, 1), (1, 0), (0, 0))
    frame: Tensor
    relative_depth: Tensor
    fading: Tensor

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        snr: float = DEFAULT_SNR,
        v_bins: int | None = None,
        taper: float = DEFAULT_TAPER,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.taper = finite("DirectionalLCT: taper", taper)
        if not 0 <= self.taper <= 0.5:
            raise UnitError(f"DirectionalLCT: expected taper as a share from 0 to 0.5, got {self.taper:g}.")
        super().__init__(scan, time_axis=time_axis, dtype=dtype, target=target, snr=snr, v_bins=v_bins)
        self.volume_shape = (3, *self.data_shape)
        self.scales = (1.0, 1.0, float(self.depths.mean()))

    def fall(self) -> int:
        """Return one power more than the light has: w holds 1 / r."""
        return FALL[self.target] + 1

    def tables(self) -> dict[str, Tensor]:
        """Return the tables of the base; ``frame`` (3, 3): world to wall coordinates; ``relative_depth`` (Z,): over the
        middle; ``fading`` (Y, X): of the light, towards the border.
        """
        frame = torch.stack([self.grid.along_x, self.grid.along_y, -self.grid.normal])
        along_y, along_x = (_fading(n, self.taper) for n in self.grid.size)
        return {
            **super().tables(), "frame": frame, "relative_depth": self.depths / self.depths.mean(),
            "fading": along_y[:, None] * along_x,
        }  # fmt: skip

    def _back(self, data: Tensor, *, inverse: bool) -> Tensor:
        return super()._back(data * self.fading if inverse else data, inverse=inverse)

    def _model(self, volume: Tensor, *, inverse: bool) -> Tensor:
        data = super()._model(volume, inverse=inverse)
        return data * self.fading if inverse else data

    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        x, y, towards = torch.einsum("ij,jzyx->izyx", self.frame, volume)
        parts = (x, y, towards * self._weight(matrix))
        return [self._resampled(part, matrix, transposed=False, to_v=True) for part in parts]

    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        x, y, towards = (self._resampled(part, matrix, transposed=True, to_v=False) for part in components)
        return torch.einsum("ij,izyx->jzyx", self.frame, torch.stack([x, y, towards * self._weight(matrix)]))

    def _weight(self, matrix: str) -> Tensor:
        weight = self.relative_depth[:, None, None]
        return weight if matrix == "volume" else 1 / weight


def _fading(points: int, share: float) -> Tensor:
    """(points,) float64: a squared sine, zero at the outer edges of the outermost cells, one from ``share`` on."""
    place = torch.arange(points, dtype=torch.float64, device="cpu") + 0.5
    place = torch.minimum(place, points - place)
    return torch.sin((place / max(share * points, 0.5)).clamp_max(1.0) * (math.pi / 2)) ** 2


def directional_lct(capture: Capture, **options: Any) -> Tensor:
    """Invert a confocal capture to vectors: :meth:`DirectionalLCT.reconstruct` by its own scan and axis.

    Args:
        capture: confocal capture of a flat wall.
        options: options of :class:`DirectionalLCT`.

    Returns:
        Vectors (C, 3, Z, Y, X), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(capture, DirectionalLCT, who="directional_lct", **options)
