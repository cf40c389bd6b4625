"""Engine: renders and their derivatives in both modes, from torch tensors to torch tensors, without a torch graph.

:func:`run` installs the values of a job in its built scene, has the integrator's jobs executed (recorded or traced,
:mod:`.recording`) and reads the results, under one lock. No Dr.Jit graph outlives a run.

Tensors are real and in the film's layout here: steady (H, W, C) and the film's response, which is the transient (H, W,
T, C) or the phasors (H, W, F, 2 C) with real and imaginary parts in turn; with a leading dimension of items when there
are several.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch

from torchtransient.checks import one_line
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError, UnitError, VariantError
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER, is_time_resolved
from torchtransient.plugins.frozen_state import says_it_can_be_recorded
from torchtransient.plugins.guards import ensure_restored, no_collection
from torchtransient.plugins.parameters import check_slope, without_zeros
from torchtransient.rendering.broken_numbers import broken_entries, fill_broken
from torchtransient.rendering.films import FilmLayout, layout_of_film
from torchtransient.rendering.job import Item, RenderJob, RunLog, samples_drawn
from torchtransient.rendering.memory import check_fits
from torchtransient.rendering.recording import LARGE_FILM, Numbered, Recordings, Results, execute, groups_of
from torchtransient.rendering.values import detached, put_back, values_of
from torchtransient.scene.edits import built_depth
from torchtransient.scene.objects import sampler_plugin
from torchtransient.scene.parameters import needing_slope
from torchtransient.scene.physics import all_finite, are_finite, smallest_and_largest
from torchtransient.scene.samplers import AUTO, OF_SCENE
from torchtransient.scene.values import flat_drjit_copy, wait_for_torch
from torchtransient.scene.variant import active_variant, clear_frames, named_errors, quiet


def run(
    job: RenderJob, kind: str, values: Sequence[torch.Tensor], vectors: Sequence[torch.Tensor | None] = ()
) -> tuple[torch.Tensor, ...]:
    """Execute a job: a render, or one of its derivatives.

    Args:
        job: settings of the call.
        kind: ``RENDER``, ``BACKWARD`` or ``FORWARD`` of :mod:`torchtransient.interfaces`.
        values: one tensor per key of the job, with a leading dimension of entries where ``job.batched`` says so.
        vectors: adjoints of steady and response for ``BACKWARD``, None for zero; tangents of the values that need a
            derivative for ``FORWARD``.

    Returns:
        Of ``RENDER`` steady and response, of ``FORWARD`` their derivatives, of ``BACKWARD`` the gradients of the values
        that need one, in their shapes. Adjoints and tangents that are not finite make all that they reach NaN.

    Raises:
        UnitError: for values that are not finite.
        SceneError, StorageError, GradientError, VariantError: for scenes that cannot be rendered, films beyond the
            memory, derivatives that do not exist, and flags of Dr.Jit under which derivatives are wrong.
    """
    if kind == RENDER:
        check_values(job, values)
    if kind == BACKWARD and all(v is None for v in vectors):
        return tuple(torch.zeros_like(v) for v, need in zip(values, job.needs, strict=True) if need)
    kinds: dict[str, Callable[..., Results]] = {RENDER: Images, BACKWARD: Gradients, FORWARD: Tangents}
    handled = sys.exc_info()[1]
    try:
        with open_session(job) as session:
            results = kinds[kind](session, values, vectors)
            for group in groups_of(session):
                execute(session, results, group)
            return results.finish()
    except Exception:
        raise
    except BaseException as interrupt:
        # One that comes at the beginning of a block's __exit__ leaves its generator waiting as long as the traceback is
        # kept (notebooks do), and with it the lock and the variant.
        clear_frames(interrupt, handled)
        raise
    finally:
        del handled


# ---------------------------------------------------------------------------------------------------- a scene in use


class Session:
    """Built scene in use by one job, with its recordings and the slots of the job's keys.

    Args:
        job: the job, whose keys and options count.
    """

    def __init__(self, job: RenderJob):
        self.job = job
        self.slots = job.scene.slots(job.keys, job.options)
        self.scene = self.slots.built.scene
        self.params = self.slots.built.params
        self.integrator = self.scene.integrator()
        self.recordings = job.scene.recordings.setdefault(job.options, {}).setdefault(job.keys, Recordings())
        self.sensors = self.scene.sensors()

    def film(self, item: Item) -> Any:
        """Return the film of an item.

        Args:
            item: item of the job.
        """
        return self.sensors[item.sensor].film()

    def entries(self, item: Item) -> int:
        """Return the number of values behind the pixels of an item's film.

        Args:
            item: item of the job.
        """
        return math.prod(self.film(item).cube_shape())

    def install(self, item: Item, values: Sequence[torch.Tensor], needs: Sequence[bool]) -> list[Any]:
        """Write the values of one batch entry into the scene.

        Args:
            item: item, whose entry counts.
            values: one tensor for each key, of all entries where they are batched.
            needs: truth value of each key, whether its leaf carries gradients.

        Returns:
            Leaves of Dr.Jit's graph that the scene's parameters were computed from, flat, one for each key.

        Raises:
            SceneError: for values that Mitsuba refuses.
        """
        import drjit as dr

        leaves: list[Any] = []
        self.job.scene.installed[self.job.options] = self.slots
        for slot, value, batched, need in zip(self.slots.slots, values, self.job.batched, needs, strict=True):
            entry = value[item.entry] if batched else value
            slot.check(entry)
            leaf = flat_drjit_copy(entry)
            if need and slot.loses_black():
                leaf = without_zeros(leaf)
            if need:
                dr.enable_grad(leaf)
            leaves.append(leaf)
        try:
            with quiet():
                self.slots.install(leaves)
        except (RuntimeError, ValueError, TypeError) as error:
            if isinstance(error, TorchTransientError):
                raise
            keys = ", ".join(self.job.keys)
            raise SceneError(f"values of {keys}: Mitsuba refuses them: {one_line(error)}") from error
        return leaves

    def settings(self) -> list[tuple[Any, str, Any]]:
        """Return the attributes of plugins that the job sets, as (plugin, name, value)."""
        job, integrator = self.job, self.integrator
        found: list[tuple[Any, str, Any]] = []
        if hasattr(integrator, "sampler_of"):
            found.append((integrator, "sampler", plugin_of_sampler(integrator, job.sampler)))
        if job.bound is not None:
            found.append((integrator, "max_depth", job.bound.depth))
        if job.temporal_filter:
            if getattr(integrator, "temporal_filter", ""):  # it would replace the films' when a render begins
                found.append((integrator, "temporal_filter", ""))
            films = [sensor.film() for sensor in self.sensors]
            found += [
                (film, "temporal_filter", job.temporal_filter)
                for film in films
                if is_time_resolved(film) and film.temporal_filter
            ]
        return [*found, *boundary_settings(job.boundary, job.spp_boundary, integrator)]


def plugin_of_sampler(integrator: Any, asked: str | None) -> str:
    """Return the ``sampler`` of an integrator for a job: the one asked for, its own, or "auto".

    Args:
        integrator: built integrator.
        asked: plugin name of a sampler, or None.
    """
    return asked or integrator.sampler or AUTO


def sampler_of(scene: Any, sensor: Any, asked: str | None) -> Any:
    """Return a copy of the sampler that draws for a sensor.

    Args:
        scene: built scene.
        sensor: sensor of the scene.
        asked: plugin name that a layer asks for, or None.

    Raises:
        ArgumentError: if the integrator of the scene takes no other sampler than the sensor's.
        SceneError: for an unknown plugin.
    """
    integrator = scene.integrator()
    if not hasattr(integrator, "sampler_of"):
        if asked not in (None, OF_SCENE):
            name = type(integrator).__name__
            raise ArgumentError(f"sampler: {name} draws from the samplers of the sensors; leave it out.")
        return sensor.sampler().clone()
    try:
        return integrator.sampler_of(scene, sensor, plugin_of_sampler(integrator, asked))
    except RuntimeError as error:
        if isinstance(error, TorchTransientError):
            raise
        raise SceneError(f"sampler: Mitsuba refuses the plugin {asked!r}: {one_line(error)}") from error


def boundary_settings(boundary: bool, spp: int | None, integrator: Any) -> list[tuple[Any, str, Any]]:
    """Return the attributes of an integrator that switch its boundary term, as (plugin, name, value).

    The integrator's own warning of edges is switched off: the layer warns.

    Args:
        boundary: False leaves the boundary term out.
        spp: samples per pixel of each of its passes, None for the integrator's.
        integrator: integrator of the built scene; attributes that it does not have are left out.
    """
    changes: dict[str, Any] = {"warns_of_edges": False}
    changes |= ({} if boundary else {"boundary": False}) | ({} if spp is None else {"spp_boundary": spp})
    return [(integrator, name, value) for name, value in changes.items() if hasattr(integrator, name)]


@contextmanager
def with_settings(settings: Sequence[tuple[Any, str, Any]]) -> Iterator[None]:
    """Set attributes of plugins for the time of a block.

    Args:
        settings: plugin, name of the attribute and its value, one after the other.
    """
    before = [(plugin, name, getattr(plugin, name)) for plugin, name, _ in settings]

    def put_back() -> None:
        for plugin, name, value in reversed(before):
            setattr(plugin, name, value)

    try:
        for plugin, name, value in settings:
            setattr(plugin, name, value)
        yield
    finally:
        ensure_restored(put_back)


@contextmanager
def open_session(job: RenderJob) -> Iterator[Session]:
    """Hold the engine lock with the job's scene built, in its variant and with the settings of the job.

    Args:
        job: the job.

    Raises:
        VariantError: if Dr.Jit's flag SymbolicLoops is off.
    """
    import drjit as dr

    with active_variant(job.scene.variant), no_collection(), named_errors():
        if not dr.flag(dr.JitFlag.SymbolicLoops):
            raise VariantError(
                "the flag SymbolicLoops of Dr.Jit is off, without which gradients of a render are wrong; switch it on: "
                "drjit.set_flag(drjit.JitFlag.SymbolicLoops, True)."
            )
        with _values_at_call(job):
            session = Session(job)
            attached = True  # an error may leave derivatives
            try:
                with with_settings(session.settings()):
                    yield session
                attached = any(job.needs)
            finally:
                if attached or job.scene.is_shared:
                    ensure_restored(lambda: job.scene.restore(job.options, session.slots))


@contextmanager
def _values_at_call(job: RenderJob) -> Iterator[None]:
    """Give a scene that is shared with its owner the values of the call, without derivatives, for a block."""
    import drjit as dr

    if not job.scene.is_shared:
        yield
        return
    params = job.scene.built(job.options).params
    with dr.resume_grad():
        now = values_of(params)

    def restore() -> None:
        with dr.resume_grad():
            put_back(params, now)

    try:
        with dr.resume_grad():
            if not job.at_call:
                job.at_call.append(detached(now))
            put_back(params, job.at_call[0], now)
        yield
    finally:
        ensure_restored(restore)


# ------------------------------------------------------------------------------------------------------------ renders


class Images:
    """Results of ``RENDER``: all items in one tensor each; of a single one the film's own memory.

    Large films write straight to their place: a copy would cost as much as a third of a render of 16 samples per pixel.
    """

    kind = RENDER

    def __init__(self, session: Session, values: Sequence[torch.Tensor], _vectors: Sequence[torch.Tensor | None]):
        job = session.job
        self.session, self.values, self.count = session, values, len(job.items)
        self._started = time.perf_counter()
        self._energies: list[tuple[float, float]] = []
        # How the call of each item was made: launched, recorded, or the reason why it was traced.
        self.calls: list[str] = []
        self._steady: torch.Tensor | None = None
        self._response: torch.Tensor | None = None
        self._memory: Any = None
        check_items(session.sensors, job.items)
        self.films = [session.film(item) for item in job.items]
        film = self.films[0]
        check_fits(film.cube_shape(), self.count, job.scene.variant, film.storage_shape())

    def install(self, item: Item, group: Sequence[Numbered]) -> None:
        """Install the values of an item's entry, which the group shares, and check the scene that holds them."""
        self.session.install(item, self.values, [False] * len(self.values))
        for _, each in group:
            self.session.job.watch.check_installed(self.session.scene, each.sensor)

    def adjoint(self, _n: int) -> tuple[None, None]:
        """Return no adjoint."""
        return None, None

    def progress(self, n: int) -> Callable[[float], None] | None:
        """Return a function of the share of item ``n`` that is done, None without a progress bar."""
        report = self.session.job.progress
        return None if report is None else lambda fraction: report((n + fraction) / self.count)

    @contextmanager
    def storage(self, film: Any, n: int) -> Iterator[bool]:
        """Lend a large film the memory of item ``n`` in the output for a render; yield whether it was lent."""
        entries = math.prod(film.cube_shape())
        large = self.count > 1 and entries >= LARGE_FILM and self.count * entries < 2**32
        # An integrator of others may not know of first entries.
        able = large and says_it_can_be_recorded(self.session.integrator)
        if not able or not all(other.can_borrow(self.session.job.spp) for other in self.films):
            yield False
            return
        import mitsuba as mi

        from torchtransient.plugins.films.base import zeros

        if self._memory is None:
            self._memory = zeros(mi.Float, self.count * entries)  # type: ignore[no-untyped-call]
        try:
            film.lend((self._memory, n * entries))
            yield True
        finally:
            film.lend(None)

    def collect(self, n: int, item: Item) -> None:
        """Take the result of item ``n`` from its film."""
        film = self.session.film(item)
        self._energies.append(film.energies_outside())
        if self._memory is not None and film.bands and film.bands[0][2] is self._memory:
            steady, response = _lent_steady(film), None
        else:
            steady, response = _tensors_of(film, None if self._response is None else self._response[n])
        if self.count == 1:
            self._steady, self._response = steady, response
            return
        if self._steady is None:
            self._steady = steady.new_empty((self.count, *steady.shape))
        self._steady[n].copy_(steady)
        if response is not None:
            if self._response is None:
                self._response = response.new_empty((self.count, *response.shape))
            self._response[n].copy_(response)

    def finish(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return steady and response, and report to the job's log."""
        import mitsuba as mi

        session, job, film = self.session, self.session.job, self.films[0]
        if self._response is None:
            self._response = mi.TensorXf(self._memory, (self.count, *film.cube_shape())).torch()
        assert self._steady is not None and self._response is not None
        seconds = time.perf_counter() - self._started
        sampler = sampler_of(session.scene, session.sensors[job.items[0].sensor], job.sampler)
        spp = samples_drawn(sampler, job.spp)
        channels = len(film.channel_names())
        light = self._steady[..., :channels].sum((-3, -2, -1), dtype=torch.float64) / channels
        total = tuple(light.reshape(-1).tolist())
        before, after = zip(*self._energies, strict=True)
        integrator, depth = session.slots.built.integrator, built_depth(session.integrator)
        calls = tuple(self.calls)
        name = sampler_plugin(sampler)
        job.log.append(RunLog(job.items, seconds, integrator, spp, before, after, total, calls, depth, name))
        if job.watch.enabled:
            rates = film.measures == "rates"
            job.watch.check_window(sum(total), sum(before), sum(after), rates)
        return self._steady, self._response


def _lent_steady(film: Any) -> torch.Tensor:
    """Return the steady image of a film that has written its array to memory that was lent to it."""
    import drjit as dr
    import mitsuba as mi

    dr.eval(film.steady, film.bands[0][2])
    dr.sync_thread()
    shape = film.cube_shape()
    steady: torch.Tensor = mi.TensorXf(film.steady, (shape[0], shape[1], film.channel_count())).torch()
    film.clear()
    return steady


def _tensors_of(film: Any, into: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return steady and response, which own the film's memory; of a cube in several bands they are put together."""
    import drjit as dr
    import mitsuba as mi

    bands = film.transient_bands()
    shape = film.cube_shape()
    dr.eval(film.steady, *(band[2] for band in bands))
    dr.sync_thread()
    steady = mi.TensorXf(film.steady, (shape[0], shape[1], film.channel_count())).torch()
    if len(bands) == 1:
        response = mi.TensorXf(bands[0][2], shape).torch()
    else:
        response = torch.empty(shape, dtype=steady.dtype, device=steady.device) if into is None else into
        while bands:
            first, rows, flat = bands.pop(0)
            response[first : first + rows].copy_(flat.torch().view(rows, *shape[1:]))
            del flat
    film.clear()
    return steady, response


def check_items(sensors: Sequence[Any], items: Sequence[Item]) -> FilmLayout:
    """Return the layout of the films of a call, which have to measure the same in one shape.

    Args:
        sensors: sensors of the built scene.
        items: items of the call.

    Raises:
        ArgumentError: for an index without a sensor.
        SceneError: for films of several layouts, shapes or channels.
    """
    found: dict[int, tuple[FilmLayout, tuple[int, ...], tuple[str, ...]]] = {}
    for item in items:
        if not 0 <= item.sensor < len(sensors):
            raise ArgumentError(f"sensors: the scene has {len(sensors)}, numbered from 0; got {item.sensor}.")
        film = sensors[item.sensor].film()
        found[item.sensor] = layout_of_film(film), tuple(film.cube_shape()), tuple(film.channel_names())
    if len(set(found.values())) > 1:
        films = "; ".join(
            f"sensor {sensor}: {layout} of shape {shape} and channels {'/'.join(channels)}"
            for sensor, (layout, shape, channels) in found.items()
        )
        raise SceneError(
            f"sensors: films rendered in one call must measure the same in one shape, got {films}. Use one "
            "TransientRenderer per sensor."
        )
    return next(iter(found.values()))[0]


def check_values(job: RenderJob, values: Sequence[torch.Tensor]) -> None:
    """Raise ``UnitError`` for values that are not finite, and warn of unphysical ones.

    Args:
        job: job with the keys of the values.
        values: one tensor for each key.
    """
    for key, value in zip(job.keys, values, strict=True):
        low, high = smallest_and_largest(value)
        if not are_finite(low, high):
            bad = int((~torch.isfinite(value)).sum())
            raise UnitError(
                f"value of {key!r}: expected finite numbers, got {bad} of {value.numel()} that are NaN or infinite."
            )
        if job.watch.enabled:
            job.watch.check_value(key, value, low, high)


# -------------------------------------------------------------------------------------------------------- derivatives


class _Derivatives:
    """Results of derivatives: the leaves of the values that were installed last."""

    def __init__(self, session: Session, values: Sequence[torch.Tensor], vectors: Sequence[torch.Tensor | None]):
        self.session, self.values, self.vectors = session, values, vectors
        self.leaves: list[Any] = []
        self.calls: list[str] = []
        job = session.job
        wanted = [key for key, need in zip(job.keys, job.needs, strict=True) if need]
        known = job.scene.known_parameters()
        for item in job.items:
            film = session.film(item)
            moving = needing_slope(known, wanted, film.knows_rates)
            check_slope(moving, film.has_slope, film.response_name, film.slope_remedy)

    def install(self, item: Item, _group: Sequence[Numbered]) -> None:
        """Install the values of an entry, attached."""
        self.leaves = self.session.install(item, self.values, self.session.job.needs)

    def adjoint(self, _n: int) -> tuple[Any, Any]:
        """Return the adjoints of steady and response."""
        return None, None

    def progress(self, _n: int) -> None:
        """Return None: derivatives report no progress."""

    @contextmanager
    def storage(self, _film: Any, _n: int) -> Iterator[bool]:
        """Lend nothing: films of derivatives have memory of their own."""
        yield False


class Gradients(_Derivatives):
    """Results of ``BACKWARD``: gradients of ``<g_steady, steady> + <g_response, response>``."""

    kind = BACKWARD

    def __init__(self, session: Session, values: Sequence[torch.Tensor], vectors: Sequence[torch.Tensor | None]):
        super().__init__(session, values, vectors)
        self._grads = [
            torch.zeros_like(value) if need else None for value, need in zip(values, session.job.needs, strict=True)
        ]

    def adjoint(self, n: int) -> tuple[Any, Any]:
        several = len(self.session.job.items) > 1
        steady, response = (g if g is None or not several else g[n] for g in self.vectors)
        return _steady_adjoint(steady), _cube_adjoint(response)

    def collect(self, _n: int, item: Item) -> None:
        """Add up the gradients that have arrived at the leaves."""
        import drjit as dr

        job, slots = self.session.job, self.session.slots
        # A render_backward of an integrator's own may leave gradients at the scene's parameters, as Mitsuba asks of it.
        for key in slots.originals:
            value = self.session.params[key]
            if dr.grad_enabled(value):
                dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        dr.eval([dr.grad(leaf) for leaf in self.leaves])
        dr.sync_thread()
        for grad, leaf, batched in zip(self._grads, self.leaves, job.batched, strict=True):
            if grad is not None:
                target = grad[item.entry] if batched else grad
                target += dr.grad(leaf).torch().view(target.shape)
        self.leaves = []

    def finish(self) -> tuple[torch.Tensor, ...]:
        """Return the gradients, NaN where a film's adjoint is not finite: of its entry, and of unbatched values."""
        self.session.job.derivative_log.extend(self.calls)
        job, adjoints = self.session.job, [g for g in self.vectors if g is not None]
        if len(job.items) == 1:
            broken = [not all(map(all_finite, adjoints))]
        else:
            columns = [broken_entries(adjoint, len(job.items)) for adjoint in adjoints]
            broken = list(map(any, zip(*columns, strict=True)))
        for item, is_broken in zip(job.items, broken, strict=True):
            if is_broken:
                fill_broken(
                    grad[item.entry] if batched else grad
                    for grad, batched in zip(self._grads, job.batched, strict=True)
                    if grad is not None
                )
        return tuple(grad for grad in self._grads if grad is not None)


def _steady_adjoint(g: torch.Tensor | None) -> Any:
    import mitsuba as mi

    if g is None:
        return None
    g = g.resolve_neg().contiguous()
    wait_for_torch(g)
    return mi.TensorXf(g)


def _cube_adjoint(g: torch.Tensor | None) -> Any:
    """Return the adjoint cube as (flat array, offset, strides): read in place, in whatever layout torch left it."""
    import mitsuba as mi

    if g is None:
        return None
    g = g.detach().resolve_neg()
    wait_for_torch(g)
    span = 1 + sum((size - 1) * stride for size, stride in zip(g.shape, g.stride(), strict=True))
    if span >= 2**32:
        # Beyond 32-bit indices only the film's own layout is understood.
        return mi.TensorXf(g.contiguous())
    flat = g.as_strided((span,), (1,), g.storage_offset())
    return mi.Float(flat), 0, tuple(int(stride) for stride in g.stride())


class Tangents(_Derivatives):
    """Results of ``FORWARD``: derivatives of steady and response along the tangents."""

    kind = FORWARD

    def __init__(self, session: Session, values: Sequence[torch.Tensor], vectors: Sequence[torch.Tensor | None]):
        super().__init__(session, values, vectors)
        job = session.job
        self._batched = [batched for batched, need in zip(job.batched, job.needs, strict=True) if need]
        self._steady: list[torch.Tensor] = []
        self._response: list[torch.Tensor] = []

    def _of_entry(self, item: Item) -> list[torch.Tensor]:
        tangents = [tangent for tangent in self.vectors if tangent is not None]
        return [t[item.entry] if batched else t for t, batched in zip(tangents, self._batched, strict=True)]

    def install(self, item: Item, group: Sequence[Numbered]) -> None:
        """Install the values of an entry, and carry their tangents on to the scene's parameters."""
        import drjit as dr

        super().install(item, group)
        wanted = [leaf for leaf, need in zip(self.leaves, self.session.job.needs, strict=True) if need]
        for leaf, tangent in zip(wanted, self._of_entry(item), strict=True):
            dr.set_grad(leaf, flat_drjit_copy(tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
        # Interior nodes keep their tangents: the loops of the integrator read them at their boundary.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)

    def collect(self, _n: int, item: Item) -> None:
        """Take the derivatives of an item from its film; NaN where a tangent is not finite."""
        d_steady, d_response = _tensors_of(self.session.film(item), None)
        if not all(map(all_finite, self._of_entry(item))):
            fill_broken((d_steady, d_response))
        self._steady.append(d_steady)
        self._response.append(d_response)

    def finish(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the derivatives of steady and response."""
        self.leaves = []
        self.session.job.derivative_log.extend(self.calls)
        if len(self.session.job.items) == 1:
            return self._steady[0], self._response[0]
        return torch.stack(self._steady), torch.stack(self._response)
