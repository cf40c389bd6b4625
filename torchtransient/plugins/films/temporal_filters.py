"""Temporal filters: weights of the bins of the time axis for one arrival.

A filter gives the weight ``k(x)`` of a bin by the distance ``x`` between arrival and the bin's centre, in bins. All
filters here are the bin's box convolved with a kernel of mass one, so they sum to one over the bins at every arrival
time and the sum of a transient over its bins stays the steady image:

======== ============================================================= =================== ===================
name     kernel                                                        slope               bins written
======== ============================================================= =================== ===================
box      none: the exact histogram, half-open bins ``[k, k + 1)``      none                1
tent     box of one bin: linear splat between the two nearest centres  piecewise constant  2
gaussian Gaussian of ``stddev`` bins s, cut at 4 s and rescaled        continuous but for  2 ceil(4 s) + 1
                                                                       3e-4 of its height
                                                                       at the cut
======== ============================================================= =================== ===================

With a laser pulse and an impulse response of the sensor the kernel is bin x filter x pulse x response
(:class:`PulsedFilter`): an arrival at optical path length ``tau`` puts ``F(e_{b+1} - tau) - F(e_b - tau)`` into bin b
with edges ``e``, where ``F`` is the cumulative distribution of all spreading together. The weights sum to one, and
their slope is the density ``F'``. Kernels of many bins are looped over (:func:`put_long`, :func:`read_long`).
"""

from __future__ import annotations

import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins.properties import number
from torchtransient.pulses import FWHM_PER_STDDEV, KINDS, Pulse, cumulative_of_sum

NAMES = ("box", "tent", "gaussian")
CUT_STDDEVS = 4.0


def check_stddev(stddev: float):
    """Check the width of a Gaussian filter.

    Args:
        stddev: standard deviation, bins.

    Raises:
        SceneError: unless it is positive and finite.
    """
    if not (math.isfinite(stddev) and stddev > 0):
        raise SceneError(f"gaussian_stddev: expected a positive number of bins, got {stddev!r}.")


def check_name(name: str):
    """Check the name of a temporal filter.

    Args:
        name: name, one of :data:`NAMES`.

    Raises:
        SceneError: for another one.
    """
    if name not in NAMES:
        raise SceneError(f"temporal_filter: expected one of {', '.join(NAMES)}, got {name!r}.")


class BoxFilter:
    """Exact histogram. It has no usable slope in time, hence no gradient through the time of flight."""

    name = "box"
    has_slope = False
    # Bins before and after an arrival that it can reach.
    reach = (0.0, 0.0)

    def weights(self, x):
        """Return the weights of one arrival.

        Args:
            x: the arrival in bins (0 is the start of bin 0), Float64.

        Returns:
            (bin, Float64, which may lie outside of the axis; list of (offset from that bin, weight, d weight / dx)).
        """
        return dr.floor(x), [(0, mi.Float(1), mi.Float(0))]


class TentFilter:
    """Linear splat between the two nearest bin centres."""

    name = "tent"
    has_slope = True
    reach = (-0.5, 0.5)

    def weights(self, x):
        first = dr.floor(x - 0.5)
        a = mi.Float(x - 0.5 - first)
        return first, [(0, 1 - a, mi.Float(-1)), (1, a, mi.Float(1))]


class GaussianFilter:
    """The bin's box convolved with a Gaussian of ``stddev`` bins, cut at four standard deviations."""

    name = "gaussian"
    has_slope = True

    def __init__(self, stddev: float):
        check_stddev(stddev)
        self.stddev = float(stddev)
        self.radius = math.ceil(CUT_STDDEVS * stddev)
        self.reach = (-CUT_STDDEVS * self.stddev, CUT_STDDEVS * self.stddev)

    def weights(self, x):
        # The cumulative distribution, rescaled such that it is exactly 0 and 1 at the cut: the weights of an
        # arrival sum to one, whatever stddev is.
        scale = 1 / (self.stddev * math.sqrt(2))
        total = math.erf(CUT_STDDEVS / math.sqrt(2))
        density = 1 / (self.stddev * math.sqrt(2 * math.pi) * total)
        base = dr.floor(x)
        frac = mi.Float(x - base)

        def edge(position):
            u = position - frac
            inside = dr.abs(u) < CUT_STDDEVS * self.stddev
            cdf = dr.select(inside, 0.5 + 0.5 * dr.erf(u * scale) / total, dr.select(u > 0, mi.Float(1), mi.Float(0)))
            pdf = dr.select(inside, density * dr.exp(-dr.square(u * scale)), 0)
            return cdf, pdf

        taps = []
        low = edge(mi.Float(-self.radius))
        for k in range(-self.radius, self.radius + 1):
            high = edge(mi.Float(k + 1))
            taps.append((k, high[0] - low[0], low[1] - high[1]))
            low = high
        return base, taps


