"""A video file -> its pictures in grey: input of the simulated sensor, in place of a scene."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.error import FFmpegError

from firenet_jax.errors import PictureError, logger
from firenet_jax.simulation.sensor import MAX_INTERVAL
from firenet_jax.storage.files import check_readable
from firenet_jax.storage.sequence_file import Picture

CUT = 5  # periods by which the last picture may come before the end that the file states


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
            # An .avi says in which order pictures are stored, not when they are shown.
            stored = container.format.name == "avi" and stream.codec_context.has_b_frames
            for number, frame in enumerate(container.decode(stream)):
                if frame.pts is None or frame.time_base is None or stored:
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
                matrix = _matrix(frame)
                lying = size[::-1] if size and _lies(matrix) else size  # before it is turned
                height, width = lying or (frame.height, frame.width)
                # By way of RGB: the grey plane of a video does not reach from 0 to 255.
                rgb = frame.to_ndarray(format="rgb24", width=width, height=height)
                grey = rgb @ np.array([0.299, 0.587, 0.114], np.float32)
                upright = _upright(np.round(grey).astype(np.uint8), matrix)
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


def _matrix(frame: av.VideoFrame) -> tuple[int, int, int, int]:
    """(a, b, c, d): a pixel is to be shown at (a x + c y, b x + d y), as of a telephone held
    upright, or its front camera."""
    try:
        for data in cast(Any, frame.side_data):
            if data.type.name == "DISPLAYMATRIX":
                a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].tolist()
                return a, b, c, d
    except ValueError:  # PyAV does not know every kind that FFmpeg does: turned, but not mirrored
        turns = (1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)
        return turns[frame.rotation // 90 % 4]
    return 1, 0, 0, 1


def _lies(matrix: tuple[int, int, int, int]) -> bool:
    return abs(matrix[1]) > abs(matrix[0])


def _upright(picture: np.ndarray, matrix: tuple[int, int, int, int]) -> np.ndarray:
    """(H, W) as stored -> as it is to be shown, to the nearest quarter turn."""
    a, b, c, d = matrix
    if _lies(matrix):
        picture, a, d = picture.T, c, b
    return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def warn_if_cut(path: Path, last: int) -> None:
    """Says where a file that can be read states that it lasts longer; last: microseconds from the
    first picture to the last. Not of a GIF, whose last picture may be shown for long."""
    with av.open(str(path.absolute()), metadata_errors="replace") as container:
        stream = container.streams.video[0]
        period, stated = 1 / (stream.average_rate or Fraction(25)), None
        if stream.duration is not None and stream.time_base is not None:
            stated = stream.duration * stream.time_base
        elif container.duration is not None and len(container.streams) == 1:  # sound lasts longer
            stated = Fraction(container.duration, av.time_base)
        shown_for_long = container.format.name == "gif"
    if stated is not None and stated - Fraction(last, 10**6) > CUT * period and not shown_for_long:
        logger.warning(
            "%s: its last picture comes after %.2f s, but it says that it lasts %.2f: is it whole?",
            path, last / 1e6, stated,
        )  # fmt: skip
