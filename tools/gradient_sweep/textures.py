"""The textures and spectra of the sweep, and the slots that they go into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tools.gradient_sweep.bsdfs import METAL, normals, picture, rgb
from tools.gradient_sweep.stages import Description, matte, move, stretch

Number = Callable[[float, float, int], Description]


def _volume(low: float, high: float, channels: int) -> Description:
    """A volume as a texture of the plate, whose world position it takes."""
    data = np.random.default_rng(9).uniform(low, high, (4, 4, 4, channels)).astype(np.float32)
    pose = move(-2.0, -2.0, -2.0) @ stretch(4.0)
    return {"type": "volume", "volume": {"type": "gridvolume", "data": data, "raw": True, "to_world": pose}}


def _spectrum(plugin: str, low: float, high: float) -> Description:
    values = f"{low}, {high}, {(low + high) / 2}"
    if plugin == "irregular":
        return {"type": "irregular", "wavelengths": "380, 550, 760", "values": values}
    return {"type": "regular", "wavelength_min": 380.0, "wavelength_max": 760.0, "values": values}


def textures() -> dict[str, Number]:
    """Textures with values between two bounds: a function of those and of the number of channels."""
    return {
        "bitmap": lambda low, high, channels: picture(channels, low, high),
        "bitmap (nearest)": lambda low, high, channels: picture(channels, low, high) | {"filter_type": "nearest"},
        "checkerboard": lambda low, high, _: {
            "type": "checkerboard", "color0": high, "color1": low, "to_uv": np.diag([4.0, 4.0, 1.0]),
        },
        "volume": _volume,
        "mesh_attribute": lambda low, high, channels: {
            "type": "mesh_attribute", "name": "vertex_color" if channels == 3 else "vertex_share",
        },
        "rawconstant": lambda low, high, _: {"type": "rawconstant", "value": (low + high) / 2},
        "uniform": lambda low, high, _: {"type": "uniform", "value": (low + high) / 2},
    }  # fmt: skip


def spectra() -> dict[str, Number]:
    """Spectra that vary with the wavelength."""
    return {
        "rgb": lambda low, high, _: rgb(low, (low + high) / 2, high),
        "regular": lambda low, high, _: _spectrum("regular", low, high),
        "irregular": lambda low, high, _: _spectrum("irregular", low, high),
        "d65": lambda low, high, _: {"type": "d65", "scale": (low + high) / 2},
        "blackbody": lambda *_: {"type": "blackbody", "temperature": 5000.0},
    }


@dataclass(frozen=True)
class Slot:
    """A place for a texture in a surface: the surface around it, its name there, bounds of its values, how many
    channels it takes. ``sloping``: it asks for their slope.
    """

    make: Callable[[Description], Description]
    key: str
    low: float = 0.3
    high: float = 0.7
    channels: int = 3
    sloping: bool = False

    def takes(self, texture: str) -> bool:
        """True if a texture matters there. Of Mitsuba's, others have no slope, or none that is not zero."""
        return not self.sloping or texture == "bitmap"


def slots() -> dict[str, Slot]:
    """Every kind of slot that surfaces have for numbers and colours."""
    rough = {"type": "roughconductor", **METAL, "alpha": 0.3}
    mirror = {"type": "conductor", **METAL}
    glass = {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}
    principled = {"type": "principled", "specular": 0.6}
    return {
        "reflectance": Slot(lambda t: {"type": "diffuse", "reflectance": t}, "reflectance"),
        "reflectance of a mirror": Slot(lambda t: mirror | {"specular_reflectance": t}, "specular_reflectance"),
        "transmittance of glass": Slot(lambda t: glass | {"specular_transmittance": t}, "specular_transmittance"),
        "complex index": Slot(lambda t: mirror | {"k": t}, "k", 1.5, 2.5),
        "roughness": Slot(lambda t: rough | {"alpha": t}, "alpha", 0.2, 0.4, 1),
        "base colour": Slot(lambda t: principled | {"base_color": t}, "base_color"),
        "metallic": Slot(lambda t: principled | {"metallic": t}, "metallic", channels=1),
        "opacity": Slot(lambda t: {"type": "mask", "opacity": t, "nested": matte()}, "opacity", channels=1),
        "opacity of a mirror": Slot(lambda t: {"type": "mask", "opacity": t, "nested": mirror}, "opacity", channels=1),
        "weight": Slot(lambda t: {"type": "blendbsdf", "weight": t, "a": matte(), "b": rough}, "weight", channels=1),
        "weight of a mirror": Slot(
            lambda t: {"type": "blendbsdf", "weight": t, "a": matte(), "b": mirror}, "weight", channels=1
        ),
        # Steeper for paint, which hardly notices how it leans.
        "heights": Slot(
            lambda t: {"type": "bumpmap", "t": t, "scale": 4.0, "nested": matte()}, "nested_texture", 0.0, 1.0, 1, True
        ),
        "heights of a mirror": Slot(
            lambda t: {"type": "bumpmap", "t": t, "nested": mirror}, "nested_texture", 0.0, 1.0, 1, True
        ),
    }


def maps_of_normals() -> dict[str, Callable[[Description], Description]]:
    """Surfaces that a normal map turns."""
    nested = {"diffuse": matte(), "mirror": {"type": "conductor", **METAL}, "rough metal": {
        "type": "roughconductor", **METAL, "alpha": 0.3,
    }}  # fmt: skip
    return {
        name: lambda t, inner=inner: {"type": "normalmap", "normalmap": t, "nested": inner}
        for name, inner in nested.items()
    }


def normal_textures() -> dict[str, Description]:
    volume = _volume(0.4, 0.6, 3)
    volume["volume"]["data"][..., 2] = 0.97
    return {"bitmap": normals(), "volume": volume}
