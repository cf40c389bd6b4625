"""Table of the rough refractive BSDFs of a scene and their relative indices.

Next-event estimation through a rough interface needs the index of the medium that the connection runs in, which is
not the one that the path arrived in. Mitsuba's ``BSDF.eval`` does not tell it, so it is looked up here by the
BSDF's number in Dr.Jit's registry.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import has_equal_sides
from torchtransient.plugins.node_walk import bsdfs_below as bsdfs_below
from torchtransient.plugins.node_walk import bsdfs_of_scene as bsdfs_of_scene
from torchtransient.plugins.parameter_effect import class_of


class RefractiveBSDFs:
    """The BSDFs of one scene that refract without being a delta function, each with the object that holds its index.

    Covers every BSDF with a glossy non-symmetric transmission lobe: ``diff_rough_dielectric``, ``roughdielectric``,
    ``principled`` with ``spec_trans`` and plugins of others that expose ``eta``, also inside ``mask``,
    ``blendbsdf``, ``normalmap``, ``bumpmap`` and in shape groups. Attached where the plugin's ``eta`` (``specular``
    for ``principled``) is. Delta lobes are left out: nothing connects through them, and ``sample`` returns their
    index.

    Args:
        entries: pairs of a BSDF and its parts that hold an index.
    """

    def __init__(self, entries: list[tuple[Any, list[Any]]]) -> None:
        self._entries = entries
        self._check()

    @staticmethod
    def from_scene(scene: Any, bsdfs: list[Any] | None = None) -> RefractiveBSDFs | None:
        """Return the refractive surfaces of a scene, None if no refractive lobe can be connected to.

        Args:
            scene: Mitsuba scene.
            bsdfs: its outermost BSDFs, where they are known already.

        Raises:
            SceneError: for a BSDF of which two parts have different indices, where a connection has no single optical
                length, and for a refractive plugin that does not expose ``eta``. A path sees one part of the blends of
                a scene (:mod:`.mixtures`); a plugin of others may hold several.
        """
        found = bsdfs if bsdfs is not None else bsdfs_of_scene(scene)
        leaves = ((bsdf, _refractive_leaves(bsdf, (mi.BSDFFlags.GlossyTransmission,))) for bsdf in found)
        entries = [(bsdf, parts) for bsdf, parts in leaves if parts]
        return RefractiveBSDFs(entries) if entries else None

    def read(self) -> RefractionTable:
        """Read the current indices; call outside of loops, once a job. Raises as :meth:`from_scene` where values
        were installed since; a call that is recorded cannot look at numbers.
        """
        if not dr.flag(dr.JitFlag.FreezingScope):
            self._check()
        with dr.resume_grad():
            indices = [index_of(parts[0]) for _, parts in self._entries]
            return RefractionTable(PointerTable([bsdf for bsdf, _ in self._entries], indices, default=1))

    def _check(self) -> None:
        for bsdf, parts in self._entries:
            indices = {_number(part) for part in parts} if len(parts) > 1 else set()
            if len(indices) > 1:
                raise SceneError(
                    f"BSDF '{bsdf.id()}': one relative index of refraction per surface is expected, its parts have "
                    f"{', '.join(map(str, sorted(indices)))}. Give the parts the same index, or use separate surfaces."
                )


class RefractionTable:
    """Relative indices of BSDFs.

    Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.
    """

    def __init__(self, indices: PointerTable) -> None:
        self._indices = indices

    @property
    def table(self) -> Any:
        """The indices as one array, attached where a plugin's is."""
        return self._indices.values

    def relative_index(self, bsdf: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the index of the medium on ``wo``'s side over that on ``si.wi``'s side, 1 where both are on one side.

        Args:
            bsdf: array of BSDF pointers.
            si: SurfaceInteraction3f.
            wo: direction in the local frame of ``si``.
            active: mask of lanes.
        """
        eta = self._indices.look_up(bsdf, active & (si.wi.z * wo.z < 0))
        return dr.select(si.wi.z > 0, eta, dr.rcp(eta))


def boundaries_of(bsdfs: list[Any]) -> list[tuple[Any, Any]]:
    """Return (BSDF, object that holds its relative index) of those that light enters another medium through.

    By a smooth or a rough lobe. Of parts with different indices, the first counts: see :class:`..sensors.surroundings`.

    Args:
        bsdfs: BSDFs of a scene.
    """
    lobes = (mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.GlossyTransmission)
    leaves = ((bsdf, _refractive_leaves(bsdf, lobes)) for bsdf in bsdfs)
    return [(bsdf, parts[0]) for bsdf, parts in leaves if parts]


def _refractive_leaves(bsdf: Any, lobes: tuple[Any, ...]) -> list[Any]:
    """The BSDFs inside ``bsdf``, or itself, that hold an index of refraction; none if it does not refract through one
    of the kinds of ``lobes``.
    """
    leaves: list[Any] = []
    pending = [bsdf]
    while pending:
        node = pending.pop()
        nested = bsdfs_below(node)
        if nested:
            # What holds others does not notice when they get another lobe.
            pending.extend(nested)
        elif _has_refraction_lobe(node, lobes) and not has_equal_sides(node):
            leaves.append(node)
    return leaves


def _number(part: Any) -> float:
    return round(float(dr.slice(dr.detach(index_of(part)), 0)), 6)


def _has_refraction_lobe(bsdf: Any, lobes: tuple[Any, ...]) -> bool:
    components = [bsdf.flags(i) for i in range(bsdf.component_count())]
    both_ways = [flags for flags in components if mi.has_flag(flags, mi.BSDFFlags.NonSymmetric)]
    return any(mi.has_flag(flags, lobe) for flags in both_ways for lobe in lobes)


def index_of(leaf: Any) -> Any:
    """Return the inside over outside index of a BSDF without nested ones, attached if its parameter is.

    Args:
        leaf: one ``mi.BSDF`` with a lobe of refraction.

    Raises:
        SceneError: for a plugin that shows neither ``eta`` nor ``specular``.
    """
    params = mi.traverse(leaf)
    if "eta" in params:
        return mi.Float(params["eta"])
    if "specular" in params:
        # Burley 2015, Extending the Disney BRDF: reflectance 0.08 * specular at normal incidence.
        return 2 / (1 - dr.sqrt(0.08 * mi.Float(params["specular"]))) - 1
    raise SceneError(
        f"BSDF '{leaf.id()}' ({class_of(leaf)}) has a refractive lobe but no parameter 'eta'. The optical "
        "length behind it cannot be known: expose the relative index as 'eta' in the plugin's traverse()."
    )
