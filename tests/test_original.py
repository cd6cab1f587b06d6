"""Events to 8-bit pictures on a real recording, against the steps of the original program.

The steps are those of rpg_e2vid, written again from their description with numpy and PyTorch:
event tensor, normalisation, reflecting pad to a multiple of 16, network, unsharp mask, intensity
range, 8 bits (it truncates), crop.
"""

import jax
import numpy as np
import pytest
import references
from PIL import Image

from firenet_jax.checkpoint import convert
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.events import Events
from firenet_jax.pictures import Display
from firenet_jax.reconstruction import Network
from firenet_jax.windows import Windows

HEIGHT, WIDTH = 180, 240


def original(rows, count, weights, kind):
    """(N, 4) rows of t (s), x, y, p -> list of pictures (H, W) uint8."""
    import torch

    params = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf)), weights.params)
    step = references.torch_firenet(params)
    pad = torch.nn.ReflectionPad2d((0, 0, 6, 6))
    state = (torch.zeros(1, 16, HEIGHT + 12, WIDTH),) * 2
    images = []
    for start in range(0, len(rows), count):
        window = rows[start : start + count]
        events = Events.of(np.rint(window[:, 0] * 1e6), *window[:, 1:].T)
        tensor = references.normalised(references.event_tensor(events, HEIGHT, WIDTH))
        tensor = torch.tensor(tensor, dtype=torch.float32).permute(2, 0, 1)[None]
        with torch.no_grad():
            state, image = step(state, pad(tensor))
        images.append(references.unsharp(image[0, 0].numpy()))
    ranges = references.intensity_ranges(images) if kind == "extremes" else [(0, 1)] * len(images)
    pictures = []
    for image, (low, high) in zip(images, ranges, strict=True):
        levels = np.clip(255 * (image - low) / (high - low), 0, 255).astype(np.uint8)
        pictures.append(levels[6:-6])
    return pictures


@pytest.mark.slow
@pytest.mark.reference
@pytest.mark.parametrize("kind", ["fixed", "extremes"])
def test_pictures_of_a_real_recording(tmp_path, reference, recordings, kind):
    pytest.importorskip("torch", reason="compares with PyTorch, which is not installed")
    path, checkpoint = recordings / "ecd_slider_depth", reference / "firenet_published.pth"
    count = 4000
    run(
        Reconstruct(
            (path,), tmp_path / "out", checkpoint, Windows(events=count),
            network=Network(pad=16), display=Display(range=kind), warm_up=0,
        )
    )  # fmt: skip
    rows = np.loadtxt(path / "events.txt")
    expected = original(rows, count, convert(checkpoint), kind)
    written = sorted((tmp_path / "out").glob("*.png"))
    assert len(written) == len(expected) == 13
    differences = []
    for name, picture in zip(written, expected, strict=True):
        with Image.open(name) as image:
            differences.append(np.abs(np.asarray(image).astype(int) - picture))
    differences = np.stack(differences)
    print(f"\nwithin one level: {(differences <= 1).mean():.6%}, largest {differences.max()}")
    assert (differences <= 1).mean() >= 0.999
