"""Lists of arrivals as a pilot run makes them, from numbers of one's own."""

from types import SimpleNamespace

import numpy as np

from torchtransient.scene.pilot import Arrivals


def arrivals(opl, energy, depth=None, path=None, pixel=None, paths=None, size=(1, 1), rate=None):
    """Events of depth 1 in one pixel, each of a path of its own, unless something else is said."""
    count = len(opl)
    path = np.arange(count) if path is None else np.asarray(path)
    return Arrivals(
        SimpleNamespace(
            opl=np.asarray(opl, float),
            energy=np.asarray(energy, float),
            depth=np.ones(count, int) if depth is None else np.asarray(depth),
            path=path,
            pixel=np.zeros(count, int) if pixel is None else np.asarray(pixel),
            rate=np.zeros(count) if rate is None else np.asarray(rate, float),
            paths=paths or int(path.max()) + 1,
            size=size,
        )
    )