def make_temporal_filter(name: str, stddev: float = 0.5):
    """Return a temporal filter by its name.

    Args:
        name: ``box``, ``tent`` or ``gaussian``.
        stddev: standard deviation of the Gaussian, bins.

    Raises:
        SceneError: for another name or width.
    """
    check_name(name)
    if name == "box":
        return BoxFilter()
    return TentFilter() if name == "tent" else GaussianFilter(stddev)


# Nodes of the table of F over the length of the kernel; it is linear in between.
NODES = 2048
MIN_NODES_PER_BIN, MAX_NODES_PER_BIN = 1 << 5, 1 << 14
# A kernel of more bins than this is better applied to the rendered transient.
MAX_BINS = 4096


class PulsedFilter:
    """The temporal filter ``base`` spread by ``pulses``, for bins of ``bin_width_opl`` metres. Has a slope.

    Raises SceneError when the kernel covers more than 4096 bins.
    """

    has_slope = True

    def __init__(self, base, pulses, bin_width_opl: float):
        self.name = base.name
        spread = with_filter(pulses, base, bin_width_opl)
        low, high = (sum(p.support_opl[side] for p in spread) / bin_width_opl for side in (0, 1))
        if high - low > MAX_BINS:
            raise SceneError(
                f"film: pulse and response together cover {high - low:.0f} bins of {bin_width_opl:g} m; at most "
                f"{MAX_BINS} are spread while rendering. Use wider bins, or render without them and apply the pulse "
                "afterwards (torchtransient.sensing.apply_pulse)."
            )
        per_bin = 2 ** math.ceil(math.log2(NODES / (high - low)))
        self.nodes_per_bin = int(min(max(per_bin, MIN_NODES_PER_BIN), MAX_NODES_PER_BIN))
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
        """Return (bin of the first tap, node and share at its lower edge) for an arrival.

        Args:
            x: the arrival in bins, Float64.
        """
        start = dr.floor(x)
        # The node of an edge is the same for all bins but for a multiple of the nodes per bin.
        u = mi.Float(1 - (x - start)) * self.nodes_per_bin
        node = dr.minimum(mi.UInt32(u), self.nodes_per_bin - 1)
        return start + self.first, node, u - mi.Float(node)

    def edge(self, node, share):
        """Return the cumulative distribution at an edge, and its slope per bin.

        Args:
            node, share: place of the edge in the table, see :meth:`begin`.
        """
        low, high = dr.gather(mi.Float, self._table, node), dr.gather(mi.Float, self._table, node + 1)
        return dr.fma(high - low, share, low), (high - low) * self.nodes_per_bin

    def weights(self, x):
        """Return first bin, and ``(offset, weight, d weight / dx)`` for every bin that is reached."""
        first, node, share = self.begin(x)
        taps, low = [], self.edge(node, share)
        for k in range(self.count):
            node = node + self.nodes_per_bin
            high = self.edge(node, share)
            taps.append((k, high[0] - low[0], low[1] - high[1]))
            low = high
        return first, taps


def with_filter(pulses, base, bin_width_opl: float) -> list[Pulse]:
    """Return pulses together with the one that a temporal filter spreads arrivals by.

    Args:
        pulses: :class:`~torchtransient.pulses.Pulse` each.
        base: temporal filter, whose pulse is a box (tent) or a Gaussian; the box filter has none.
        bin_width_opl: width of a bin, metres.
    """
    if isinstance(base, TentFilter):
        return [*pulses, Pulse.rectangular(bin_width_opl)]
    if isinstance(base, GaussianFilter):
        return [*pulses, Pulse.gaussian(base.stddev * FWHM_PER_STDDEV * bin_width_opl)]
    return list(pulses)


