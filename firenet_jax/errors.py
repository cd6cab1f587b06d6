"""A user's mistake -> one sentence: what is wrong, where, and what to do about it.

A `FirenetError` is for the person who runs the program: the command line prints its message. It is
a ValueError too, for callers from Python. Any other exception, except OSError and MemoryError, is a
bug in this package. Warnings and notices go to `logger`.
"""

import logging

logger = logging.getLogger("firenet_jax")


class FirenetError(ValueError):
    """An error that the user can fix. The message is one sentence."""


class SettingsError(FirenetError):
    """A setting is invalid, or does not fit the other settings or the data."""


class RecordingError(FirenetError):
    """A recording cannot be used. The message names the file, the place, what was found there and
    what to do."""


class CheckpointError(FirenetError):
    """Weights cannot be used. The message names the file, the problem and what to do."""


class PictureError(FirenetError):
    """A picture or a video file cannot be used. The message names the file, the problem and what to
    do."""


class OutputError(FirenetError):
    """An output cannot be written as requested."""
