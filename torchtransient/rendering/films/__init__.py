"""What a film measures, as objects: ``film=`` of a renderer and of ``tt.plan``."""

from torchtransient.rendering.films.gates import Gates as Gates
from torchtransient.rendering.films.histogram import Histogram as Histogram
from torchtransient.rendering.films.phasors import Phasors as Phasors
