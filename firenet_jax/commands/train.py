"""Simulated sequences, or files of them -> weights: `firenet train`, which is `training.run`."""

from firenet_jax.training.run import run
from firenet_jax.training.settings import Train

__all__ = ["Train", "run"]
