"""Event Stream .es -> Source, through faery: 5 bytes an event, rows counted from the bottom.

faery turns the rows round. Times are microseconds; it clamps a time that falls below an earlier one
to that one. A file that was cut off looks whole: it does not say how long it is, and faery leaves
out a part of an event.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.readers import Source, extra, joined, to_chunks


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".es"


def read(path: Path) -> Source:
    faery = extra("faery", path)
    with _guarded(path):
        width, height = faery.events_stream_from_file(path).dimensions()
    return Source(
        "Event Stream", lambda: joined(to_chunks(path, _columns(faery, path))), (height, width)
    )


def _columns(faery: ModuleType, path: Path) -> Iterator[tuple[np.ndarray, ...]]:
    with _guarded(path):
        stream = iter(faery.events_stream_from_file(path))
    while True:
        with _guarded(path):
            packet = next(stream, None)
        if packet is None:
            return
        if len(packet):  # else its bytes only counted time
            yield packet["t"], packet["x"], packet["y"], packet["on"]


@contextmanager
def _guarded(path: Path):
    """Turns what faery raises into a RecordingError; a panic of its Rust code is no Exception."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise RecordingError(
            f"{path}: cannot be read ({' '.join(str(error).split())}): the file is damaged, "
            "incomplete or of another format: copy or download it again"
        ) from error
