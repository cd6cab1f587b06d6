"""Weights -> .pth or .safetensors, under the names of the programs that the network comes from.

Weights for normalised event tensors get FireNet's names, those for raw ones FireNet+'s: so
`firenet convert` knows what such a file expects. Kernels are (out, in, rows, columns) float32,
gates are apart, as PyTorch has them.

A .pth is a checkpoint as rpg_e2vid and EVREAL load it: `arch`, `config` and `state_dict`. What they
need besides of FireNet+'s, an object of their own class, cannot be written from outside; its
`state_dict` can be loaded as it is.
"""

from firenet_jax.checkpoint import original_names
from firenet_jax.events import BINS
from firenet_jax.export import missing
from firenet_jax.network import CHANNELS, Weights
from firenet_jax.storage.pytorch_save import pytorch_file

# As in the published checkpoint, which both programs build the network by.
MODEL = {
    "num_bins": BINS,
    "skip_type": "no_skip",
    "recurrent_block_type": "convgru",
    "base_num_channels": CHANNELS,
    "num_residual_blocks": 2,
    "recurrent_blocks": {"resblock": [0]},
    "kernel_size": 3,
    "final_activation": "none",
    "norm": "none",
    "BN_momentum": 0.01,
}
# As event_cnn_minimal's configuration has it.
ARCH = {
    "type": "FireNet",
    "args": {"num_bins": BINS, "base_num_channels": CHANNELS, "kernel_size": 3},
}


def pth(weights: Weights) -> bytes:
    """Weights -> the bytes of a PyTorch checkpoint, for which PyTorch is not needed."""
    family, tensors = original_names(weights)
    config = {"model": MODEL} if family == "FireNet" else {"arch": ARCH}
    return pytorch_file({"arch": "FireNet", "config": config, "state_dict": tensors})


def safetensors(weights: Weights) -> bytes:
    """Weights -> the bytes of a .safetensors with the same tensors; metadata: architecture, events.

    Raises OutputError where the library safetensors is not installed.
    """
    try:
        from safetensors.numpy import save
    except ImportError:
        raise missing("safetensors") from None
    family, tensors = original_names(weights)
    events = "normalised" if weights.normalise else "raw"
    return save(tensors, {"format": "pt", "architecture": family, "events": events})
