"""Losses of transients, phasors, hidden volumes and shapes, and likelihoods that match the noise of the sensors.

Torch only, never Mitsuba. Functions `(input, target)` first, thin modules that hold their options under them.
"""

from torchtransient.losses.cumulative import CumulativeLoss as CumulativeLoss
from torchtransient.losses.cumulative import cumulative_loss as cumulative_loss
from torchtransient.losses.dead_time_likelihoods import FirstPhotonLoss as FirstPhotonLoss
from torchtransient.losses.dead_time_likelihoods import FirstPhotonNLL as FirstPhotonNLL
from torchtransient.losses.dead_time_likelihoods import FreeRunningNLL as FreeRunningNLL
from torchtransient.losses.dead_time_likelihoods import first_photon_loss as first_photon_loss
from torchtransient.losses.dead_time_likelihoods import first_photon_nll as first_photon_nll
from torchtransient.losses.dead_time_likelihoods import free_running_nll as free_running_nll
from torchtransient.losses.depth import DepthLoss as DepthLoss
from torchtransient.losses.depth import depth_loss as depth_loss
from torchtransient.losses.expected_roots import ExpectedRootLoss as ExpectedRootLoss
from torchtransient.losses.expected_roots import expected_anscombe as expected_anscombe
from torchtransient.losses.expected_roots import expected_root_loss as expected_root_loss
from torchtransient.losses.likelihoods import PoissonLoss as PoissonLoss
from torchtransient.losses.likelihoods import PoissonNLL as PoissonNLL
from torchtransient.losses.likelihoods import ReadNoiseNLL as ReadNoiseNLL
from torchtransient.losses.likelihoods import poisson_loss as poisson_loss
from torchtransient.losses.likelihoods import poisson_nll as poisson_nll
from torchtransient.losses.likelihoods import read_noise_nll as read_noise_nll
from torchtransient.losses.likelihoods import relative_floor as relative_floor
from torchtransient.losses.measurement import MeasurementConsistency as MeasurementConsistency
from torchtransient.losses.measurement import PairLoss as PairLoss
from torchtransient.losses.measurement import SquaredLoss as SquaredLoss
from torchtransient.losses.measurement import measurement_consistency as measurement_consistency
from torchtransient.losses.measurement import squared_loss as squared_loss
from torchtransient.losses.noisy_renders import TwoRenderLoss as TwoRenderLoss
from torchtransient.losses.noisy_renders import two_render_loss as two_render_loss
from torchtransient.losses.phasors import PhasorLoss as PhasorLoss
from torchtransient.losses.phasors import TransientPhasorLoss as TransientPhasorLoss
from torchtransient.losses.phasors import phasor_loss as phasor_loss
from torchtransient.losses.phasors import transient_phasor_loss as transient_phasor_loss
from torchtransient.losses.phasors import transient_phasors as transient_phasors
from torchtransient.losses.roots import LogRatioLoss as LogRatioLoss
from torchtransient.losses.roots import RootLoss as RootLoss
from torchtransient.losses.roots import anscombe as anscombe
from torchtransient.losses.roots import log_ratio_loss as log_ratio_loss
from torchtransient.losses.roots import root_loss as root_loss
from torchtransient.losses.similarity import ProjectionSSIMLoss as ProjectionSSIMLoss
from torchtransient.losses.similarity import SSIMLoss as SSIMLoss
from torchtransient.losses.similarity import maximum_projections as maximum_projections
from torchtransient.losses.similarity import projection_ssim_loss as projection_ssim_loss
from torchtransient.losses.similarity import ssim_loss as ssim_loss
from torchtransient.losses.surface_distance import surface_distance as surface_distance
from torchtransient.losses.total_variation import TotalVariation as TotalVariation
from torchtransient.losses.total_variation import total_variation as total_variation
from torchtransient.losses.wasserstein import WassersteinLoss as WassersteinLoss
from torchtransient.losses.wasserstein import wasserstein_loss as wasserstein_loss
