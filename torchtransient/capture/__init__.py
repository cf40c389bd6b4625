"""Captures around a corner: which points of a relay wall are lit and seen (`Scan`), on which surface they lie (`Wall`),
and what was measured there (`Capture`). Plain tensors and numbers; how captures are simulated stands in `nlos`.
"""

from torchtransient.capture.capture import Capture as Capture
from torchtransient.capture.scan import Scan as Scan
from torchtransient.capture.wall import Wall as Wall
