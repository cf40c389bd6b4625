"""Plugin modules of others, as they travel to the processes that render."""

from __future__ import annotations

from collections.abc import Sequence

from torchtransient.checks import several
from torchtransient.errors import PluginRegistrationError, SceneError

# A module's name, and the plugins that it said to have.
PluginNames = tuple[tuple[str, tuple[tuple[str, str], ...]], ...]


def plugins_here() -> PluginNames:
    """What was added with ``plugins.register_module`` in this process."""
    from torchtransient.plugins import modules_of_others

    return tuple((entry.module, entry.plugins) for entry in modules_of_others())


def add_plugins(modules: PluginNames, what: str) -> None:
    """Add them in this process too. Raises PluginRegistrationError for what cannot be imported here."""
    from torchtransient.plugins import register_module

    for module, plugins in modules:
        try:
            register_module(module, plugins)
        except PluginRegistrationError as error:
            raise PluginRegistrationError(
                f"{what}: the process that renders cannot use the plugin module {module!r}: {error} It has to be found "
                "by import there: install it, or add its folder to PYTHONPATH (of a cluster: on every machine)."
            ) from error


def check_plugins(modules: Sequence[str]) -> tuple[str, ...]:
    """Names of modules, which are added in this process. Raises SceneError, PluginRegistrationError."""
    from torchtransient.plugins import register_module

    found = tuple(several("recipe: plugins", modules, "names of modules in a list", str, SceneError))
    for module in found:
        register_module(module)
    return found
