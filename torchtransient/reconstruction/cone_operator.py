"""Light-cone transforms as sums of convolutions, and their inverses by a Wiener filter."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import cast

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import count
from torchtransient.reconstruction.capture_checks import SNR, one_of, within
from torchtransient.reconstruction.confocal_operator import ConfocalOperator, InverseOperator, chunk_rows
from torchtransient.reconstruction.light_cone import ConeGrid, Resampling, offset_powers
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.planar_scan import PlanarScan

FALL = {"diffuse": 4, "retroreflective": 2}
DEFAULT_SNR = 10.0


class ConeOperator(ConfocalOperator):
    """What the light-cone transforms share: resampling in depth and time, and a sum of convolutions over components.

    ``moments``: for each component of the volume, the powers (y, x) of the offset from the hidden point to the wall
    that its kernel holds; ``scales``: the factors of the kernels.
    Classes say with :meth:`components` and :meth:`volume_of` what their volumes are made of.
    """

    moments: tuple[tuple[int, int], ...]
    scales: tuple[float, ...] = (1.0,)

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        dtype: torch.dtype,
        target: str,
        snr: float,
        v_bins: int | None,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        who = type(self).__name__
        self.target, self.snr = one_of(f"{who}: target", target, FALL), within(f"{who}: snr", snr, *SNR)
        self.v_bins = time_axis.num_bins if v_bins is None else count(f"{who}: v_bins", v_bins, 4)
        self.cone = ConeGrid.of(time_axis, self.wall, self.v_bins, who)
        self._set_tables()

    def fall(self) -> int:
        """The power of the distance with which light falls."""
        return FALL[self.target]

    def tables(self) -> dict[str, Tensor]:
        """Entries of the resampling matrices (places ``*_v``, ``*_t``; values ``volume``, ``data`` and inverses),
        and the tables of the kernels along y and x.
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
        """Tables (w, 2 Y, 1) and (w, 1, 2 X) of every component for frequencies ``first`` to ``last``."""
        found = []
        for (y, x), scale in zip(self.moments, self.scales, strict=True):
            along_y = torch.view_as_complex(cast(Tensor, getattr(self, f"along_y{y}"))[first:last])
            along_x = torch.view_as_complex(cast(Tensor, getattr(self, f"along_x{x}"))[first:last])
            found.append((along_y[:, :, None], along_x[:, None, :] * scale))
        return found

    @abstractmethod
    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        """The components (V, Y, X) of a volume, resampled by the matrix "volume" or "volume_inverse"."""

    @abstractmethod
    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        """The adjoint of :meth:`components`."""

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

    @property
    def inverse(self) -> ConeInverse:
        """The Wiener inverse: transients (..., T, Y, X) to volumes, a linear operator with an adjoint of its own."""
        return ConeInverse(self)

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The Wiener inverse of a transient (..., T, Y, X), or of a capture's (C, T, Y, X): as many volumes.

        Linear in the transient, and differentiable. Raises ShapeError, DeviceError.
        """
        volume: Tensor = self.inverse(self.transients(transient))
        return volume

    # --------------------------------------------------------------------------- resampling, (Z or T, ...) <-> (V, ...)

    def _resampled(self, x: Tensor, values: str, *, transposed: bool, to_v: bool) -> Tensor:
        """``x`` (n, Y, X) times the matrix ``values``, whose rows are bins of v, or its transpose."""
        v, t = (self.depth_v, self.depth_t) if values == "volume" else (self.by_v, self.by_t)
        matrix = Resampling(cast(Tensor, v), cast(Tensor, t), cast(Tensor, getattr(self, values)))
        out = matrix.apply(x.reshape(len(x), -1), self.v_bins if to_v else self.axis.num_bins, transposed=transposed)
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
            sum_ = None
            for spectrum, (y, x) in zip(spectra, self.kernels(first, last), strict=True):
                term = self._plane_fft(spectrum[first:last]).mul_(y).mul_(x)
                sum_ = term if sum_ is None else sum_.add_(term)
            assert sum_ is not None
            if regularised:
                sum_.div_(self._power(first, last))
            part.copy_(self._plane_ifft(sum_))
        return self._of_spectrum(out)

    def _correlated(self, x: Tensor, *, regularised: bool) -> list[Tensor]:
        """What :meth:`_convolved` is the adjoint of: components (V, Y, X) of (V, Y, X)."""
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
        power: Tensor | None = None
        for y, x in self.kernels(first, last):
            term = y.abs().square() * x.abs().square()
            power = term if power is None else power.add_(term)
        assert power is not None
        return power.add_(self.mean_power() / self.snr)

    def mean_power(self) -> float:
        """Mean of the kernels' power over all frequencies."""
        sums = [
            scale**2 * math.prod(
                float(offset_powers(n, pitch, power).square().sum())
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


class ConeInverse(InverseOperator):
    """The regularised inverse of a light-cone transform, from transients to volumes."""

    operator: ConeOperator

    def map_(self, x: Tensor) -> Tensor:
        return each(lambda data: self.operator._back(data, inverse=True), x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(lambda volume: self.operator._model(volume, inverse=True), y, len(self.data_shape))
