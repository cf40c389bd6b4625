"""What is asked of plugins, declared where a change of the variant does not reach.

Plugin modules are executed again for each variant, so that their classes are others afterwards. The declarations here
stay the same: ``isinstance(film, FilmInterface)`` holds for the films of every variant. A plugin's base cannot inherit
from them (Mitsuba's classes take one base), so it signs up with ``FilmInterface.register``, and a plugin class that
leaves something out is refused where it is registered (:func:`missing_members`).
"""

from __future__ import annotations

import abc
import enum
from typing import Any, TypeGuard

# The jobs of an integrator: a render, its derivative in reverse mode, and along one tangent.
RENDER, BACKWARD, FORWARD = JOBS = ("render", "backward", "forward")


class FilmInterface(abc.ABC):
    """A film that keeps an array behind every pixel beside the steady image.

    All that integrators and ``rendering/`` ask of a film beyond ``mi.Film``. Path lengths are handed over as ``opl -
    start_opl`` in double precision. The array is stored in bands of whole rows, since Dr.Jit's indices have 32 bits; a
    *band* is given by its number, a *base* is the index of a pixel's first value in it.

    Beside the members below an instance has ``start_opl`` (float, metres: where its clock starts), ``curves`` (the
    response curves of its channels, or None), and while it holds a render ``bands``, ``steady`` and ``outside`` (light
    before and after the window by pixel, None for films without a window).
    """

    start_opl: float
    curves: Any
    bands: list[tuple[int, int, Any]]
    steady: Any
    outside: Any

    # ------------------------------------------------------------------------------------------------ what it is

    @property
    @abc.abstractmethod
    def plugin(self) -> str:
        """Its plugin name, for messages."""

    @property
    @abc.abstractmethod
    def measures(self) -> str:
        """What its array is: ``transient``, ``phasor``, ``gated`` or the word of another film."""

    @property
    @abc.abstractmethod
    def keeps_steady(self) -> bool:
        """Whether there is a steady image beside the array, of light at any time; otherwise it is the sum over it."""

    @property
    @abc.abstractmethod
    def has_window(self) -> bool:
        """Whether the film has a window that light can miss, which is then counted in ``outside``."""

    @property
    @abc.abstractmethod
    def exhaustive_scan(self) -> bool:
        """Whether there is one array for every pair of sensor and laser position."""

    @property
    @abc.abstractmethod
    def pulses(self) -> list[Any]:
        """Pulse of the light and impulse response of the sensor that spread every arrival; empty without."""

    @abc.abstractmethod
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""

    @abc.abstractmethod
    def channel_count(self) -> int:
        """The number of channels, times four in polarized variants: all of S0, then S1, S2, S3."""

    # ------------------------------------------------------------------------------------------ response over time

    @property
    @abc.abstractmethod
    def temporal_filter(self) -> str:
        """The temporal filter, ``box``, ``tent`` or ``gaussian``, which can be set; empty for films without one."""

    @property
    @abc.abstractmethod
    def response_name(self) -> str:
        """What messages call the response over time."""

    @property
    @abc.abstractmethod
    def has_slope(self) -> bool:
        """Whether what is stored changes smoothly with the path length."""

    @property
    @abc.abstractmethod
    def slope_remedy(self) -> str:
        """What to do where there is no slope: the end of an error message."""

    @abc.abstractmethod
    def take_filter(self, name: str, stddev: float | None) -> None:
        """Take over an integrator's settings of the temporal filter; empty name and None leave the film's own, and
        films without a filter leave it at that.
        """

    @abc.abstractmethod
    def arrivals(self) -> Any:
        """Which arrivals count (``ArrivalWindow``), None for all: for a film without a steady image."""

    # ---------------------------------------------------------------------------------------- samples in flight

    @abc.abstractmethod
    def sample_offset(self, sample: Any) -> tuple[Any, Any]:
        """Offset from the pixel's centre drawn from the spatial filter, and the sample's weight (None for one)."""

    @abc.abstractmethod
    def lanes_at_most(self, most_events: int) -> int | None:
        """Largest number of paths with up to ``most_events`` events in one kernel launch, None for no limit."""

    @abc.abstractmethod
    def create_event_block(
        self,
        job: Any,
        base: Any,
        match: Any,
        most_events: int,
        tangents: bool = False,
        exclusive: bool = False,
        origin: Any = None,
    ) -> Any:
        """How the samples of one pass write (``FilmBlock``). ``job``: the pass, with the number of its band; ``base``:
        index of each sample's first entry in it; ``match``: from spectra to channels; ``most_events`` of
        a path; ``tangents``: events are derivatives (``put_slope``) instead of contributions (``put``); ``exclusive``:
        as in ``put``; ``origin`` (``Float64``, for each sample, or None for zero): path length that those of the events
        are counted from, which then may come in single precision.
        """

    @abc.abstractmethod
    def create_adjoint_block(self, response: Any, base: Any, steady: Any, match: Any) -> Any:
        """How the samples of one pass read the adjoint (``AdjointBlock``): ``response`` is None or (array, bin stride,
        channel stride), ``base`` the index of each sample's first entry in it, ``steady`` the adjoint of the steady
        image by channel.
        """

    @abc.abstractmethod
    def put(
        self, band: int, base: Any, opl_from_start: Any, value: list[Any], active: Any, exclusive: bool = False
    ) -> tuple[Any, Any]:
        """Add ``value`` (by channel) that arrives at ``opl - start_opl`` to the array from ``base`` on. Returns the
        fractions of it that fall before and after the window, which are not stored. ``exclusive``: no two lanes of the
        kernel have the same ``base``, so that sums need not be atomic.
        """

    @abc.abstractmethod
    def put_slope(
        self, band: int, base: Any, opl_from_start: Any, d_value: list[Any], value_d_opl: list[Any], active: Any
    ) -> None:
        """Forward mode: add ``k df + f k' dtau``, with ``df`` and ``f dtau`` by channel."""

    @abc.abstractmethod
    def read(
        self, adjoint: Any, base: Any, opl_from_start: Any, active: Any, steady: list[Any] | None = None
    ) -> tuple[list[Any], list[Any]]:
        """The adjoint of ``put``: ``A`` and its slope ``dA / d opl`` for an arrival, lists over channels.

        ``adjoint`` is ``(flat array, bin stride, channel stride)`` or None, ``base`` the index of the pixel's first
        value in it. ``steady``: adjoint of the sum over the array, for films without a steady image of their own.
        """

    # -------------------------------------------------------------------------------------------------- storage

    @abc.abstractmethod
    def cube_shape(self) -> tuple[int, ...]:
        """Shape of the array, (H, W, entries, channels), of the crop window; channels last, (H, W, Lh, Lw, T, C) in an
        exhaustive scan.
        """

    @abc.abstractmethod
    def entries_per_pixel(self) -> int:
        """Floats behind one pixel."""

    @abc.abstractmethod
    def band_layout(self) -> list[tuple[int, int]]:
        """The storage bands as (first row, rows)."""

    @abc.abstractmethod
    def start_render(self, samples: int = 0) -> None:
        """Allocate zeroed storage for one render of ``samples`` per pixel."""

    @abc.abstractmethod
    def add_steady(self, pixel: Any, channels: list[Any]) -> None:
        """Add to the steady image of pixels, unless the film sums it up of its array."""

    @abc.abstractmethod
    def add_outside(self, pixel: Any, before: Any, after: Any) -> None:
        """Count the light of pixels that a window missed; nothing to do for a film without one."""

    @abc.abstractmethod
    def tabulate_filter(self) -> None:
        """Compute what ``sample_offset`` needs, where there is nothing yet: before anything is recorded."""

    @abc.abstractmethod
    def finish_render(self) -> None:
        """End of a render: sums become single precision, and a film without a steady image sums one up."""

    @abc.abstractmethod
    def transient_bands(self) -> list[tuple[int, int, Any]]:
        """The storage as (first row, rows, flat array) for each band."""

    @abc.abstractmethod
    def can_borrow(self, samples: int) -> bool:
        """Whether renders of ``samples`` per pixel can add to an array of somebody else's, see :meth:`lend`. Films with
        storage of their own answer no.
        """

    @abc.abstractmethod
    def lend(self, storage: tuple[Any, int] | None) -> None:
        """Let renders add to an array of zeros from one entry on, ``(flat array, first entry)``, instead of to one of
        their own, until None is given.
        """

    @abc.abstractmethod
    def first_entry(self) -> Any:
        """Index of the film's first value in its band (``UInt32``), None for zero: whoever computes a base adds it."""

    @abc.abstractmethod
    def taken(self) -> list[Any]:
        """The arrays of a finished render, as a list that :meth:`hold` takes; the film has none of them any more. Other
        arrays of the film stay where they are: Dr.Jit writes attributes of plugins back after a recorded call.
        """

    @abc.abstractmethod
    def hold(self, arrays: list[Any]) -> None:
        """Take over what :meth:`taken` returned, as if it had been rendered now."""

    @abc.abstractmethod
    def check_one_band(self) -> None:
        """Raise ``StorageError`` when the array does not fit into one tensor."""

    @abc.abstractmethod
    def develop(self, raw: bool = False) -> tuple[Any, Any]:
        """The pair (steady ``(H, W, C)``, array of shape ``cube_shape()``), without a copy."""

    @abc.abstractmethod
    def clear(self) -> None:
        """Drop the storage; tensors developed before keep their memory."""

    @abc.abstractmethod
    def energies_outside(self) -> tuple[float, float]:
        """(``energy_before``, ``energy_after``), read together."""

    @property
    @abc.abstractmethod
    def energy_before(self) -> float:
        """Light that arrived before the window: sum over pixels, mean over channels (of S0)."""

    @property
    @abc.abstractmethod
    def energy_after(self) -> float:
        """Light that arrived after the window: sum over pixels, mean over channels (of S0)."""


