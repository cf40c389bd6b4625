"""Training with the renderer in the loop: seeds, ranks, parts of a batch, order of samples, checkpoints."""

from torchtransient.training.accumulation import accumulate as accumulate
from torchtransient.training.batches import Batches as Batches
from torchtransient.training.batches import Ranks as Ranks
from torchtransient.training.batches import ranks as ranks
from torchtransient.training.batches import worker_init as worker_init
from torchtransient.training.checkpoint import Checkpoint as Checkpoint
from torchtransient.training.checkpoint import load_checkpoint as load_checkpoint
from torchtransient.training.checkpoint import save_checkpoint as save_checkpoint
from torchtransient.training.seeds import Seeds as Seeds
