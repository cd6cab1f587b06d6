"""How many channels of the last residual block are alive?

    python experiments/dormant.py WEIGHTS...                                            1 minute

WEIGHTS: "built-in", and files of others, a name may be given: ours=PATH. A channel that never
exceeds zero behind a ReLU costs its time and gives nothing; its own kernel has no gradient either,
so that training hardly wakes it. Here: the share of pixels in which each channel is active, over
the last ten of thirty windows of eight simulated sequences, half of them of sensors with faults;
dormant is what is active in less than a thousandth. Prints a table and writes results/dormant.json.
"""

import argparse
import json

import jax
import jax.numpy as jnp
import numpy as np
from endurance import SENSORS, SIZE, textures
from harness import RESULTS, save

import firenet_jax as fj
from firenet_jax.convolution import layer
from firenet_jax.network import Weights, initial_state, step
from firenet_jax.simulation.curricula import sequences
from firenet_jax.tensors import normalise

RARE = 1e-3


def second_maps(weights: Weights, tensors: jax.Array) -> jax.Array:
    """(T, B, H, W, 5) counts -> (T, B, H, W, 16), the second ConvGRU's map after each window."""

    def body(state, tensor):
        state, _ = step(weights.params, state, tensor)
        return state, state.g2

    tensors = normalise(tensors) if weights.normalise else tensors
    return jax.lax.scan(body, initial_state(*tensors.shape[1:4]), tensors)[1]


def last_block(block, g2: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """A residual block's parameters, maps -> its maps between the convolutions, and those after
    them before the last ReLU."""
    first, second = block["conv1"], block["conv2"]
    (between,) = layer([g2], first["kernel"], first["bias"], ("relu",))
    (change,) = layer([between], second["kernel"], second["bias"])
    return np.asarray(between), np.asarray(g2 + change)


def active(maps: np.ndarray) -> np.ndarray:
    """(16,) the share of pixels in which each channel exceeds zero."""
    return (maps > 0).mean(tuple(range(maps.ndim - 1)))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", nargs="+", help="built-in, FILE or NAME=FILE")
    options = parser.parse_args()
    made = [
        sequences(jax.random.key(n), textures(), batch=4, windows=30, sensor=sensor, **SIZE)
        for n, sensor in enumerate(SENSORS.values())
    ]
    tensors = jnp.concatenate([data.tensors for data in made], 1)
    last = RESULTS / "dormant.json"
    rows = json.loads(last.read_text())["rows"] if last.exists() else []
    for each in options.weights:
        name, _, path = each.rpartition("=")
        name = name or path
        weights = fj.load_weights(None if path == "built-in" else path)
        g2 = second_maps(weights, tensors)[-10:].reshape(-1, *SIZE.values(), 16)
        shares = [active(maps) for maps in last_block(weights.params["res2"], g2)]
        counts = [int((share < RARE).sum()) for share in shares]
        row = {"weights": name, "dormant between": counts[0], "dormant after": counts[1]}
        row |= {"active between": shares[0].tolist(), "active after": shares[1].tolist()}
        rows = [other for other in rows if other["weights"] != name] + [row]
        print(f"{name:12} dormant of 16: {counts[0]} between the convolutions, {counts[1]} after")
    save("dormant", {"rows": rows})


if __name__ == "__main__":
    main()
