"""What the choice of a window's bounds means to the network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax.checkpoint import convert
from firenet_jax.events import concatenate
from firenet_jax.network import initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.simulation.scenes import video
from firenet_jax.simulation.sensor import event_list, random_setups, window_bounds
from firenet_jax.simulation.textures import load_textures
from firenet_jax.tensors import pack, voxelise

T, SIZE, RENDERINGS = 12, 96, 5


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
