"""A video file -> its pictures in grey: input of the simulated sensor, in place of a scene."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError

from firenet_jax.errors import PictureError
from firenet_jax.simulation.sensor import MAX_INTERVAL
from firenet_jax.storage.files import check_readable
from firenet_jax.storage.sequence_file import Picture


def read_clip(path: Path, size: tuple[int, int] | None = None) -> Iterator[Picture]:
    """A video file -> its pictures in grey, times from the first; scaled to (height, width).

    Raises PictureError for what cannot be read, or whose times stand still or leave gaps.
    """
    first = last = shape = None
    check_readable(path)
    try:
        # absolute, for FFmpeg takes what precedes a colon for a protocol
        with av.open(str(path.absolute()), metadata_errors="replace") as container:
            if not container.streams.video or container.format.name == "tty":  # any text is
                raise PictureError(f"{path}: holds no video, only sound or text: name a video file")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            period = 1 / (stream.average_rate or Fraction(25))
            for number, frame in enumerate(container.decode(stream)):
                if frame.pts is None or frame.time_base is None:
                    seconds = number * period
                else:
                    seconds = frame.pts * frame.time_base
                first = seconds if first is None else first
                time = round((seconds - first) * 1_000_000)
                if last is not None and not 0 < time - last <= MAX_INTERVAL:
                    raise PictureError(
                        f"{path}: picture {number + 1} comes {(time - last) * 1e-6:g} s after the "
                        f"one before, expected more than 0 and up to {MAX_INTERVAL * 1e-6:.1f}: "
                        "convert the clip to a constant rate"
                    )
                last = time
                turns = frame.rotation // 90 % 4  # of a telephone held upright
                stored = size[::-1] if size and turns % 2 else size  # before it is turned
                height, width = stored or (frame.height, frame.width)
                # By way of RGB: the grey plane of a video does not reach from 0 to 255.
                rgb = frame.to_ndarray(format="rgb24", width=width, height=height)
                grey = rgb @ np.array([0.299, 0.587, 0.114], np.float32)
                upright = np.rot90(np.round(grey).astype(np.uint8), turns)
                shape = shape or upright.shape
                if upright.shape != shape:
                    raise PictureError(
                        f"{path}: picture {number + 1} has {upright.shape[1]}x{upright.shape[0]} "
                        f"pixels, those before {shape[1]}x{shape[0]}: pass --sensor-size "
                        "WIDTHxHEIGHT to scale all alike"
                    )
                yield Picture(time, np.ascontiguousarray(upright), None)
    except (FFmpegError, OSError, UnicodeDecodeError) as error:  # names in it that are no text
        reason = getattr(error, "strerror", None) or error
        raise PictureError(
            f"{path}: cannot be read as a video ({reason}): name a file that ffmpeg can play"
        ) from error
