"""Data sets: randomised scenes, generation, storage and reading; and the files of renders and captures."""

from torchtransient.data.recipes.distribution import Distribution as Distribution
from torchtransient.data.recipes.distributions import Choice as Choice
from torchtransient.data.recipes.distributions import LogUniform as LogUniform
from torchtransient.data.recipes.distributions import Normal as Normal
from torchtransient.data.recipes.distributions import Scale as Scale
from torchtransient.data.recipes.distributions import Uniform as Uniform
from torchtransient.data.recipes.poses import Compose as Compose
from torchtransient.data.recipes.poses import LookAt as LookAt
from torchtransient.data.recipes.poses import Offset as Offset
from torchtransient.data.recipes.poses import Turn as Turn
from torchtransient.data.recipes.recipe import Recipe as Recipe
from torchtransient.data.recipes.sample import Sample as Sample
from torchtransient.data.recipes.structures import OneOf as OneOf
