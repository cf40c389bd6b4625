"""What a simulation does where nothing else is asked for, from Python and from files."""

from __future__ import annotations

from torchtransient.units import seconds_to_opl

# Samples of each sensor point, or of each pair of an exhaustive scan.
SPP = 4096
# Bins of detectors with a resolution of some tens of picoseconds, as lengths of optical path in metres.
BIN_WIDTH_OPL = seconds_to_opl(16e-12)
# Light around one corner.
BOUNCES = (3,)
# Joules.
ENERGY = 1.0
SEED = 0
# Parts of a simulation with a part file, of which a kill loses one at most. Tiles of exhaustive captures each look at
# all laser spots anew: 16 of them take three times as long as one, 4 a quarter more (256 x 256 pairs).
PARTS, EXHAUSTIVE_PARTS = 16, 4
