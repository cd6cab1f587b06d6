"""Which reconstruction loss gives the best network, under equal training budgets?

    python experiments/compare_losses.py RUNS [--images PICTURES] [--steps 300]     45 minutes

Each candidate trains from the same seed, on the same sequences and for as many steps, in a folder
of its own under RUNS (an interrupted comparison goes on), and is judged on simulated sequences of
the pictures that are in no training pool. A loss is at an advantage in the measure that it
contains, so the choice is by the mean rank over measures. Writes results/compare_losses.json and
docs/compare_losses.jpg.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from harness import save
from PIL import Image
from train_default import REAL as SETTINGS

from firenet_jax.checkpoint import load_weights
from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.network import initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.simulation.curricula import sequences
from firenet_jax.simulation.textures import HELD_OUT, load_textures, photographs
from firenet_jax.training.losses import Loss
from firenet_jax.training.run import run

NONE = Loss(l1=0, nlpd=0, haarpsi=0)
# Weights that should bring each sum near the default's, so that lambda_tc means the same.
CANDIDATES = {
    "l1": replace(NONE, l1=5.0),
    "nlpd": replace(NONE, nlpd=1.0),
    "l1 + ms_ssim": replace(NONE, l1=2.0, ms_ssim=1.0),
    "l1 + nlpd + ssim": replace(NONE, l1=1.0, nlpd=0.5, ssim=0.5),
    "l1 + nlpd + ssim + gmsd": replace(NONE, l1=1.0, nlpd=0.5, ssim=0.5, gmsd=1.0),
    "l1 + nlpd + haarpsi": replace(NONE, l1=1.0, nlpd=0.5, haarpsi=0.5),
    "l1 + nlpd + ssim + haarpsi": replace(NONE, l1=0.5, nlpd=0.5, ssim=0.5, haarpsi=0.5),
    "l1 + nlpd + haarpsi + equalised": replace(NONE, l1=0.5, nlpd=0.5, haarpsi=0.5, equalised=0.5),
    "l1 + nlpd + haarpsi + equalised_mse": replace(
        NONE, l1=0.5, nlpd=0.5, haarpsi=0.5, equalised_mse=4.0
    ),
    "l1 + nlpd + cw_ssim": replace(NONE, l1=1.0, nlpd=0.5, cw_ssim=0.5),
    "l1 + random_features": replace(NONE, l1=2.0, random_features=0.5),
}
BETTER = {  # measure: +1 where more is better
    "ssim": 1, "mse": -1, "ssim_equalised": 1, "mse_equalised": -1, "nlpd": -1, "ms_ssim": 1,
    "gmsd": -1, "haarpsi": 1, "random_features": -1, "temporal": -1,
}  # fmt: skip
SIZE, WINDOWS, WARM_UP, BATCH, BATCHES = 160, 32, 16, 2, 8


def judged(path: Path, datas: list) -> tuple[dict[str, float], np.ndarray]:
    """Means of all measures over the windows after warming up; a row of last images."""
    weights = load_weights(path)
    rows, pictures = [], []
    now, before = slice(WARM_UP, None), slice(WARM_UP - 1, -1)
    for data in datas:
        images = reconstruct(weights, initial_state(BATCH, SIZE, SIZE), data.tensors)[1]
        shown, truths = jnp.clip(images[now], 0, 1), data.images[now]
        even, even_truths = equalise(shown, "local"), equalise(truths, "local")
        measures = {
            name: getattr(metrics, name)(shown, truths)
            for name in ("ssim", "mse", "nlpd", "ms_ssim", "gmsd", "haarpsi", "random_features")
        }
        measures["ssim_equalised"] = metrics.ssim(even, even_truths)
        measures["mse_equalised"] = metrics.mse(even, even_truths)
        truth = truths, data.images[before], data.visible[now]
        measures["temporal"] = metrics.temporal_error(
            images[now], images[before], data.displacement[now], *truth
        )
        rows.append({name: float(jnp.mean(value)) for name, value in measures.items()})
        pictures.append(np.asarray(images[-1, 0]))
    means = {name: float(np.mean([row[name] for row in rows])) for name in BETTER}
    return means, np.concatenate(pictures, 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--only", nargs="+", choices=CANDIDATES, default=list(CANDIDATES))
    options = parser.parse_args()
    budget = replace(
        SETTINGS,
        images=options.images,
        steps=options.steps,
        textures=256,
        batch=2,
        crop=64,
        chain=2,
        warmup=min(50, options.steps - 1),
        optimiser="muon",
        learning_rate=3e-3,
        validate_every=options.steps,
    )
    for name in options.only:
        folder = options.runs / name.replace(" ", "")
        run(replace(budget, output=folder, loss=CANDIDATES[name]))

    textures = jnp.asarray(load_textures(photographs(HELD_OUT), 40, 256, seed=0))
    simulate = jax.jit(
        partial(
            sequences,
            batch=BATCH,
            windows=WINDOWS,
            height=SIZE,
            width=SIZE,
            sensor=SETTINGS.sensor,
            scene=SETTINGS.scene,
        )  # fmt: skip
    )
    datas = [simulate(jax.random.key(n), textures) for n in range(BATCHES)]
    rows, sheet = {}, [np.concatenate([np.asarray(data.images[-1, 0]) for data in datas], 1)]
    for name in options.only:
        path = options.runs / name.replace(" ", "") / "last.npz"
        rows[name], pictures = judged(path, datas)
        sheet.append(pictures)
    for measure, sign in BETTER.items():
        order = sorted(rows, key=lambda name: -sign * rows[name][measure])
        for rank, name in enumerate(order, 1):
            rows[name].setdefault("ranks", {})[measure] = rank
    for name in sorted(rows, key=lambda name: sum(rows[name]["ranks"].values())):
        rows[name]["mean_rank"] = float(np.mean(list(rows[name].pop("ranks").values())))
        print(f"{name:28} " + " ".join(f"{k} {v:.4f}" for k, v in rows[name].items()))
    picture = np.uint8(np.round(255 * np.clip(np.concatenate(sheet), 0, 1)))
    target = Path(__file__).parents[1] / "docs" / "compare_losses.jpg"
    Image.fromarray(picture).save(target, quality=80)
    save("compare_losses", {"steps": options.steps, "rows": rows})


if __name__ == "__main__":
    main()
