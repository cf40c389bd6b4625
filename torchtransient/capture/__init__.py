"""Captures around a corner: points of a relay wall that are lit and seen (`Scan`), the surface that they lie on
(`Wall`), and the light that was measured there (`Capture`). Plain tensors and numbers; captures are simulated in
`nlos`.
"""

from torchtransient.capture.capture import Capture as Capture
from torchtransient.capture.scan import Scan as Scan
from torchtransient.capture.wall import Wall as Wall
