"""The run that made the built-in weights, `firenet_jax/weights/firenet.npz`.

    python experiments/train_default.py RUN --images PICTURES

It goes on where it was interrupted. What it was and how it went is written to
results/train_default.json, with the curve beside it, whenever it ends or is asked to `--report`.
"""

from dataclasses import replace
from pathlib import Path

import tyro

from firenet_jax.losses import Loss
from firenet_jax.scenes import SceneSettings
from firenet_jax.sensor import FAULTY
from firenet_jax.train import Train, run

# Half of the sequences have next to no noise, the others as much as real sensors in the dark.
SENSOR = replace(
    FAULTY,
    threshold_range=(0.1, 0.5),
    noise=(0.003, 5.0),
    leak=(0.003, 0.3),
    hot=(1e-6, 1e-3),
    cutoff=(100.0, 2000.0),
)
SETTINGS = Train(
    output=Path("run"),
    textures=768,
    procedural=0.2,
    steps=4200,
    batch=3,
    crop=80,
    windows=16,
    chain=4,
    renderings=8,
    motion=(0.3, 4.0),
    learning_rate=1e-3,
    loss=Loss(),
    scene=SceneSettings(objects=2),
    sensor=SENSOR,
    validate_every=300,
)


def main(
    output: tyro.conf.Positional[Path],
    images: Path,
    weights: Path | None = None,
    steps: int = SETTINGS.steps,
):
    run(replace(SETTINGS, output=output, images=images, weights=weights, steps=steps))


if __name__ == "__main__":
    tyro.cli(main)
