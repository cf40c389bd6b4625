"""Losses and likelihoods that match the noise of the sensors, and distances of shapes. Torch only, never Mitsuba."""

from torchtransient.losses.likelihoods import FirstPhotonNLL as FirstPhotonNLL
from torchtransient.losses.likelihoods import FreeRunningNLL as FreeRunningNLL
from torchtransient.losses.likelihoods import PoissonNLL as PoissonNLL
from torchtransient.losses.likelihoods import ReadNoiseNLL as ReadNoiseNLL
from torchtransient.losses.likelihoods import first_photon_nll as first_photon_nll
from torchtransient.losses.likelihoods import free_running_nll as free_running_nll
from torchtransient.losses.likelihoods import poisson_nll as poisson_nll
from torchtransient.losses.likelihoods import read_noise_nll as read_noise_nll
from torchtransient.losses.likelihoods import relative_floor as relative_floor
from torchtransient.losses.surface_distance import surface_distance as surface_distance