class IntegratorInterface(abc.ABC):
    """A transient integrator: what ``rendering/`` and the pilot run ask of it beyond ``mi.Integrator``.

    Beside the members below an instance has ``max_depth``, ``rr_depth``, ``camera_unwarp``, ``temporal_filter`` (empty:
    the film's own) and ``gaussian_stddev`` (None: the film's own).
    """

    max_depth: int
    rr_depth: int
    camera_unwarp: bool
    temporal_filter: str
    gaussian_stddev: float | None

    @property
    @abc.abstractmethod
    def walks_through_media(self) -> bool:
        """Whether paths scatter in participating media; others refuse scenes that have them."""

    @abc.abstractmethod
    def strategies(self, contents: Any) -> tuple[Any, Any, list[Any]]:
        """(segment, scattering, list of connections) for a scene with these contents: new objects for every job."""

    @abc.abstractmethod
    def resolve(self, scene: Any, sensor: Any) -> tuple[Any, Any]:
        """The sensor and its film, checked; temporal filter settings of the integrator are handed to the film, which
        keeps them.
        """

    @abc.abstractmethod
    def contents(self, scene: Any, sensor: Any) -> Any:
        """What the scene contains (``SceneContents``), looked up when it is first seen by this sensor."""

    @abc.abstractmethod
    def world(self, scene: Any, contents: Any, wanted: Any = None, window: Any = None, settings: Any = None) -> Any:
        """What the walks of one job are told (``RenderContext``); ``settings``: other than the integrator's own."""

    @abc.abstractmethod
    def silhouettes(self, scene: Any, sensors: Any = None) -> Any:
        """What derivatives of a scene lack where edges move, seen by some sensors (None: all), by parameter
        (:class:`~torchtransient.plugins.transport.boundary.moving_edges.MovingEdges`).
        """

    @abc.abstractmethod
    def reference(self, scene: Any) -> Any:
        """The sphere around the scene that light from and to infinity is timed by."""

    @abc.abstractmethod
    def frozen_state(self, scene: Any, sensor: Any = 0) -> list[Any]:
        """The arrays that kernels of this scene read beside its parameters."""

    @abc.abstractmethod
    def prepared(
        self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, kind: str = RENDER, grad_in: Any = (None, None)
    ) -> Any:
        """A job of :data:`JOBS` with all that is looked up and computed beforehand
        (:class:`~torchtransient.plugins.integrators.job.Prepared`). ``grad_in``: (steady, transient) of a
        backward job, as :meth:`render_backward` takes it.
        """

    @staticmethod
    @abc.abstractmethod
    def state_of(jobs: list[Any]) -> tuple[tuple[Any, ...], list[Any]]:
        """(structure, arrays) of prepared jobs of one scene: those with equal structures, and arrays of the same types
        and sizes, have the same kernels.
        """

    @abc.abstractmethod
    def run(self, prepared: Any, evaluate: bool = True, progress: Any = None) -> None:
        """Carry out a job that is prepared; this alone is recorded: nothing that Python does in it happens again when
        its kernels are launched. ``evaluate``: False leaves what is traced to the caller; ``progress(fraction)`` is
        called after every launch. Both are for renders.
        """

    @abc.abstractmethod
    def passes(self, world: Any, sensor: Any, film: Any, seed: Any, spp: int) -> tuple[list[Any], int]:
        """The launches of a job, and the largest number of samples per pixel."""

    @abc.abstractmethod
    def start(self, scene: Any, sensor: Any, film: Any, job: Any) -> Any:
        """The primary rays of one launch (``PrimaryRays``)."""

    @abc.abstractmethod
    def first_opl(self, film: Any, rays: Any) -> Any:
        """Optical path before the first ray starts, counted from the film's ``start_opl``."""

    @abc.abstractmethod
    def render(
        self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
    ) -> Any:
        """Render steady ``(H, W, C)`` and the film's array."""

    @abc.abstractmethod
    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        """Accumulate the gradient of ``<grad_in, render()>`` into the attached parameters of the scene."""

    @abc.abstractmethod
    def render_forward(
        self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True
    ) -> Any:
        """Derivatives of a render along the tangents of the scene's attached parameters."""


def is_time_resolved(film: object) -> TypeGuard[FilmInterface]:
    """Whether a film is one that transient integrators can write to, of whichever variant it was made."""
    return isinstance(film, FilmInterface)


INTERFACES: tuple[type, ...] = (FilmInterface, IntegratorInterface)


def missing_members(plugin: type) -> list[str]:
    """What a plugin class lacks of the interfaces that it signed up for."""
    wanted = [i for i in INTERFACES if issubclass(plugin, i)]
    names = {name for i in wanted for name in getattr(i, "__abstractmethods__", ())}
    return sorted(name for name in names if _undefined(plugin, name))


def _undefined(plugin: type, name: str) -> bool:
    return getattr(getattr(plugin, name, abc.abstractmethod(lambda: None)), "__isabstractmethod__", False)


class CaptureType(enum.Enum):
    """Laser positions of a scanned point: one for all, itself, each of a grid, or one of its own."""

    SINGLE = 1
    CONFOCAL = 2
    EXHAUSTIVE = 3
    PAIRS = 4
