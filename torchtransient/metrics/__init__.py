"""Metrics of depth, phase, polarization, histograms, pictures and hidden volumes, and their sums over batches.

Torch only, never Mitsuba. Functions `(input, target)` of tensors or results; `Running` sums one over an epoch.
"""

from torchtransient.metrics.depth import depth_abs_rel as depth_abs_rel
from torchtransient.metrics.depth import depth_bias as depth_bias
from torchtransient.metrics.depth import depth_delta as depth_delta
from torchtransient.metrics.depth import depth_gross_errors as depth_gross_errors
from torchtransient.metrics.depth import depth_mae as depth_mae
from torchtransient.metrics.depth import depth_median_error as depth_median_error
from torchtransient.metrics.depth import depth_rmse as depth_rmse
from torchtransient.metrics.histograms import histogram_kl as histogram_kl
from torchtransient.metrics.histograms import histogram_total_variation as histogram_total_variation
from torchtransient.metrics.histograms import histogram_wasserstein_opl as histogram_wasserstein_opl
from torchtransient.metrics.histograms import histogram_wasserstein_s as histogram_wasserstein_s
from torchtransient.metrics.images import psnr as psnr
from torchtransient.metrics.images import ssim as ssim
from torchtransient.metrics.images import transient_psnr as transient_psnr
from torchtransient.metrics.images import transient_ssim as transient_ssim
from torchtransient.metrics.localization import localization_rmse as localization_rmse
from torchtransient.metrics.phase import phase_bias as phase_bias
from torchtransient.metrics.phase import phase_mae as phase_mae
from torchtransient.metrics.phase import phase_rmse as phase_rmse
from torchtransient.metrics.phase import wrapped_difference as wrapped_difference
from torchtransient.metrics.polarization import aolp_mae as aolp_mae
from torchtransient.metrics.polarization import dop_mae as dop_mae
from torchtransient.metrics.polarization import dop_rmse as dop_rmse
from torchtransient.metrics.tally import Running as Running
from torchtransient.metrics.volumes import front_depth as front_depth
from torchtransient.metrics.volumes import front_depth_mae as front_depth_mae
from torchtransient.metrics.volumes import front_view as front_view
from torchtransient.metrics.volumes import picture_correlation as picture_correlation
from torchtransient.metrics.volumes import picture_iou as picture_iou
from torchtransient.metrics.volumes import volume_correlation as volume_correlation
from torchtransient.metrics.volumes import volume_iou as volume_iou
