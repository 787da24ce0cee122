"""How to train: sizes, schedule, and the optimiser that they ask for."""

from dataclasses import dataclass
from typing import Any

import jax
import optax

from ginn_jax.architecture import Network
from ginn_jax.checks import LARGEST_INDEX, LARGEST_SEED, one_of, positive, whole
from ginn_jax.kernels import BIASES


@dataclass(frozen=True)
class Training:
    """How to train.

    `points` of every cloud are taken for a step, and the network is given a share of
    them drawn between `sparsest` and 1; `queries` of those that this and Poisson disk
    sampling leave over carry the loss. Schedule "cosine" is of Muon, warms up and
    decays to zero over `steps`; "paper" is of Adam, times 0.7 every 10 epochs.
    """

    network: Network
    steps: int
    batch_size: int = 2
    points: int = 16384
    queries: int = 4096
    sparsest: float = 1.0
    learning_rate: float = 0.01
    schedule: str = "cosine"
    warm_up: int = 100
    clip_norm: float = 1.0
    epoch_steps: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "points", "queries", "epoch_steps"):
            whole(name, getattr(self, name), 1, LARGEST_INDEX)
        whole("warm_up", self.warm_up, 0, LARGEST_INDEX)
        whole("seed", self.seed, 0, LARGEST_SEED)
        positive("learning_rate", self.learning_rate)
        positive("clip_norm", self.clip_norm)
        positive("sparsest", self.sparsest, 1.0)
        one_of("schedule", self.schedule, ("cosine", "paper"))


def make_optimizer(config: Training) -> optax.GradientTransformation:
    """Muon, or for schedule "paper" Adam, with clipped gradients.

    Muon makes the step of every matrix orthogonal, so that what few clouds ask of a
    layer is learned as fast as what all ask, and leaves the rest to Adam (Jordan 2024;
    in the root mean square of Adam's steps: Liu et al. 2025).
    """
    clip = optax.clip_by_global_norm(config.clip_norm)
    if config.schedule == "paper":
        rate = optax.exponential_decay(
            config.learning_rate, 10 * config.epoch_steps, 0.7, staircase=True
        )
        return optax.chain(clip, optax.adam(rate))
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        config.learning_rate,
        min(config.warm_up, config.steps // 2),
        config.steps,
    )
    muon = optax.contrib.muon(
        rate, consistent_rms=0.2, muon_weight_dimension_numbers=_matrices
    )
    return optax.chain(clip, muon)


def _matrices(params: Any) -> Any:
    """The last two axes of weights that have them, those of kernel blocks too.

    Biases of kernel blocks stand one below the other, but are no matrix.
    """

    def matrix(path: Any, weights: Any) -> Any:
        if jax.tree_util.keystr(path[-1:], simple=True) in BIASES:
            return None
        least = min(weights.shape[-2:], default=0) if weights.ndim > 1 else 0
        axes = optax.contrib.MuonDimensionNumbers(weights.ndim - 2, weights.ndim - 1)
        return axes if least > 1 else None

    return jax.tree.map_with_path(matrix, params)
