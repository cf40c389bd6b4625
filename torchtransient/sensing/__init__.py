"""After the light: detectors, noise and calibration as differentiable torch modules. Torch only, never Mitsuba."""

from torchtransient.sensing.policies import GRAD_POLICIES as GRAD_POLICIES
from torchtransient.sensing.policies import GradPolicy as GradPolicy
from torchtransient.sensing.policies import ScoreFunction as ScoreFunction
from torchtransient.sensing.policies import straight_through as straight_through
from torchtransient.sensing.sensor import RandomSensor as RandomSensor
from torchtransient.sensing.sensor import Sensor as Sensor
from torchtransient.sensing.shot_noise import ShotNoise as ShotNoise
from torchtransient.sensing.shot_noise import poisson as poisson
from torchtransient.sensing.shot_noise import poisson_log_prob as poisson_log_prob
