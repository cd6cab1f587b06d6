"""The step as machine code and as XLA's -> how far each is from float64, and from each other.

Question: does Winograd's way cost exactness that anyone could see? Random sizes up to 200x200,
batches, states and event tensors; the built-in weights with a random 0.02 added to each. Float64 is
PyTorch's. Differences are of two windows' states and images, relative to the largest number where
that is above 1. Expected: below 1e-5 everywhere, machine code some three times XLA's.

    python experiments/exactness.py                       a minute or two on two cores; needs torch
    FIRENET_NATIVE=avx2 python experiments/exactness.py   as on processors without AVX-512
"""

import argparse
import os

import jax
import jax.numpy as jnp
import numpy as np
import torch
from harness import save
from pytorch_firenet import FireNet

import firenet_jax as fj
from firenet_jax.network import State, Weights
from firenet_jax.reconstruction import reconstruct

WINDOWS = 2
PAIRS = ("machine code, XLA", "machine code, float64", "XLA, float64")


def random_case(seed: int, params):
    """Of weights that expect no normalised tensors: those are normalised in float32, too."""
    rng = np.random.default_rng(seed)
    height, width = np.exp(rng.uniform(0, np.log(201), 2)).astype(int)
    batch = int(rng.integers(1, 6))

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    params = jax.tree.map(lambda x: x + 0.02 * normal(*x.shape), params)
    state = State(*(jnp.tanh(normal(batch, height, width, 16)) for _ in range(2)))
    votes = rng.random((WINDOWS, batch, height, width, 5)) < rng.choice([0.01, 0.3, 1])
    return Weights(params, False), state, normal(*votes.shape) * votes


@torch.inference_mode()
def in_float64(weights: Weights, state: State, tensors) -> list[np.ndarray]:
    """States and images."""
    model, images = FireNet(weights.params).double(), []
    g1, g2 = (torch.from_numpy(np.float64(h)).movedim(-1, 1) for h in state)
    for tensor in torch.from_numpy(np.float64(tensors)).movedim(-1, 2):
        g1, g2, image = model(g1, g2, tensor)
        images.append(image.numpy())
    return [g1.movedim(1, -1).numpy(), g2.movedim(1, -1).numpy(), np.stack(images)]


def difference(found, expected) -> float:
    """The largest of the three arrays."""
    return max(
        float(np.abs(np.float64(a) - np.float64(b)).max() / max(1, np.abs(np.float64(b)).max()))
        for a, b in zip(found, expected, strict=True)
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    options = parser.parse_args()
    params, cases = fj.load_weights().params, []
    for seed in range(options.cases):
        case = random_case(seed, params)
        ours, xla = (jax.tree.leaves(reconstruct(*case, machine_code=way)) for way in (True, False))
        exact = in_float64(*case)
        pairs = zip(PAIRS, ((ours, xla), (ours, exact), (xla, exact)), strict=True)
        differences = {name: difference(*pair) for name, pair in pairs}
        size = [int(n) for n in case[2].shape[1:4]]
        cases.append({"batch, height, width": size, "differences": differences})
        print(seed, size, *(f"{name}: {d:.1e};" for name, d in differences.items()), flush=True)
    worst = {name: max(each["differences"][name] for each in cases) for name in PAIRS}
    print("largest:", *(f"{name}: {d:.1e};" for name, d in worst.items()))
    switch = os.environ.get("FIRENET_NATIVE", "")
    save("exactness" + f"_{switch}" * bool(switch), {"largest": worst, "cases": cases})


if __name__ == "__main__":
    main()
