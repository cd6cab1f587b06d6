"""ECD folder -> Source: a sequence of the Event Camera Dataset, unpacked or as its zip.

    events.txt       a line an event: t x y p, seconds (see text.py)
    images.txt       a line a frame: t filename, seconds on the same clock
    images/          frames, grey
    calib.txt, imu.txt, groundtruth.txt are not read

The files name no sensor size: it is that of the first frame, and unknown where there are no frames.
"""

import io
import math
import os
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
from PIL import Image

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Frames
from firenet_jax.readers import Source, frame_times, reading, size_of, text, to_frame

MAX_BYTES = 1 << 26  # bytes of images.txt, and of a picture


def matches(path: Path) -> bool:
    if path.is_dir():
        return (path / "events.txt").is_file()
    return path.suffix.lower() == ".zip" and _folder_in(path) is not None


def read(path: Path) -> Source:
    if path.is_dir():
        source = text.read(path / "events.txt")
    else:
        source = text.read(path, f"{_folder_in(path)}events.txt")
    frames = _frames(path)
    size = source.size or size_of(frames)
    return replace(
        source,
        format="ECD folder" if path.is_dir() else "ECD zip",
        size=size,
        frames=frames,
        place=lambda row: f"events.txt, {source.place(row)}",
    )


def _folder_in(path: Path) -> str | None:
    """The folder inside a zip that holds events.txt and images.txt, with its slash."""
    try:
        names = text.members(path)
    except RecordingError:
        return None  # not a zip: text.py says so
    folders = [name.removesuffix("events.txt") for name in names if name.endswith("events.txt")]
    folders = [name for name in folders if not name or name.endswith("/")]
    return next((name for name in folders if name + "images.txt" in names), None)


def _bytes(path: Path, name: str) -> bytes:
    """All of images.txt or of a picture, at once: raises RecordingError beyond MAX_BYTES."""
    inside = open(path / name, "rb") if path.is_dir() else None
    with inside or text.opened(path, f"{_folder_in(path)}{name}") as stream:
        content = stream.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise RecordingError(f"{path}, {name}: is larger than {MAX_BYTES >> 20} MB: it is damaged")
    return content


def _frames(path: Path) -> Frames | None:
    if path.is_dir() and not (path / "images.txt").is_file():
        return None
    times, names = [], []
    lines = _bytes(path, "images.txt").decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        try:
            time, name = words
            times.append(float(time))
        except ValueError:
            times.append(math.nan)
        wrong = ""
        if not math.isfinite(times[-1]):
            wrong = (
                f"{line.strip()!r} where a time in seconds and the name of a picture are expected"
            )
        elif PurePath(name).is_absolute() or ".." in PurePath(name).parts:
            wrong = f"{name!r} lies outside the recording"
        elif "\0" in name:
            wrong = f"{name!r} is no name of a file"
        if wrong:
            raise RecordingError(f"{path}, images.txt, line {number}: {wrong}")
        names.append(name)
    if not names:
        return None
    if not _holds(path, names[0]):
        logger.warning("%s: images.txt names %s, which is not there: no frames", path, names[0])
        return None
    return Frames(
        frame_times(path / "images.txt", np.array(times)), lambda i: _frame(path, names[i])
    )


def _holds(path: Path, name: str) -> bool:
    if path.is_dir():
        return os.path.isfile(path / name)
    return f"{_folder_in(path)}{name}" in text.members(path)


def _frame(path: Path, name: str) -> np.ndarray:
    with reading(path / name, Exception):  # Pillow raises every kind for damaged bytes
        with Image.open(io.BytesIO(_bytes(path, name))) as picture:
            if picture.mode.startswith("I"):  # 16 bits, which conversion would cut off at 255
                return to_frame(np.asarray(picture).astype(np.uint16), path)
            return to_frame(np.asarray(picture.convert("L")), path)
