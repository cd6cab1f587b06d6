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

SETTINGS = Train(
    output=Path("run"),
    textures=768,
    steps=5400,
    batch=3,
    crop=80,
    windows=16,
    chain=6,
    renderings=8,
    motion=(0.8, 4.0),
    learning_rate=2e-3,
    loss=Loss(),
    scene=SceneSettings(objects=2),
    sensor=replace(FAULTY, threshold_range=(0.1, 0.6)),
)


def main(output: tyro.conf.Positional[Path], images: Path, steps: int = SETTINGS.steps):
    run(replace(SETTINGS, output=output, images=images, steps=steps))


if __name__ == "__main__":
    tyro.cli(main)
