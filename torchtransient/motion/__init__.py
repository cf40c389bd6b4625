"""Scenes that move while a camera looks: exposures, rolling shutters, phase steps, videos.

A render of several instants is a batch of poses with one seed; what an exposure makes of them is torch. See
`tt.over_time`.
"""

from torchtransient.motion.over_time import over_time as over_time
from torchtransient.motion.rigid_motion import Motion as Motion
from torchtransient.motion.slow_times import Exposure as Exposure
from torchtransient.motion.slow_times import Frames as Frames
from torchtransient.motion.slow_times import PhaseSteps as PhaseSteps
from torchtransient.motion.slow_times import RollingShutter as RollingShutter
from torchtransient.motion.slow_times import SlowTimes as SlowTimes
