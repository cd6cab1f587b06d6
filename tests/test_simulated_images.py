"""What the choice of a window's bounds means to the network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import firenet_jax as fj
from firenet_jax.checkpoint import convert, load_weights
from firenet_jax.events import concatenate
from firenet_jax.network import initial_state
from firenet_jax.reconstruction import images_at, reconstruct
from firenet_jax.simulation.curricula import random_setups, window_bounds
from firenet_jax.simulation.scenes import video
from firenet_jax.simulation.sensor import event_list
from firenet_jax.simulation.textures import load_textures
from firenet_jax.tensors import pack, voxelise

T, SIZE, RENDERINGS = 12, 96, 5


@pytest.mark.slow
def test_a_warm_up_makes_first_images_nearly_as_good_as_later_ones():
    """Built-in weights on two simulated recordings: the error of their first images."""
    square = {"height": SIZE, "width": SIZE}
    sensors, scenes, _ = random_setups(
        jax.random.key(5), jnp.asarray(load_textures(count=16)), batch=2, windows=T, **square
    )
    errors = {0: [], 20: []}
    for b in range(2):
        sensor, scene = jax.tree.map(lambda leaf, b=b: leaf[b], (sensors, scenes))
        times = np.linspace(0, 200_000, 160).astype(np.int64)
        events = concatenate(list(event_list(sensor, video(scene, times, **square))))
        recording = fj.recording(events.t, events.x, events.y, events.p, width=SIZE, height=SIZE)
        wanted = [int(events.t[0]) + 10_000]
        ((_, truth),) = video(scene, wanted, **square)
        for warm_up, found in errors.items():
            made = images_at(load_weights(), recording, wanted, warm_up=warm_up, duration=10.0)
            image = np.clip(next(made)[1][0], 0, 1)
            found.append(float(np.mean((image - truth) ** 2)))
    print(f"\nMSE of the first images, from zero {errors[0]}, after the warm-up {errors[20]}")
    assert np.mean(errors[20]) < 0.7 * np.mean(errors[0])


@pytest.mark.slow
@pytest.mark.reference
def test_bounds_of_the_window_or_of_its_events_give_nearly_the_same_images(reference):
    """Recordings are normalised by their first and last event, simulated windows by their ends."""
    weights = convert(reference / "firenet_published.pth")
    square = {"height": SIZE, "width": SIZE}
    sensors, scenes, durations = random_setups(
        jax.random.key(3), jnp.asarray(load_textures(count=16)), batch=2, windows=T, **square
    )
    bounds = window_bounds(durations, T)
    differences = []
    for b in range(2):
        sensor, scene = jax.tree.map(lambda leaf, b=b: leaf[b], (sensors, scenes))
        ends = np.asarray(bounds[:, b], np.int64)
        times = np.unique(np.linspace(ends[:-1], ends[1:], RENDERINGS + 1).astype(np.int64))
        events = concatenate(list(event_list(sensor, video(scene, times, **square))))
        cuts = np.searchsorted(events.t, ends)
        rows = [[events.select(slice(*cut))] for cut in zip(cuts[:-1], cuts[1:], strict=True)]
        images = []
        for limits in (np.stack([ends[:-1], ends[1:]], -1)[:, None], None):
            tensors = voxelise(pack(rows, bounds=limits), **square)
            images.append(reconstruct(weights, initial_state(1, SIZE, SIZE), tensors)[1])
        differences.append(float(np.abs(images[0] - images[1]).mean()))
    print(f"\nmean difference of the images: {differences}")
    assert 0 < np.mean(differences) < 0.01
