"""Around the corner: scans of a relay wall, and captures of what cannot be seen from where laser and sensor stand."""

from torchtransient.capture import Capture as Capture
from torchtransient.capture import Scan as Scan
from torchtransient.capture import Wall as Wall
from torchtransient.nlos.renderer import CaptureRenderer as CaptureRenderer
from torchtransient.nlos.scene import capture_scene as capture_scene
from torchtransient.nlos.simulation import simulate as simulate
