"""Which BSDFs of a scene refract without being a delta function, and by which relative index.

Next-event estimation through a rough interface needs the index of the medium that the connection runs in, which is
not the one that the path arrived in. Mitsuba's ``BSDF.eval`` does not tell it, so it is looked up here by the
BSDF's number in Dr.Jit's registry.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError

# Transmits with a non-symmetric lobe, but the two sides of a fibre are the same medium.
_NOT_AN_INTERFACE = ("Hair",)


class RefractionTable:
    """Relative indices of the BSDFs of one scene, read when the table is made and by ``refresh``.

    Covers every BSDF with a glossy non-symmetric transmission lobe: ``diff_rough_dielectric``, ``roughdielectric``,
    ``principled`` with ``spec_trans`` and plugins of others that expose ``eta``, also inside ``mask``,
    ``blendbsdf``, ``normalmap``, ``bumpmap`` and in shape groups. Attached where the plugin's ``eta`` (``specular``
    for ``principled``) is. Delta lobes are left out: nothing connects through them, and ``sample`` returns their
    index.

    Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.
    """

    def __init__(self, size: int, entries: list[tuple[int, Any]]) -> None:
        self.size = size
        self.entries = entries
        self.refresh()

    @staticmethod
    def of(scene: Any, bsdfs: list[Any] | None = None) -> RefractionTable | None:
        """The table of ``scene``, or None when nothing in it refracts through a lobe that can be connected to.

        ``bsdfs``: those of the scene where they are known already.
        Raises SceneError for a blend of two refractive BSDFs with different indices, where a connection has no single
        optical length, and for a refractive plugin that does not expose ``eta``.
        """
        size, entries = 1, []
        for bsdf in bsdfs if bsdfs is not None else bsdfs_of_scene(scene):
            number = int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])
            size = max(size, number + 1)
            leaf = _refractive_leaf(bsdf)
            if leaf is not None:
                entries.append((number, leaf))
        return RefractionTable(size, entries) if entries else None

    def refresh(self) -> None:
        """Read the indices; outside of loops."""
        with dr.resume_grad():
            table = dr.ones(mi.Float, self.size)
            for number, leaf in self.entries:
                dr.scatter(table, _index_of(leaf), mi.UInt32(number))
        self.table = table

    def relative_index(self, bsdf: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Index of the medium on ``wo``'s side over that on ``si.wi``'s side: 1 where both are on the same side.

        ``bsdf``: array of BSDF pointers; ``wo``: direction in the local frame of ``si``.
        """
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        crosses = active & (si.wi.z * wo.z < 0) & (number < self.size)
        eta = dr.select(crosses, dr.gather(mi.Float, self.table, number, crosses), 1.0)
        return dr.select(si.wi.z > 0, eta, dr.rcp(eta))


def bsdfs_of_scene(scene: Any) -> list[Any]:
    """The outermost BSDFs of a scene, those of shape groups included, each once."""
    shapes = scene.shapes()
    if any(shape.class_name() == "Instance" for shape in shapes):
        # Shapes of groups are not among the scene's own. Walking the whole scene finds them, at a price per parameter.
        return bsdfs_below(scene)
    found = {bsdf.ptr: bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}
    return list(found.values())


def bsdfs_below(node: Any) -> list[Any]:
    """The outermost BSDFs below a scene, shape or BSDF, those of shape groups included, each once and in order."""
    found: dict[int, Any] = {}
    visited: set[int] = set()

    class Callback(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if not isinstance(value, mi.Object) or value.ptr in visited:
                return
            visited.add(value.ptr)
            if isinstance(value, mi.BSDF):
                found[value.ptr] = value
            else:
                value.traverse(Callback())  # a callback cannot be entered twice

        put_object = put
        put_value = put

    node.traverse(Callback())
    return list(found.values())


def _refractive_leaf(bsdf: Any) -> Any | None:
    """The BSDF inside ``bsdf``, or itself, that holds the index of refraction; None if it does not refract."""
    if not _has_refraction_lobe(bsdf):
        return None
    leaves: list[Any] = []
    pending = [bsdf]
    while pending:
        node = pending.pop()
        nested = bsdfs_below(node)
        if nested:
            pending.extend(child for child in nested if _has_refraction_lobe(child))
        elif node.class_name() not in _NOT_AN_INTERFACE:
            leaves.append(node)
    indices = {round(float(dr.slice(dr.detach(_index_of(leaf)), 0)), 6) for leaf in leaves}
    if len(indices) > 1:
        raise SceneError(
            f"BSDF '{bsdf.id()}': one relative index of refraction per surface is expected, its parts have "
            f"{', '.join(map(str, sorted(indices)))}. Give the parts the same index, or use separate surfaces."
        )
    return leaves[0] if leaves else None


def _has_refraction_lobe(bsdf: Any) -> bool:
    wanted = (mi.BSDFFlags.GlossyTransmission, mi.BSDFFlags.NonSymmetric)
    components = (bsdf.flags(i) for i in range(bsdf.component_count()))
    return any(all(mi.has_flag(flags, flag) for flag in wanted) for flags in components)


def _index_of(leaf: Any) -> Any:
    """Inside over outside index of a BSDF without nested ones, attached if its parameter is."""
    params = mi.traverse(leaf)
    if "eta" in params:
        return mi.Float(params["eta"])
    if "specular" in params:
        # Burley 2015, Extending the Disney BRDF: reflectance 0.08 * specular at normal incidence.
        return 2 / (1 - dr.sqrt(0.08 * mi.Float(params["specular"]))) - 1
    raise SceneError(
        f"BSDF '{leaf.id()}' ({leaf.class_name()}) has a refractive lobe but no parameter 'eta'. The optical "
        "length behind it cannot be known: expose the relative index as 'eta' in the plugin's traverse()."
    )
