"""Every scene of the sweep, and which of its parameters are to be looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from torchtransient.testing.gradient_sweep.bsdfs import HOLDERS, surfaces
from torchtransient.testing.gradient_sweep.stages import Description, between_lights, in_a_group

RGB, SPECTRAL, POLARIZED = "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized"


@dataclass(frozen=True)
class Setting:
    """A scene of the sweep: the plugin that it is for, what that one is inside of, and the parameters to look at, by
    the beginnings of their keys. ``make`` takes a folder for the files that a scene reads.
    """

    kind: str
    plugin: str
    inside: str
    make: Callable[[Path], Description]
    keys: tuple[str, ...]
    variant: str = RGB

    @property
    def name(self) -> str:
        words = f"{self.kind} {self.plugin}" + (f" in {self.inside}" if self.inside else "")
        return words if self.variant == RGB else f"{words}, {self.variant.removeprefix('llvm_ad_')}"

    def takes(self, key: str) -> bool:
        """Whether a parameter is to be looked at."""
        return key.startswith(self.keys)


def bsdf_settings() -> Iterator[Setting]:
    """Surfaces, bare and in others."""
    plate = ("plate.",)
    for name, surface in surfaces().items():
        for variant in (RGB, POLARIZED) if surface.polarizes else (RGB,):
            yield Setting("bsdf", name, "", lambda _, s=surface: between_lights(s.make()), plate, variant)
        for holder, wrap in HOLDERS.items():
            if surface.outermost or (holder == "twosided" and surface.transmits):
                continue
            yield Setting("bsdf", name, holder, lambda _, s=surface, w=wrap: between_lights(w(s.make())), plate)
        yield Setting("bsdf", name, "instance", lambda _, s=surface: in_a_group(s.make()), ("group.", "copy."))


def all_settings() -> list[Setting]:
    """The whole sweep."""
    return [*bsdf_settings()]
