"""Table 1 of the paper: parameters and memory of E2VID and FireNet.

Question: are the two networks the paper's? Parameters are counted in the networks as they are
built here, batch normalisation folded; memory is 4 bytes for each of them, as in the paper.
Expected: 10,700k and 38k, 43 MB and 0.16 MB (which is the size of the file: 0.15 MB are
parameters). Beside it what the networks remember between two windows, which the paper leaves out.

    python experiments/table1_model_size.py            seconds
"""

import argparse
import tempfile
from pathlib import Path

import jax
from harness import save

from firenet_jax import network
from firenet_jax.checkpoint import save_weights
from firenet_jax.evaluation.baselines import e2vid

PAPER = {
    "E2VID": {"parameters": 10_700_000, "memory_mb": 43},
    "FireNet": {"parameters": 38_000, "memory_mb": 0.16},
}
HEIGHT, WIDTH = 180, 240


def size(make_params, make_state) -> dict:
    """Counted from shapes alone: nothing is computed."""
    leaves = jax.tree.leaves(jax.eval_shape(make_params, jax.random.key(0)))
    kept = jax.tree.leaves(jax.eval_shape(lambda: make_state(1, HEIGHT, WIDTH)))
    parameters = sum(leaf.size for leaf in leaves)
    return {
        "parameters": parameters,
        "memory_mb": 4e-6 * parameters,
        "state_mb": 4e-6 * sum(leaf.size for leaf in kept),
        "largest_kernel": max(leaf.shape[0] for leaf in leaves if len(leaf.shape) == 4),
    }


def file_mb() -> float:
    """FireNet's weights as `firenet train` writes them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "firenet.npz"
        save_weights(path, network.Weights(network.initial_params(jax.random.key(0)), True))
        return 1e-6 * path.stat().st_size


def main():
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rows = {
        "E2VID": size(e2vid.initial_params, e2vid.initial_state),
        "FireNet": size(network.initial_params, network.initial_state),
    }
    rows["FireNet"]["file_mb"] = file_mb()
    print(f"{'':10} {'parameters':>12} {'paper':>12} {'MB':>8} {'paper':>6} {'kernel':>7} "
          f"{'state MB at ' + f'{WIDTH}x{HEIGHT}':>22}")  # fmt: skip
    for name, row in rows.items():
        paper, side = PAPER[name], row["largest_kernel"]
        print(f"{name:10} {row['parameters']:12,} {paper['parameters']:12,} "
              f"{row['memory_mb']:8.3f} {paper['memory_mb']:6} {f'{side}x{side}':>7} "
              f"{row['state_mb']:22.2f}")  # fmt: skip
    print(f"FireNet's file: {rows['FireNet']['file_mb']:.3f} MB")
    save("table1_model_size", {"measured": rows, "paper": PAPER})


if __name__ == "__main__":
    main()
