"""Float32 against bfloat16 convolutions -> how far the pictures differ.

Question: what does --bfloat16 cost in accuracy? A recording is reconstructed twice from the same
tensors; between windows the state is float32 in both. Expected: SSIM above 0.99.

    python experiments/bfloat16.py WEIGHTS RECORDING...          under a minute each
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from harness import save
from skimage.metrics import structural_similarity

import firenet_jax as fj
from firenet_jax.commands.info import describe


def compare(weights, path: Path, windows: int) -> dict:
    """Both runs over about so many windows; differences over all images after the tenth."""
    recording = fj.open_recording(path)
    size = 1, recording.height, recording.width
    states = {dtype: fj.initial_state(*size) for dtype in (jnp.float32, jnp.bfloat16)}
    images = {dtype: [] for dtype in states}
    count = -(-describe(path)["events"] // windows)
    for tensors, _ in fj.event_tensors(recording, events=count):
        for dtype in states:
            states[dtype], part = fj.reconstruct(weights, states[dtype], tensors, dtype=dtype)
            images[dtype].extend(np.asarray(part[:, 0]))
    exact, rough = (np.clip(images[dtype][10:], 0, 1) for dtype in states)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    ssim = [
        structural_similarity(a, b, data_range=1.0, **settings)
        for a, b in zip(exact, rough, strict=True)
    ]
    return {
        "recording": path.name,
        "images": len(exact),
        "mean_abs": float(np.abs(exact - rough).mean()),
        "max_abs": float(np.abs(exact - rough).max()),
        "mean_ssim": float(np.mean(ssim)),
        "least_ssim": float(np.min(ssim)),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--windows", type=int, default=25)
    options = parser.parse_args()
    weights = fj.load_weights(options.weights)
    rows = [compare(weights, path, options.windows) for path in options.recordings]
    for row in rows:
        print(
            f"{row['recording']:32} mean |difference| {row['mean_abs']:.5f}, largest "
            f"{row['max_abs']:.4f}, SSIM {row['mean_ssim']:.5f} (least {row['least_ssim']:.5f})"
        )
    save("bfloat16", {"weights": options.weights.name, "rows": rows})


if __name__ == "__main__":
    main()
