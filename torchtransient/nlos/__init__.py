"""Around the corner: `tt.nlos`."""

from torchtransient.capture import Capture as Capture
from torchtransient.capture import Scan as Scan
from torchtransient.capture import Wall as Wall
