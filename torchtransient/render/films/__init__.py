"""What a film measures, as objects: ``film=`` of a renderer and of ``tt.plan``."""

from torchtransient.render.films.gates import Gates as Gates
from torchtransient.render.films.histogram import Histogram as Histogram
from torchtransient.render.films.phasors import Phasors as Phasors
