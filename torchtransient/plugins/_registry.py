"""Registers the library's Mitsuba plugins for whichever variant is active.

A Mitsuba plugin written in Python is a class whose base (`mi.Film`, `mi.BSDF`, ...) belongs to one variant. The plugin
modules therefore define ordinary module-level classes. A module is executed when Mitsuba first makes a plugin of it,
and from then on again (`importlib.reload`) each time the variant changes. Mitsuba tells us of a change through a
callback. Three of its habits shape this file:

- the callbacks are a set without order, and fire on a change only, so a variant that was active before this module was
  imported is caught up with in `attach()`;
- an exception in a callback leaves the new variant active and stops the callbacks of others, so ours raises nothing
  but an interrupt, after which `sync()` has all callbacks called anew; of what else goes wrong it warns, and `sync()`
  raises at the next library call;
- a plugin constructor that raises reaches the caller as a `RuntimeError` with the traceback as text, so the typed error
  is kept aside and `plugin_errors()` raises it again.

Constructors run in threads of Mitsuba, while the thread that loads a scene waits. So three locks are taken in one
order: `changes` (one change of the variant at a time), Python's locks of modules, `tables` (never while code of a
module runs).

How to write a plugin module::

    import mitsuba as mi
    from torchtransient.plugins import ParameterEffect, declare_effects, register

    class MyGlass(mi.BSDF):
        ...

    register("bsdf", "my_glass", MyGlass)
    declare_effects(MyGlass, {"eta": ParameterEffect(moves_length=True, role="index")})

The last line says what its parameters move; without it they count as values such as colours, and an `eta` as an index
whose derivative is not known to be right. A module looks up variant types when it uses them (`mi.Float`) and never
keeps one at module level. To add a module of this
library, add a line to `PLUGIN_MODULES`; a module of someone else's is added with `register_module("their.module")`, and
so it is in the processes that make data sets. A plugin that was registered without a module is in its own process only.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from torchtransient._llvm import ensure_llvm
from torchtransient.errors import PluginRegistrationError, TorchTransientError, VariantError, VersionWarning
from torchtransient.interfaces import missing_members
from torchtransient.plugins.guards import interrupts_wait

# ---------------------------------------------------------------- what the plugins ask about the active Mitsuba variant
# Nothing here is bound to one variant: every function looks at the variant that is active when it is called.

_JIT_PREFIXES = ("llvm_", "cuda_", "metal_")


def active_variant() -> str | None:
    """Name of the active Mitsuba variant, or None when none has been set yet."""
    variant: str | None = mi.variant()
    return variant


def _is_jit(variant: str | None) -> bool:
    """Return whether a variant compiles its kernels with Dr.Jit (`llvm_*`, `cuda_*`, `metal_*`)."""
    return variant is not None and variant.startswith(_JIT_PREFIXES)


def _require_jit_variant(what: str) -> str:
    """Return the active variant, or raise VariantError when `what` cannot work in it (none set, or a scalar one)."""
    variant = active_variant()
    if variant is None:
        raise VariantError(
            f"{what} needs an active Mitsuba variant and none is set. Call mi.set_variant('llvm_ad_rgb') first."
        )
    if not _is_jit(variant):
        raise VariantError(
            f"{what} works on whole arrays and needs a Dr.Jit variant (llvm_ad_*, cuda_ad_*); the active variant is "
            f"'{variant}'. Call mi.set_variant('llvm_ad_rgb') before the scene is loaded."
        )
    return variant


# ----------------------------------------------------------------------------------------------------------------------
# The versions of Mitsuba and Dr.Jit that the tests have run with. Another one is warned of, once in a process.
# The integrators follow internals of Mitsuba that no interface promises, and several of its errors are worked around: a
# patch release can change a number without a message. `torchtransient doctor` shows the same.

# A version comes in here when the whole test set, slow tests included, has passed with it.
TESTED: dict[str, tuple[str, ...]] = {"mitsuba": ("3.9.1",), "drjit": ("1.5.0",)}
_warned: set[str] = set()


def untested(name: str, version: str) -> str | None:
    """Return a warning about an untested version of a package.

    Builds of a tested version, such as "1.5.0+local", are tested ones.

    Args:
        name: package, a key of :data:`TESTED`.
        version: its version, as the package states it.

    Returns:
        The text, None for a tested version or an unlisted package.
    """
    tested = TESTED.get(name)
    if tested is None or version.partition("+")[0] in tested:
        return None
    return (
        f"{name} {version} was never tested with this version of torchtransient; tested: {', '.join(tested)}. Numbers "
        f"may differ without an error: run the tests, or pip install {name}=={tested[-1]}."
    )


def warn_of_untested() -> None:
    """Give a `VersionWarning` that names each of the two packages whose version is not a tested one: once in a process,
    also where the warning is raised as an error.
    """
    import drjit
    import mitsuba

    found = {"mitsuba": mitsuba.__version__, "drjit": drjit.__version__}
    messages = [message for name, version in found.items() if (message := untested(name, version)) is not None]
    text = " ".join(messages)
    if text and text not in _warned:
        _warned.add(text)
        warnings.warn(text, VersionWarning, stacklevel=4)


# ----------------------------------------------------------------------------------------------------------------------

KINDS = (
    "bsdf", "emitter", "film", "integrator", "medium", "phase", "rfilter", "sampler", "sensor", "shape", "texture",
)  # fmt: skip


@dataclass(frozen=True)
class PluginModule:
    """A module of plugins, and the plugins that it registers as pairs `(kind, name)`.

    A module without plugins is listed when others inherit from its classes: it has to be executed again before them.
    """

    module: str
    plugins: tuple[tuple[str, str], ...] = ()


# In the order of execution: a module comes after those whose classes it inherits from.
PLUGIN_MODULES: tuple[PluginModule, ...] = (
    PluginModule("torchtransient.plugins.films.base"),
    PluginModule("torchtransient.plugins.films.histogram", (("film", "transient_hdr_film"),)),
    PluginModule("torchtransient.plugins.films.splined"),
    PluginModule("torchtransient.plugins.films.phasor", (("film", "phasor_hdr_film"),)),
    PluginModule("torchtransient.plugins.films.gated", (("film", "gated_hdr_film"),)),
    PluginModule(
        "torchtransient.plugins.films.rates",
        (("film", "rate_hdr_film"), ("film", "beat_hdr_film"), ("film", "slow_phasor_hdr_film")),
    ),
    PluginModule("torchtransient.plugins.integrators.base"),
    PluginModule("torchtransient.plugins.integrators.path", (("integrator", "transient_path"),)),
    PluginModule(
        "torchtransient.plugins.integrators.volpath",
        (("integrator", "transient_prbvolpath"), ("integrator", "transient_volpath")),
    ),
    PluginModule("torchtransient.plugins.integrators.path_reuse", (("integrator", "transient_path_reuse"),)),
    PluginModule("torchtransient.plugins.sensors.nlos_capture_meter", (("sensor", "nlos_capture_meter"),)),
    PluginModule("torchtransient.plugins.integrators.nlos_path", (("integrator", "transient_nlos_path"),)),
    PluginModule("torchtransient.plugins.emitters.laser_beam", (("emitter", "laser_beam"),)),
    PluginModule("torchtransient.plugins.samplers.owen", (("sampler", "owen"),)),
    PluginModule("torchtransient.plugins.shapes.rigid_motion", (("texture", "rigid_motion"),)),
    PluginModule("torchtransient.plugins.shapes.mesh_arrays", (("shape", "mesh_arrays"),)),
    PluginModule("torchtransient.plugins.emitters.angular_area", (("emitter", "angulararea"),)),
    PluginModule("torchtransient.plugins.emitters.directional_area", (("emitter", "diff_directionalarea"),)),
    PluginModule("torchtransient.plugins.bsdfs.dielectric", (("bsdf", "diff_dielectric"),)),
    PluginModule("torchtransient.plugins.bsdfs.plastic", (("bsdf", "diff_plastic"),)),
    PluginModule("torchtransient.plugins.bsdfs.delayed", (("bsdf", "delayed"),)),
    PluginModule("torchtransient.plugins.bsdfs.retroreflector", (("bsdf", "retroreflector"),)),
    PluginModule("torchtransient.plugins.bsdfs.rough_dielectric", (("bsdf", "diff_rough_dielectric"),)),
    PluginModule("torchtransient.plugins.bsdfs.rough_plastic", (("bsdf", "diff_rough_plastic"),)),
    PluginModule(
        "torchtransient.plugins.bsdfs.principled", (("bsdf", "diff_principled"), ("bsdf", "diff_principled_thin"))
    ),
    PluginModule("torchtransient.plugins.bsdfs.polarized_plastic", (("bsdf", "diff_pplastic"),)),
    PluginModule("torchtransient.plugins.bsdfs.hair", (("bsdf", "diff_hair"),)),
    PluginModule(
        "torchtransient.plugins.bsdfs.conductor", (("bsdf", "diff_conductor"), ("bsdf", "diff_rough_conductor"))
    ),
    PluginModule(
        "torchtransient.plugins.bsdfs.thin_elements",
        (("bsdf", "diff_polarizer"), ("bsdf", "diff_retarder"), ("bsdf", "diff_circular")),
    ),
)


_OWN_MODULES = frozenset(entry.module for entry in PLUGIN_MODULES)
# Surfaces of this library, by the names of their plugins.
OWN_BSDFS = tuple(name for module in PLUGIN_MODULES for kind, name in module.plugins if kind == "bsdf")


@dataclass
class _State:
    """Registered modules and listeners (which need no lock, see :func:`plugin_errors`)."""

    changes: threading.RLock = field(default_factory=threading.RLock)
    tables: threading.RLock = field(default_factory=threading.RLock)
    third_party: list[PluginModule] = field(default_factory=list)
    variant: str | None = None  # the variant that the entries below were made for
    constructors: dict[tuple[str, str], Callable[..., object]] = field(default_factory=dict)
    owner: dict[tuple[str, str], str] = field(default_factory=dict)
    waiting: set[tuple[str, str]] = field(default_factory=set)  # plugins whose module is not executed yet
    loading: threading.local = field(default_factory=threading.local)  # `module` that a change of the variant executes
    listeners: list[list[BaseException]] = field(default_factory=list)  # take what constructors raise
    interrupted: bool = False  # a change of the variant, before all who wait for one had been told


_state = _State()


def register(kind: str, name: str, constructor: Callable[..., object]) -> None:
    """Register a plugin for the active variant. Called at the end of a plugin module.

    Args:
        kind: one of :data:`KINDS`, "bsdf" of `mi.register_bsdf`.
        name: name of the plugin in scene files.
        constructor: the class, or a function, that takes `mi.Properties`.

    Raises:
        PluginRegistrationError: for an unknown kind, for a class that lacks a member of an interface that it signed up
            for, and for a name that another module of the library's list has registered.
    """
    if kind not in KINDS:
        raise PluginRegistrationError(
            f"register: expected a plugin kind out of {', '.join(KINDS)}; got {kind!r} for plugin '{name}'."
        )
    missing = missing_members(constructor) if isinstance(constructor, type) else []
    if missing:
        raise PluginRegistrationError(
            f"register: {kind} plugin '{name}' ({constructor.__name__}) was expected to have {', '.join(missing)} and "
            "does not. Its base class documents them."
        )
    key = (kind, name)
    loading = getattr(_state.loading, "module", None)
    # A module that is being executed may import others, which register plugins too.
    caller = sys._getframe(1).f_globals.get("__name__", "?")
    module = caller if loading is None or caller in _OWN_MODULES else loading
    with _state.tables:
        if caller in _OWN_MODULES and key in _state.waiting:
            # Its first use: Mitsuba has a constructor that asks for this one, unless somebody took the name. Handing it
            # another one would free the first, which a thread of Mitsuba's may be about to call.
            _state.waiting.discard(key)
            _state.constructors[key] = _keeping_errors(constructor)
            return
        if loading is None and caller in _OWN_MODULES:
            return
        other = _state.owner.get(key)
        if loading is not None and other is not None and other != module:
            raise PluginRegistrationError(
                f"register: {kind} plugin '{name}' of module {module} was already registered by {other}. "
                "Give one of them another name."
            )
        _state.waiting.discard(key)
        _add(key, module, constructor)


def register_module(module: str, plugins: tuple[tuple[str, str], ...] = ()) -> None:
    """Add a plugin module of your own. It is executed now and at each later change of the variant.

    Modules are executed in Dr.Jit variants only. Adding a module twice is the same as adding it once.

    Args:
        module: dotted name that Python can import.
        plugins: plugins that the module registers, as (kind, name). Listed names answer with a clear VariantError in
            scalar variants, and a listed name that the module fails to register is an error.

    Raises:
        PluginRegistrationError: for a module that cannot be found or executed.
    """
    with _state.changes:
        # A name is taken as given: find_spec imports the parent packages and raises for what is not a module.
        try:
            found = importlib.util.find_spec(module)
        except (ImportError, AttributeError, ValueError) as error:
            raise PluginRegistrationError(f"register_module: no module named {module!r} ({error}).") from error
        if found is None:
            raise PluginRegistrationError(
                f"register_module: no module named {module!r}. Expected a dotted name that Python can import."
            )
        entry = PluginModule(module, tuple((kind, name) for kind, name in plugins))
        known = [m for m in _state.third_party if m.module == module]
        if known == [entry] or any(m.module == module for m in PLUGIN_MODULES):
            return
        before = list(_state.third_party)
        _state.third_party = [m for m in before if m.module != module] + [entry]
        _state.variant = None
        try:
            sync()
        except PluginRegistrationError:
            _state.third_party = before  # one bad module must not block all later scene loads
            raise


def modules_of_others() -> tuple[PluginModule, ...]:
    """Return the modules added with :func:`register_module`, in order."""
    with _state.changes:
        return tuple(_state.third_party)


def versions_of_others() -> dict[str, str]:
    """Return the version of each added module by name: a hash of its source, or without source the version of its
    package.
    """
    return {entry.module: _version(entry.module) for entry in modules_of_others()}


def _version(module: str) -> str:
    found = importlib.util.find_spec(module)
    source = Path(found.origin) if found is not None and found.origin is not None else None
    if source is not None and source.suffix == ".py" and source.is_file():
        return f"sha256 {hashlib.sha256(source.read_bytes()).hexdigest()[:16]}"
    loaded = sys.modules.get(module.split(".")[0])
    return str(getattr(loaded, "__version__", "unknown"))


def kind_of(name: str) -> str | None:
    """Return the kind of a plugin of this library, or of a module that was added to it.

    Args:
        name: name of the plugin in scene files.

    Returns:
        The kind, such as "bsdf"; None for plugins of Mitsuba and of others.
    """
    with _state.changes:
        for entry in (*PLUGIN_MODULES, *_state.third_party):
            for kind, plugin in entry.plugins:
                if plugin == name:
                    return kind
        return next((kind for kind, plugin in _state.constructors if plugin == name), None)


def sync() -> str | None:
    """Make the plugins of this library available in the active variant. Idempotent; called before every scene load.

    Returns the active variant, or None when none is set: then nothing is registered and nothing fails. Raises
    PluginRegistrationError when a plugin module cannot be executed, also when that happened during an earlier change
    of the variant, and VariantError when Dr.Jit is bound to an LLVM that would abort the process.
    """
    with _state.changes:
        attach_callback()
        variant = active_variant()
        if variant is None:
            return None
        if _state.interrupted:
            _tell_all(variant)
        if variant.startswith("llvm_"):
            ensure_llvm()  # a bad LLVM would end the process at the first kernel
        warn_of_untested()
        if _state.variant != variant:
            _load_all(variant)
        else:
            # Other packages may have registered plugins of the same name since then; the last one wins.
            for key in _state.constructors:
                _hand_to_mitsuba(key)
        return variant


def attach_callback() -> None:
    """Let Mitsuba call us when its variant changes. Repeating it has no effect (Mitsuba keeps a set)."""
    mi.detail.add_variant_callback(_on_variant_change)


def attach() -> None:
    """Follow the variant from now on, and catch up with one that is active already. Raises nothing but an
    interrupt, see `sync`.
    """
    attach_callback()
    if active_variant() is not None:
        _on_variant_change(None, active_variant())


@contextlib.contextmanager
def plugin_errors() -> Iterator[None]:
    """Raise the typed error of a plugin's constructor, or the interrupt that ended it, instead of the RuntimeError
    that Mitsuba turns either into.

    Use it around `mi.load_dict` and `mi.load_file`.
    """
    # No lock is held: an interrupt on the way into a block that holds one would leave it locked. Loads of other threads
    # may add theirs: Mitsuba's text contains the message of this one's.
    errors: list[BaseException] = []
    try:
        _state.listeners.append(errors)
        yield
    except RuntimeError as error:
        own = [one for one in errors if str(one) in str(error)]
        if own and not isinstance(error, TorchTransientError):
            raise own[0] from error
        raise
    finally:
        _state.listeners[:] = [other for other in _state.listeners if other is not errors]


def _on_variant_change(_old: str | None, new: str | None) -> None:
    _check_nothing_was_raised()
    with _state.changes:
        try:
            if new is not None and new != _state.variant:
                # Python's own import keeps its lock for ever where an interrupt comes as it lets go: other threads
                # would wait at their next change of the variant.
                with interrupts_wait():
                    _load_all(new)
        except PluginRegistrationError as error:
            # Under "-W error" the warning itself raises; sync() reports the same problem at the next library call.
            with contextlib.suppress(RuntimeWarning):
                warnings.warn(f"torchtransient: {error}", RuntimeWarning, stacklevel=2)
        except BaseException:
            # An interrupt: the callbacks of others, Mitsuba's own plugins among them, are not called any more.
            _state.interrupted = True
            raise


def _check_nothing_was_raised() -> None:
    """Mitsuba (3.9) goes on with its callbacks when one was interrupted, and calls them with the exception still set.
    The results of C functions are then taken for errors: a lock, once taken, would never be let go of. Raises the
    exception that was set; taking a lock that nobody else has brings it out.
    """
    try:
        with threading.RLock():
            pass
    except SystemError as error:
        _state.interrupted = True
        raise error.__cause__ or error.__context__ or error from None


def _tell_all(variant: str) -> None:
    """Change the variant to and fro, so that all callbacks are called that an interrupt has cut off."""
    _state.interrupted = False
    mi.set_variant(next(name for name in mi.variants() if name != variant and name.startswith("scalar")))
    mi.set_variant(variant)


def _load_all(variant: str) -> None:
    """Register all plugins for `variant`. Modules of the library that are not loaded yet wait for their first use; all
    others are executed. Leaves `_state.variant` None when one fails, so that sync() tries again.
    """
    _state.variant = None
    with _state.tables:
        _state.constructors.clear()
        _state.owner.clear()
        _state.waiting.clear()
    for entry in (*PLUGIN_MODULES, *_state.third_party):
        if not _is_jit(variant):
            for key in entry.plugins:
                _add(key, entry.module, _refusal(*key))
        elif entry.module in _OWN_MODULES and entry.module not in sys.modules:
            for key in entry.plugins:
                _add(key, entry.module, _first_use(entry.module, key))
                _state.waiting.add(key)
        else:
            _execute(entry, variant)
    _state.variant = variant


def _execute(entry: PluginModule, variant: str) -> None:
    """Execute a module for `variant`, again if it is loaded."""
    before = getattr(_state.loading, "module", None)
    _state.loading.module = entry.module
    try:
        loaded = sys.modules.get(entry.module)
        if loaded is None:
            importlib.import_module(entry.module)
        else:
            importlib.reload(loaded)
    except Exception as error:
        raise _not_executed(entry.module, variant, error) from error
    finally:
        _state.loading.module = before
    missing = [f"{kind} '{name}'" for kind, name in entry.plugins if (kind, name) not in _state.constructors]
    if missing:
        raise PluginRegistrationError(
            f"plugin module {entry.module} was expected to register {', '.join(missing)} for variant '{variant}' and "
            "did not. End the module with register(kind, name, class)."
        )


def _not_executed(module: str, variant: str | None, error: Exception) -> PluginRegistrationError:
    """Return the error under which all that a module raises is reported."""
    return PluginRegistrationError(
        f"plugin module {module} could not be executed for variant '{variant}': {type(error).__name__}: {error}"
    )


def _add(key: tuple[str, str], module: str, constructor: Callable[..., object]) -> None:
    """Register a plugin in Mitsuba under the name of the module that it belongs to."""
    with _state.tables:
        _state.owner[key] = module
        _state.constructors[key] = _keeping_errors(constructor)
        _hand_to_mitsuba(key)


def _hand_to_mitsuba(key: tuple[str, str]) -> None:
    kind, name = key
    getattr(mi, f"register_{kind}")(name, _state.constructors[key])


def _first_use(module: str, key: tuple[str, str]) -> Callable[[object], object]:
    """Return a constructor that imports a module of the library, and goes on with the one that it registers."""

    def construct(props: object) -> object:
        try:
            with interrupts_wait():
                importlib.import_module(module)
        except Exception as error:
            raise _not_executed(module, active_variant(), error) from error
        made = _state.constructors.get(key)
        if made is None or key in _state.waiting:
            raise PluginRegistrationError(
                f"plugin module {module} was expected to register {key[0]} '{key[1]}' for variant "
                f"'{active_variant()}' and did not."
            )
        return made(props)

    return construct


def _refusal(kind: str, name: str) -> Callable[[object], object]:
    def refuse(_props: object) -> object:
        _require_jit_variant(f"{kind} plugin '{name}'")
        raise PluginRegistrationError(
            f"{kind} plugin '{name}' was set up for a scalar variant but is used in '{active_variant()}'. "
            "Call torchtransient.plugins.sync() before the scene is loaded."
        )

    return refuse


def _keeping_errors(constructor: Callable[..., object]) -> Callable[[object], object]:
    def construct(props: object) -> object:
        try:
            return constructor(props)
        except BaseException as error:
            # Whoever keeps the error would keep the half-made plugin alive: Dr.Jit's registry would hand it to every
            # later virtual call of the variant.
            traceback.clear_frames(error.__traceback__)
            if isinstance(error, TorchTransientError) or not isinstance(error, Exception):
                for errors in _state.listeners:
                    errors.append(error)
            raise

    return construct
