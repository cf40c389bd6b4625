"""Data sets: randomised scenes, generation, storage and reading; and the files of renders and captures."""

from torchtransient.data.generation.generate import Generated as Generated
from torchtransient.data.generation.generate import generate as generate
from torchtransient.data.reading.online import OnlineDataset as OnlineDataset
from torchtransient.data.reading.recipe_dataset import RecipeDataset as RecipeDataset
from torchtransient.data.reading.stream import TransientStream as TransientStream
from torchtransient.data.reading.transient_dataset import TransientDataset as TransientDataset
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
from torchtransient.data.storage.manifest import build_manifest as build_manifest
from torchtransient.data.storage.manifest import verify as verify
from torchtransient.data.storage.shard_file import Shard as Shard
from torchtransient.data.storage.shard_writing import ShardWriter as ShardWriter
from torchtransient.data.storage.tal_export import export_tal as export_tal
from torchtransient.data.storage.web_dataset import export_web_dataset as export_web_dataset
from torchtransient.data.storage.web_dataset import read_web_dataset as read_web_dataset
