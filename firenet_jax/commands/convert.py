"""PyTorch checkpoint -> weights.npz."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro

from firenet_jax.checkpoint import BUILT_IN, convert, save_weights
from firenet_jax.errors import CheckpointError, OutputError
from firenet_jax.storage.files import check_no_pipe
from firenet_jax.storage.video import followed


@dataclass(frozen=True)
class Convert:
    """Turn a published PyTorch checkpoint of FireNet or FireNet+ into a small .npz of weights.

    PyTorch is not needed, and nothing that the checkpoint holds is executed.

    Examples:
      firenet convert model.pth -o firenet.npz
    """

    checkpoint: tyro.conf.Positional[Path]
    """The PyTorch file, as its authors publish it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Where the weights go, a name that ends in .npz."""
    overwrite: bool = False
    """Replace an output that exists."""


def run(settings: Convert) -> None:
    if settings.output.exists() and not settings.overwrite:
        raise OutputError(f"{settings.output} exists: choose another output or pass --overwrite")
    given = settings.checkpoint
    if str(given) == BUILT_IN or given.is_dir() or given.suffix == ".npz":
        raise CheckpointError(
            f"{given}: is not a PyTorch checkpoint; weights of this program are used as they are, "
            "and `firenet export` makes .pth, .onnx and others of them"
        )
    check_no_pipe(given, CheckpointError)
    weights = convert(given)
    save_weights(followed(settings.output), weights)
    count = sum(value.size for value in jax.tree.leaves(weights.params))
    tensors = "normalised" if weights.normalise else "raw"
    print(f"{settings.output}: {count:,} parameters, for {tensors} event tensors")
