"""Parameters that stay in their physical range: shares between 0 and 1, positive spectra, rigid poses.

Torch only, never Mitsuba. Functions there and back first, under them the modules with `forward` and `right_inverse`
that `torch.nn.utils.parametrize.register_parametrization` takes; `register` is the same by Mitsuba's keys.
"""

from torchtransient.modules import CopiesParametrized as CopiesParametrized
from torchtransient.parametrize.bounded import Albedo as Albedo
from torchtransient.parametrize.bounded import Anisotropy as Anisotropy
from torchtransient.parametrize.bounded import Bounded as Bounded
from torchtransient.parametrize.bounded import IndexOfRefraction as IndexOfRefraction
from torchtransient.parametrize.bounded import Positive as Positive
from torchtransient.parametrize.bounded import PrincipledRoughness as PrincipledRoughness
from torchtransient.parametrize.bounded import Roughness as Roughness
from torchtransient.parametrize.bounded import bounded as bounded
from torchtransient.parametrize.bounded import bounded_inverse as bounded_inverse
from torchtransient.parametrize.bounded import positive as positive
from torchtransient.parametrize.bounded import positive_inverse as positive_inverse
from torchtransient.parametrize.poses import AxisAnglePose as AxisAnglePose
from torchtransient.parametrize.poses import SE3Pose as SE3Pose
from torchtransient.parametrize.poses import axis_angle_from_pose as axis_angle_from_pose
from torchtransient.parametrize.poses import pose_from_axis_angle as pose_from_axis_angle
from torchtransient.parametrize.poses import pose_from_twist as pose_from_twist
from torchtransient.parametrize.poses import twist_from_pose as twist_from_pose
from torchtransient.parametrize.registration import original as original
from torchtransient.parametrize.registration import register as register
from torchtransient.parametrize.registration import remove as remove
from torchtransient.parametrize.simplex import Simplex as Simplex
from torchtransient.parametrize.simplex import simplex as simplex
from torchtransient.parametrize.simplex import simplex_inverse as simplex_inverse
from torchtransient.parametrize.spectra import PositiveSpectrum as PositiveSpectrum
from torchtransient.parametrize.spectra import ReflectanceSpectrum as ReflectanceSpectrum
from torchtransient.parametrize.spectra import spline_basis as spline_basis
