"""weights -> weights: a training in which no update shifts all that follows.

Maps of FireNet have means far from zero: three channels of what the last block gets are active
everywhere. So an update of a kernel shifts all maps behind it, and at a high rate channels behind a
ReLU die of it, for good (dormant.py). Here gradients and updates are those of y = K (x - m) + b
instead of y = K x + b, where m are the means of a layer's inputs in recent batches (Schraudolph,
"Centering neural network gradient factors", 1998). The network and its parameters are the usual
ones, and rates may be three times as high.

The rate follows the clock, so an interrupted run begins anew. What is kept is a running mean of the
weights, `last.npz`, which is there when it has ended, beside `log.jsonl`. On one core two seconds a
step of four sequences.
"""

import json
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from firenet_jax.checkpoint import save_weights
from firenet_jax.convolution import layer
from firenet_jax.network import State, Weights
from firenet_jax.tensors import normalise
from firenet_jax.training.run import first_state, sources_of
from firenet_jax.training.settings import Train
from firenet_jax.training.step import StepSettings, TrainState, _as_matrices, _simulated, loss_of

LOGGED = 50  # steps between two lines
LONGEST = 0.998  # of the running mean of the weights, per step

# {"gru1": {"gates": leaf, ...}, ...}: one leaf for each convolution, (inputs,) or {kernel, bias}.
Layers = dict[str, dict]


@jax.jit
def input_means(params, tensors: jax.Array, state: State) -> Layers:
    """Event tensors (T, B, H, W, 5), the state before them -> means of each layer's inputs.

    Those of the head count as zero, as event tensors are normalised.
    """

    def of(*maps):
        return jnp.concatenate([each.mean((0, 1, 2)) for each in maps])

    def convolved(part, maps, activations=("relu",)):
        return layer(maps, part["kernel"], part["bias"], activations)

    def gru(parts, h, x):
        r, z = convolved(parts["gates"], [x, h], ("sigmoid", "sigmoid"))
        (candidate,) = convolved(parts["candidate"], [x, r * h], ("tanh",))
        return h + z * (candidate - h), {"gates": of(x, h), "candidate": of(x, r * h)}

    def residual(parts, x):
        (between,) = convolved(parts["conv1"], [x])
        (change,) = convolved(parts["conv2"], [between], ("none",))
        return jax.nn.relu(x + change), {"conv1": of(x), "conv2": of(between)}

    def one_window(states, tensor):
        (head,) = convolved(params["head"], [tensor])
        g1, in_gru1 = gru(params["gru1"], states[0], head)
        first, in_res1 = residual(params["res1"], g1)
        g2, in_gru2 = gru(params["gru2"], states[1], first)
        last, in_res2 = residual(params["res2"], g2)
        means = {"gru1": in_gru1, "res1": in_res1, "gru2": in_gru2, "res2": in_res2}
        ends = {"head": jnp.zeros(tensor.shape[-1]), "prediction": of(last)}
        return (g1, g2), means | ends

    _, means = jax.lax.scan(one_window, tuple(state), normalise(tensors))
    return jax.tree.map(lambda each: each.mean(0), means)


def is_layer(part) -> bool:
    return "kernel" in part


def each_layer(params, change, means: Layers):
    """Parameters, each layer's {kernel, bias} replaced by change(layer, means of its inputs)."""
    return jax.tree.map(change, params, means, is_leaf=is_layer)


def no_means(params) -> Layers:
    """Zeros."""
    return jax.tree.map(lambda part: jnp.zeros(part["kernel"].shape[2]), params, is_leaf=is_layer)


def of_centred(gradient, means: Layers):
    """Gradients by K and b of y = K x + b -> those of y = K (x - m) + b, for equal y."""

    def change(part, m):
        return part | {"kernel": part["kernel"] - jnp.multiply.outer(m, part["bias"])[None, None]}

    return each_layer(gradient, change, means)


def of_usual(updates, means: Layers):
    """Updates of K and b of y = K (x - m) + b -> those of y = K x + b, for equal y."""

    def change(part, m):
        return part | {"bias": part["bias"] - jnp.einsum("i,hwio->o", m, part["kernel"])}

    return each_layer(updates, change, means)


def muon() -> optax.GradientTransformation:
    """With a rate of one: `train_step`'s takes the number of steps, which a clock does not know."""
    own = optax.contrib.muon(
        1.0, consistent_rms=0.2, adam_learning_rate=0.3, muon_weight_dimension_numbers=_as_matrices
    )
    return optax.chain(optax.clip_by_global_norm(1.0), own)


@partial(jax.jit, static_argnames="settings", donate_argnames=("state", "moments"))
def step(state: TrainState, moments, source, means: Layers, rate, settings: StepSettings):
    """`train_step` with centred updates: -> state, moments, losses, (tensors, state before)."""
    data, (seen, before), warm = _simulated(*source, settings, state)
    both = jax.value_and_grad(loss_of, has_aux=True)
    (loss, (terms, last, _)), gradient = both(state.params, data, before, warm, settings)
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(norm)
    gradient = of_centred(gradient, means)
    gradient = jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0), gradient)
    updates, moments = muon().update(gradient, moments, state.params)
    updates = of_usual(updates, means)
    params = jax.tree.map(lambda p, u: p + rate * finite * u, state.params, updates)
    state = state._replace(params=params, step=state.step + 1, carried=(seen, last))
    return state, moments, {"loss": loss, "gradient": norm, **terms}, (data.tensors, before)


@jax.jit
def blended(old, new, kept):
    return jax.tree.map(lambda a, b: kept * a + (1 - kept) * b, old, new)


def run_centred(settings: Train, minutes: float, rising: int = 60, sinking: float = 0.45) -> int:
    """Trains on simulated sequences; returns the number of steps.

    settings: its greatest rate, sequences and loss; neither its steps nor its optimiser. Its chain
    must be more than 1. The rate rises over the first `rising` steps and sinks to a hundredth in
    the last part (`sinking`) of the time.
    """
    settings.output.mkdir(parents=True, exist_ok=True)
    state, (source, _) = first_state(settings), sources_of(settings, 0)
    sequences = next(source)
    moments = muon().init(state.params)
    means = no_means(state.params)
    kept, steps, seen = jax.tree.map(jnp.copy, state.params), 0, []
    begun = time.monotonic()
    with (settings.output / "log.jsonl").open("w") as log:
        while (passed := (time.monotonic() - begun) / (60 * minutes)) < 1:
            falling = min(1.0, max(0.01, (1 - passed) / sinking))
            rate = settings.learning_rate * min(1, (steps + 1) / rising) * falling
            state, moments, losses, inputs = step(
                state, moments, sequences, means, rate, settings.step_settings
            )
            steps += 1
            seen.append(losses)
            kept = blended(kept, state.params, min(LONGEST, steps / (steps + 10)))
            if steps % (10 if steps < 200 else 25) == 0:
                new = input_means(state.params, *inputs)
                means = new if steps == 10 else blended(means, new, 0.8)
            if steps % LOGGED == 0:
                mean = {key: float(np.mean([one[key] for one in seen])) for key in losses}
                seconds = time.monotonic() - begun
                print(f"{seconds:.0f} s, {steps} steps: loss {mean['loss']:.2f}", flush=True)
                log.write(json.dumps({"step": steps, "rate": rate, "seconds": seconds} | mean))
                log.write("\n")
                seen = []
    save_weights(settings.output / "last.npz", Weights(kept, True))
    return steps
