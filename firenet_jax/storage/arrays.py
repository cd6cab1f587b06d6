"""Images -> one HDF5 file, for further computation: float32 as the network gives them.

    images   (N, H, W) float32, nominally 0 to 1 and not clipped
    times    (N,) int64, microseconds on the recording's clock
    events   (N,) int64, number of events that the image is made of

It is written beside its final name and renamed when it is whole.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from firenet_jax.storage.disk import Disk
from firenet_jax.storage.files import (
    Noted,
    discard,
    no_note,
    open_alone,
    partial_name,
    publish,
    writing,
)


class ArraysWriter:
    """Used as `video.VideoWriter`, for images (H, W) float32, all of one size.

    All but `abandon` raise OutputError where the file cannot be written, or another run writes it.
    """

    def __init__(self, path: Path):
        self.path, self.partial, self.count = path, partial_name(path), 0
        with writing(path):
            self.held = open_alone(self.partial, path)
            self.disk = Disk(self.held)
            self.file: Any = h5py.File(self.disk, "w")

    def _start(self, height: int, width: int) -> None:
        self.file.attrs["description"] = "images of events, by firenet_jax"
        self.file.attrs["time_unit"] = "microseconds"
        shape = (0, height, width)
        self.file.create_dataset(
            "images", shape, "f4", maxshape=(None, height, width), chunks=(1, height, width)
        )
        for name in ("times", "events"):
            self.file.create_dataset(name, (0,), "i8", maxshape=(None,), chunks=(1024,))

    def write(self, image: np.ndarray, time: int, events: int) -> None:
        """time: microseconds; events: how many the image is made of."""
        with writing(self.path):
            if self.count == 0:
                self._start(*image.shape)
            for name, value in (("images", image), ("times", time), ("events", events)):
                self.file[name].resize(self.count + 1, axis=0)
                self.file[name][self.count] = value
            self.disk.check()
        self.count += 1

    def finish(self, noted: Noted = no_note) -> None:
        with writing(self.path):
            self.file.close()
            self.disk.check()
            noted(self.partial)
            publish(self.held, self.partial, self.path)

    def abandon(self) -> None:
        """Removes the partial file."""
        self.file.close()
        discard(self.held, self.partial)
