"""Losses and pictures of a run -> log.jsonl, TensorBoard, png files, weights.

The first process writes; the others only read what is there. When a run resumes from a
checkpoint, log lines written after that checkpoint are dropped.
"""

import contextlib
import json
import math
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from firenet_jax.checkpoint import save_weights
from firenet_jax.devices import is_first
from firenet_jax.errors import logger
from firenet_jax.network import Weights
from firenet_jax.pictures import event_pictures, to_8_bit
from firenet_jax.storage.files import write_text, writing

# tensorboardX imports PyTorch where it is installed, for tensors that it is not given here: that
# takes as long as all else that training imports.
_torch = sys.modules.get("torch")
sys.modules["torch"] = _torch  # pyright: ignore[reportArgumentType]
try:
    from tensorboardX import SummaryWriter
finally:
    if _torch is None:
        del sys.modules["torch"]


class Log:
    """A run's record in its folder; step: of the checkpoint from which it goes on, or 0."""

    def __init__(self, folder: Path, step: int):
        self.path, self.start = folder / "log.jsonl", time.monotonic()
        self.entries = [entry for entry in entries(self.path) if entry["step"] <= step]
        self.board: Any = None
        self.failed: OSError | None = None
        if is_first():
            write_text(self.path, "".join(json.dumps(entry) + "\n" for entry in self.entries))
            self.hook, threading.excepthook = threading.excepthook, self._ended
            self.board = SummaryWriter(  # a queue that holds what `write` and `show` put into it
                str(folder / "tensorboard"), purge_step=step + 1, max_queue=1000
            )

    def _ended(self, what: threading.ExceptHookArgs) -> None:
        """TensorBoard's curves are written by a thread; what ends it is raised by the next call,
        which would else fill the queue and wait."""
        if not isinstance(what.exc_value, OSError):
            self.hook(what)
        else:
            self.failed = what.exc_value

    def _check(self) -> None:
        if self.failed is not None:
            with writing(self.path.with_name("tensorboard")):
                raise self.failed

    def write(self, step: int, kind: str, values: dict) -> dict[str, float]:
        self._check()
        values = {name: float(value) for name, value in values.items()}
        entry = {"step": step, "kind": kind, **values, "seconds": time.monotonic() - self.start}
        if self.board is not None:
            with self.path.open("a") as file:
                file.write(json.dumps(entry) + "\n")
            for name, value in values.items():
                self.board.add_scalar(f"{kind}/{name}", value, step)
        return values

    def show(self, step: int, pictures: tuple[jax.Array, jax.Array, jax.Array]) -> None:
        """Three windows of `validate`'s pictures: events, image, truth, one window a row."""
        if self.board is None:
            return
        images, truths, tensors = pictures
        chosen = [len(images) * k // 3 - 1 for k in (1, 2, 3)]
        grey = jnp.concatenate([images, truths], -1)[np.array(chosen)]
        grey = np.asarray(to_8_bit(grey))[..., None]
        events = np.asarray(event_pictures(tensors[np.array(chosen)]))
        sheet = np.concatenate([events, np.repeat(grey, 3, -1)], 2)  # (3, H, 3 W, 3)
        sheet = sheet.reshape(-1, *sheet.shape[2:])
        (self.path.parent / "pictures").mkdir(exist_ok=True)
        Image.fromarray(sheet).save(self.path.parent / "pictures" / f"step_{step:07d}.png")
        self.board.add_image("validation", sheet, step, dataformats="HWC")

    def keep(self, name: str, weights: Weights) -> None:
        if self.board is not None:
            save_weights(self.path.parent / name, weights)

    def best(self) -> float:
        """The least validation loss so far."""
        losses = [entry["loss"] for entry in self.entries if entry.get("kind") == "validation"]
        return min(filter(math.isfinite, losses), default=math.inf)

    def close(self) -> None:
        """Raises nothing, so that it can follow an error."""
        if self.board is None:
            return
        threading.excepthook = self.hook
        try:
            if self.failed is None:
                self.board.close()
        except OSError as error:
            self.failed = error
        if self.failed is not None:
            logger.warning("TensorBoard's curves are not whole (%s)", self.failed.strerror)
            self.board.file_writer.event_writer._closed = True  # else it tries again at the exit


def entries(path: Path) -> Iterator[dict]:
    """Lines of a log, but what was half written when a run was killed, and what is no entry."""
    for line in path.read_bytes().splitlines() if path.exists() else []:
        with contextlib.suppress(ValueError, TypeError, RecursionError, OverflowError):
            entry = json.loads(line)
            if not (isinstance(entry, dict) and type(entry.get("step")) is int):
                continue
            if entry.get("kind") == "validation":
                entry["loss"] = float(entry.get("loss", "nothing"))
            yield entry
