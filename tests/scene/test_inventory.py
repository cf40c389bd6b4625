"""Lists of polarizing plugins, compared with their Mueller matrices."""

import drjit as dr
import mitsuba as mi
import numpy as np

from support.sweeps import together
from torchtransient import plugins
from torchtransient.plugins._registry import PLUGIN_MODULES
from torchtransient.scene.inventory import (
    POLARIZING_ELEMENTS,
    POLARIZING_INTERFACES,
    like_mitsuba,
)

VARIANT = "llvm_ad_mono_polarized"
# Every BSDF of Mitsuba 3.9 that stands alone. `hair` needs wavelengths, the measured ones need files.
MITSUBA = (
    "diffuse", "dielectric", "thindielectric", "roughdielectric", "conductor", "roughconductor", "plastic",
    "roughplastic", "pplastic", "principled", "principledthin", "null", "polarizer", "retarder", "circular",
)  # fmt: skip
OURS = tuple(name for module in PLUGIN_MODULES for kind, name in module.plugins if kind == "bsdf")

# What some cannot do without in this variant.
NEEDED = {"delayed": {"lifetime": 0.1, "bsdf": {"type": "diffuse"}}, "diff_hair": {"sigma_a": 0.5}}


def mueller_matrices(bsdf) -> np.ndarray:
    """(N, 4, 4): weights of sampled directions and values at them, over angles of incidence."""
    count = 256
    generator = np.random.default_rng(4)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    angle = np.linspace(0.1, 1.4, count)
    si.t, si.n, si.sh_frame.n = 1.0, mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1)
    si.initialize_sh_frame()
    si.wi = mi.Vector3f(np.sin(angle), 0, np.cos(angle))
    u, v = mi.Float(generator.random(count)), mi.Point2f(generator.random((2, count)))
    sample, weight = bsdf.sample(mi.BSDFContext(), si, u, v)
    value = bsdf.eval(mi.BSDFContext(), si, sample.wo)
    dr.eval(weight, value)  # in one kernel
    found = [
        [[np.broadcast_to(np.array(m[i, j]).ravel(), count) for j in range(4)] for i in range(4)]
        for m in (weight, value)
    ]
    return np.nan_to_num(np.concatenate(np.moveaxis(np.array(found), -1, 1)))


def polarizes(matrices: np.ndarray) -> bool:
    """Return True if some matrix is neither an ideal depolarizer nor a multiple of the identity."""
    depolarizer, identity = np.zeros((4, 4)), np.eye(4)
    depolarizer[0, 0] = 1
    scale = matrices[:, :1, :1]
    errors = [np.abs(matrices - scale * m).max((1, 2)) for m in (depolarizer, identity)]
    return bool((np.minimum(*errors) > 1e-4 * np.abs(matrices).max()).any())


@together("name", [*MITSUBA, *OURS])
def test_what_polarizes_is_listed(name):
    plugins.sync()
    found = polarizes(mueller_matrices(mi.load_dict({"type": name, **NEEDED.get(name, {})})))
    listed = like_mitsuba(name) in (*POLARIZING_ELEMENTS, *POLARIZING_INTERFACES)
    # Mitsuba's rough dielectric depolarizes; polarized renders replace it by one that does not.
    assert listed == (found or name == "roughdielectric")
