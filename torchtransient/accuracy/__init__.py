"""Error against time: what a smaller error of a transient, or of a gradient, costs. See `tt.cost_of_accuracy`."""

from torchtransient.accuracy.cost import cosine_over_the_window as cosine_over_the_window
from torchtransient.accuracy.cost import cost_of_accuracy as cost_of_accuracy
from torchtransient.accuracy.gradient_errors import GradientEstimate as GradientEstimate
from torchtransient.accuracy.gradient_errors import gradient_errors as gradient_errors
from torchtransient.accuracy.report import AccuracyReport as AccuracyReport
from torchtransient.accuracy.report import Recommendation as Recommendation
from torchtransient.accuracy.report import SamplesNeeded as SamplesNeeded
from torchtransient.accuracy.statistics import two_sample_z_test as two_sample_z_test
from torchtransient.accuracy.statistics import z_test as z_test
