"""Numbers out of their range are found wherever they stand: in textures of textures, attributes and shared media."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from tools.small_room import VARIANT, make_room
from torchtransient.errors import PhysicsError

NESTED = {"type": "checkerboard", "color0": {"type": "checkerboard", "color1": {"type": "ref", "id": "shared"}}}


def bitmap(number):
    return {"type": "bitmap", "raw": True, "data": np.full((2, 2, 1), number, np.float32)}


def painted(reflectance, **more):
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}, **more}


def of_an_attribute(number, scale=1.0):
    attribute = {"type": "mesh_attribute", "name": "vertex_share", "scale": scale}
    return {"plate": painted(attribute, vertex_share=bitmap(number))}


def in_a_shared_medium(number):
    cells = {"type": "gridvolume", "raw": True, "data": np.full((2, 2, 2, 1), number, np.float32)}
    air = {"type": "heterogeneous", "albedo": {"type": "ref", "id": "cells"}, "sigma_t": 1.0}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "air"}}
    return {"cells": cells, "air": air, "box": box, "integrator": {"type": "transient_prbvolpath", "max_depth": 3}}


# (objects with a number, the largest one in its range)
SUPPLIERS = {
    "texture in textures": (lambda x: {"shared": bitmap(x), "plate": painted(NESTED)}, 1),
    "texture of a shape": (of_an_attribute, 1),
    "scaled attribute": (lambda x: of_an_attribute(x, 1 / 255), 255),
    "albedo of a shared medium": (in_a_shared_medium, 1),
}


@pytest.mark.parametrize("case", SUPPLIERS)
def test_ranges_follow_what_supplies_a_number(case):
    make, most = SUPPLIERS[case]

    def load(number):
        return tt.TransientRenderer(tt.load(make_room() | make(number), variant=VARIANT), spp=1, physics="error")

    load(0.9 * most)
    for number in (1.5 * most, -0.5 * most):
        with pytest.raises(PhysicsError, match="share of the light and reaches"):
            load(number)
