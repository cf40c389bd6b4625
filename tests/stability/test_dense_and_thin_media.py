"""Hard case: media so dense that their transmittance underflows, so thin that hardly anything collides, black ones, phase
functions that are almost delta functions, and grids of no density at all.
"""

import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "media"))
