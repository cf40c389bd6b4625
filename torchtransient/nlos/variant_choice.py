"""The cheapest variant in which a capture loses nothing."""

from __future__ import annotations

from dataclasses import dataclass

from torchtransient.scene.inventory import scene_inventory
from torchtransient.scene.load import Scene, load
from torchtransient.scene.plan import text_of
from torchtransient.scene.variant import is_differentiable, resolve_variant


@dataclass(frozen=True)
class VariantChoice:
    """``name``: of the variant; ``why`` it was chosen."""

    name: str
    why: str


def choose_variant(scene: Scene, requested: str | None) -> VariantChoice:
    """``requested``; else the active one where it is polarized; else one channel where every spectrum of a scene is
    grey, on the device of the variant that :func:`tt.load` would take; else that variant, but none of one channel.

    Raises VariantError for a variant that cannot be used, SceneError for a scene that cannot be read.
    """
    import mitsuba as mi

    if requested is not None:
        return VariantChoice(resolve_variant(requested), "as asked for")
    active, name = mi.variant(), resolve_variant(None)
    if name.endswith("_polarized"):
        return VariantChoice(name, "the active one, which is polarized")
    # In the variant that is active, or becomes so: a switch takes time.
    found = scene_inventory(load(scene, variant=name if is_differentiable(active) else f"{name.split('_')[0]}_ad_mono"))
    coloured = [*found.colours, *found.measured, *found.bands]
    if not coloured:
        device = name.split("_")[0]
        return VariantChoice(f"{device}_ad_mono", "every spectrum is grey, so that one channel carries all of it")
    # One channel may have been chosen for the scene before.
    return VariantChoice(name.replace("_mono", "_rgb"), f"colour: {text_of(coloured)}")
