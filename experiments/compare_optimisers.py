"""Muon, Muon with centred updates or Adam: which learns more from the same steps?

    python experiments/compare_optimisers.py RUNS [--images PICTURES] [--steps 300]   25 minutes

Each candidate trains from the same seed, on the same sequences and for as many steps of 64x64
pixels, in a folder of its own under RUNS (an interrupted comparison goes on); each optimiser with
two or more rates, because each has its own best one. Judged is the loss on the validation
sequences of the run, which are the same for all. Writes results/compare_optimisers.json and .png.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import matplotlib
from harness import RESULTS, save
from train_default import REAL

from firenet_jax.training.run import run

matplotlib.use("agg")
from matplotlib import pyplot as plt  # noqa: E402

CANDIDATES = {
    "adam, rate 1e-3": {"optimiser": "adam", "learning_rate": 1e-3},
    "adam, rate 2.5e-3": {"optimiser": "adam", "learning_rate": 2.5e-3},
    "muon, rate 3e-3": {"optimiser": "muon", "learning_rate": 3e-3},
    "muon, rate 1e-2": {"optimiser": "muon", "learning_rate": 1e-2},
    "centred, rate 3e-3": {"optimiser": "centred", "learning_rate": 3e-3},
    "centred, rate 1e-2": {"optimiser": "centred", "learning_rate": 1e-2},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--only", nargs="+", choices=CANDIDATES, default=list(CANDIDATES))
    options = parser.parse_args()
    budget = replace(
        REAL,
        images=options.images,
        steps=options.steps,
        textures=512,
        crop=64,
        windows=16,
        chain=1,
        warmup=min(40, options.steps - 1),
        validate_every=50,
    )
    rows = {}
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for name in options.only:
        folder = options.runs / name.replace(", rate ", "_")
        run(replace(budget, output=folder, **CANDIDATES[name]))
        entries = [json.loads(line) for line in (folder / "log.jsonl").open()]
        validations = [entry for entry in entries if entry["kind"] == "validation"]
        rows[name] = validations[-1]
        axes.plot([v["step"] for v in validations], [v["loss"] for v in validations], label=name)
        last = rows[name]
        print(f"{name:20} loss {last['loss']:.3f}  ssim {last['ssim']:.4f}  mse {last['mse']:.4f}")
    axes.set(xlabel="steps", ylabel="validation loss")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(RESULTS / "compare_optimisers.png", dpi=80)
    save("compare_optimisers", {"steps": options.steps, "rows": rows})


if __name__ == "__main__":
    main()
