"""Temporal filter of a film with a laser pulse and a sensor response: bin x filter x pulse x response.

The kernel of a bin is its box convolved with the temporal filter, the pulse and the impulse response. An arrival at
optical path length ``tau`` puts ``F(e_{b+1} - tau) - F(e_b - tau)`` into bin b with edges ``e``, where ``F`` is the
cumulative distribution of all spreading together: the weights sum to one and their slope is the density ``F'``.
"""

from __future__ import annotations

import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins.films.temporal_filter import GaussianFilter, TentFilter
from torchtransient.plugins.properties import number
from torchtransient.pulses import FWHM_PER_STDDEV, KINDS, Pulse, cumulative_of_sum

# Nodes of the table of F over the length of the kernel; it is linear in between.
NODES = 2048
MAX_NODES_PER_BIN = 1 << 14
# A kernel of more bins than this is better applied to the rendered transient.
MAX_BINS = 4096


class PulsedFilter:
    """The temporal filter ``base`` spread by ``pulses``, for bins of ``bin_width_opl`` metres. Has a slope.

    Raises SceneError when the kernel covers more than 4096 bins.
    """

    has_slope = True

    def __init__(self, base, pulses, bin_width_opl: float):
        self.name = base.name
        spread = list(pulses)
        if isinstance(base, TentFilter):
            spread.append(Pulse.rectangular(bin_width_opl))
        elif isinstance(base, GaussianFilter):
            spread.append(Pulse.gaussian(base.stddev * FWHM_PER_STDDEV * bin_width_opl))
        low, high = (sum(p.support_opl[side] for p in spread) / bin_width_opl for side in (0, 1))
        if high - low > MAX_BINS:
            raise SceneError(
                f"film: pulse and response together cover {high - low:.0f} bins of {bin_width_opl:g} m; at most "
                f"{MAX_BINS} are spread while rendering. Use wider bins, or render without them and apply the pulse "
                "afterwards (torchtransient.sensing.apply_pulse)."
            )
        per_bin = 2 ** math.ceil(math.log2(NODES / (high - low)))
        self.nodes_per_bin = int(min(max(per_bin, 8), MAX_NODES_PER_BIN))
        first, values = cumulative_of_sum(spread, bin_width_opl / self.nodes_per_bin)
        # The first bin that an arrival at the start of bin 0 can reach, and one edge more than any arrival needs.
        self.first = math.floor(first / self.nodes_per_bin)
        last = math.ceil((first + values.size - 1) / self.nodes_per_bin) + 1
        self.count = last - self.first
        self.reach = (float(self.first), float(self.first + self.count))
        table = np.interp(
            np.arange((self.first - 1) * self.nodes_per_bin, last * self.nodes_per_bin + 2),
            first + np.arange(values.size),
            values,
        )
        self._table = mi.Float(table.astype(np.float32))

    def begin(self, x):
        """(bin of the first tap, node and share at its lower edge) for an arrival ``x`` in bins (``Float64``)."""
        start = dr.floor(x)
        # The node of an edge is the same for all bins but for a multiple of the nodes per bin.
        u = mi.Float(1 - (x - start)) * self.nodes_per_bin
        node = dr.minimum(mi.UInt32(u), self.nodes_per_bin - 1)
        return start + self.first, node, u - mi.Float(node)

    def edge(self, node, share):
        """Cumulative distribution at an edge, and its slope per bin."""
        low, high = dr.gather(mi.Float, self._table, node), dr.gather(mi.Float, self._table, node + 1)
        return dr.fma(high - low, share, low), (high - low) * self.nodes_per_bin

    def weights(self, x):
        """As the plain filters do: first bin, and ``(offset, weight, d weight / dx)`` for every bin that is reached."""
        first, node, share = self.begin(x)
        taps, low = [], self.edge(node, share)
        for k in range(self.count):
            node = node + self.nodes_per_bin
            high = self.edge(node, share)
            taps.append((k, high[0] - low[0], low[1] - high[1]))
            low = high
        return first, taps


def pulse_of(props, prefix: str, plugin: str) -> Pulse | None:
    """The pulse that the properties ``<prefix>``, ``<prefix>_fwhm_opl`` ... of a film describe; None without them.

    ``<prefix>``: ``gaussian`` (``_fwhm_opl``), ``rectangular`` (``_width_opl``) or ``tabulated`` (``_opl`` and
    ``_values``: numbers separated by spaces or commas); ``_center_opl`` (0) for all. Metres. Raises SceneError.
    """
    if prefix not in props:
        return None
    kind = str(props[prefix])
    if kind not in KINDS:
        raise SceneError(f"{plugin}: {prefix} must be one of {', '.join(KINDS)}, got {kind!r}.")
    needed = {"gaussian": ("fwhm_opl",), "rectangular": ("width_opl",), "tabulated": ("opl", "values")}[kind]
    missing = [f"{prefix}_{name}" for name in needed if f"{prefix}_{name}" not in props]
    if missing:
        raise SceneError(f"{plugin}: {prefix}={kind!r} needs {' and '.join(missing)}.")
    center = number(props, f"{prefix}_center_opl", 0.0)
    try:
        if kind == "tabulated":
            opl, values = (numbers_of(props[f"{prefix}_{name}"], f"{prefix}_{name}", plugin) for name in needed)
            return Pulse.tabulated(opl, values, center)
        width = number(props, f"{prefix}_{needed[0]}")
        return Pulse.gaussian(width, center) if kind == "gaussian" else Pulse.rectangular(width, center)
    except TorchTransientError as error:
        raise SceneError(f"{plugin}: {prefix}: {error}") from error


def numbers_of(text, name: str, plugin: str) -> list[float]:
    """Numbers separated by spaces or commas; a single number is one. Raises SceneError."""
    try:
        return [float(part) for part in re.split(r"[,\s]+", str(text).strip()) if part]
    except ValueError:
        raise SceneError(f"{plugin}: {name} must be numbers separated by spaces or commas, got {text!r}.") from None
