"""Do a few minutes of training on a recording with frames make its later images better?

    python experiments/fine_tune.py RECORDING [--others RECORDING...]                   5 minutes

From the built-in weights, on the recording's beginning; SSIM of its held-out end before and after,
with and without a histogram equalisation, and of other recordings with frames, which shows what is
forgotten. The end also chooses which step's weights are kept, of those validated: with few to
choose from that helps little, but it is no test on what nothing was chosen by. The time is the
processor's, so that others who use the machine do not count.
"""

import argparse
import contextlib
import io
import tempfile
import time
from pathlib import Path

from harness import save

from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.train import run
from firenet_jax.readers import open_recording
from firenet_jax.training.batches import Augment
from firenet_jax.training.losses import Loss
from firenet_jax.training.recordings import Cut, Score, cut_off, judged
from firenet_jax.training.settings import Train

# A chain keeps what a network remembers over hundreds of windows, which short sequences undo.
# SSIM sees structure and, as `l1` does, brightness, which keeps images between black and white.
LOSS = Loss(l1=1.0, ssim=1.0, nlpd=0.0, haarpsi=0.0)
# Where one event in a hundred pixels comes, hot pixels would be most of what a crop holds.
CHOICES = {
    "weights": Path("built-in"), "learning_rate": 3e-4, "windows": 11, "chain": 4, "crop": 128,
    "batch": 2,
    "near_events": True, "augment": Augment(hot_pixels=0.0), "validate_every": 40, "loss": LOSS,
}  # fmt: skip


def whole(path: Path) -> Cut:
    """All frames of a recording but the first, which no events precede."""
    recording = open_recording(path)
    assert recording.frames is not None, f"{path} has no frames"
    return Cut(recording, recording.frames, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--others", type=Path, nargs="*", default=[])
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--windows", type=int, default=CHOICES["windows"])
    parser.add_argument("--chain", type=int, default=CHOICES["chain"])
    parser.add_argument("--crop", type=int, default=CHOICES["crop"])
    arguments = parser.parse_args()
    changed = {name: getattr(arguments, name) for name in ("steps", "windows", "chain", "crop")}
    with tempfile.TemporaryDirectory() as folder:
        output, data = Path(folder, "run"), (arguments.recording,)
        settings = Train(output, data=data, **(CHOICES | changed))
        begun, processor = time.perf_counter(), time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):
            run(settings)
        processor, passed = time.process_time() - processor, time.perf_counter() - begun
        weights = {
            "before": load_weights("built-in"),
            "after": load_weights(output / "weights.npz"),
        }
    found = {}
    cuts = {arguments.recording: cut_off(arguments.recording, settings.windows)}
    for path, one in (cuts | {path: whole(path) for path in arguments.others}).items():
        near = settings.near_events
        scores: dict[str, Score] = {
            name: judged(these, one, near) for name, these in weights.items()
        }
        found[path.stem] = {name: score._asdict() for name, score in scores.items()}
        old, new = scores["before"], scores["after"]
        print(
            f"{path.stem:28} {old.frames:3} frames   SSIM {old.ssim:.3f} {new.ssim:.3f}   "
            f"equalised {old.equalised:.3f} {new.equalised:.3f}"
        )
    print(f"{settings.steps} steps in {processor:.0f} s of processor time ({passed:.0f} s passed)")
    save(
        "fine_tune",
        {
            "recordings": found, "steps": settings.steps, "processor_seconds": processor,
            "seconds": passed, "settings": {k: str(v) for k, v in CHOICES.items()},
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
