"""Around the corner: scans of a relay wall, and captures of what cannot be seen from where laser and sensor stand."""

from torchtransient.capture import Capture as Capture
from torchtransient.capture import Scan as Scan
from torchtransient.capture import Wall as Wall
from torchtransient.data.capture_file import read_capture as read_capture
from torchtransient.data.capture_file import write_capture as write_capture
from torchtransient.nlos.renderer import CaptureRenderer as CaptureRenderer
from torchtransient.nlos.scene import capture_scene as capture_scene
from torchtransient.nlos.setup_files import read_setup as read_setup
from torchtransient.nlos.simulation import forecast as forecast
from torchtransient.nlos.simulation import simulate as simulate