def pulse_of(props, prefix: str, plugin: str) -> Pulse | None:
    """Return the pulse that properties of a film describe, None without them.

    ``<prefix>``: ``gaussian`` (``_fwhm_opl``), ``rectangular`` (``_width_opl``) or ``tabulated`` (``_opl`` and
    ``_values``: numbers separated by spaces or commas); ``_center_opl`` (0) for all. Metres.

    Args:
        props: properties of the film.
        prefix: first part of the names of these properties.
        plugin: name of the film, for messages.

    Raises:
        SceneError: for other kinds, and for values out of range.
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
    """Return the numbers of a text.

    Args:
        text: numbers separated by spaces or commas; a single number is one.
        name: name of the property, for messages.
        plugin: name of the plugin, for messages.

    Raises:
        SceneError: for other text.
    """
    try:
        return [float(part) for part in re.split(r"[,\s]+", str(text).strip()) if part]
    except ValueError:
        raise SceneError(f"{plugin}: {name} must be numbers separated by spaces or commas, got {text!r}.") from None


@dr.syntax
def put_long(layout, kernel, x, value, slope_value, active):
    """Add an arrival to all bins that a long kernel reaches.

    Args:
        layout: :class:`.block.BinLayout` of the histogram.
        kernel: :class:`PulsedFilter`.
        x: place of the arrival, bins from the start of the window, Float64.
        value: light by channel, times the weight of each bin.
        slope_value: numbers by channel, times the slope of the weight per bin, or None.
        active: mask of lanes.

    Returns:
        (share of the weight before the window, share behind it), Float.
    """
    k, node, share = kernel.begin(x)
    end = k + kernel.count
    low, low_pdf = kernel.edge(node, share)
    before, after = mi.Float(0), mi.Float(0)
    going = mi.Bool(active)
    while dr.hint(going, label="long temporal kernel"):
        node += kernel.nodes_per_bin
        high, high_pdf = kernel.edge(node, share)
        weight, dweight = high - low, low_pdf - high_pdf
        before += dr.select(k < 0, weight, 0)
        after += dr.select(k >= layout.bins, weight, 0)
        inside = going & (k >= 0) & (k < layout.bins)
        _scatter_bin(layout, inside, k, weight, dweight, value, slope_value)
        low, low_pdf = mi.Float(high), mi.Float(high_pdf)
        k += 1
        going = k < end
    return before, after


def _scatter_bin(layout, inside, k, weight, dweight, value, slope_value):
    """Add to one bin."""
    index = dr.fma(mi.UInt32(k), layout.bin_stride, layout.base)
    for c in range(layout.channels):
        v = value[c] * weight
        if slope_value is not None:
            v += slope_value[c] * dweight
        index_c = index + c * layout.channel_stride
        dr.scatter_reduce(dr.ReduceOp.Add, layout.flat, type(layout.flat)(v), index_c, inside, layout.mode)


@dr.syntax
def read_long(layout, kernel, x, active, steady=None):
    """Return the sum of a cube's entries, weighed by a long kernel, and its slope.

    Args:
        layout: :class:`.block.BinLayout` of the histogram.
        kernel: :class:`PulsedFilter`.
        x: place of the arrival, bins from the start of the window, Float64.
        active: mask of lanes.
        steady: numbers by channel that are added to every entry, or None.

    Returns:
        (sums, slopes per bin), lists over channels.
    """
    k, node, share = kernel.begin(x)
    end = k + kernel.count
    low, low_pdf = kernel.edge(node, share)
    A, slope = [mi.Float(0) for _ in range(layout.channels)], [mi.Float(0) for _ in range(layout.channels)]
    going = mi.Bool(active)
    while dr.hint(going, label="long temporal kernel, adjoint"):
        node += kernel.nodes_per_bin
        high, high_pdf = kernel.edge(node, share)
        A, slope = _with_bin(layout, going, k, high - low, low_pdf - high_pdf, steady, A, slope)
        low, low_pdf = mi.Float(high), mi.Float(high_pdf)
        k += 1
        going = k < end
    return A, slope


def _with_bin(layout, going, k, weight, dweight, steady, A, slope):
    """Return the sums with one more bin."""
    inside = going & (k >= 0) & (k < layout.bins)
    index = dr.fma(mi.UInt32(k), layout.bin_stride, layout.base)
    values = []
    for c in range(layout.channels):
        a = mi.Float(0) if steady is None else dr.select(inside, steady[c], 0)
        if layout.flat is not None:
            a += dr.gather(mi.Float, layout.flat, index + c * layout.channel_stride, inside)
        values.append(a)
    return (
        [dr.fma(a, weight, s) for a, s in zip(values, A, strict=True)],
        [dr.fma(a, dweight, s) for a, s in zip(values, slope, strict=True)],
    )
