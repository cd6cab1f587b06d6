"""What goes wrong -> one sentence that says what and where, and what to do about it.

A `FirenetError` is for the person who runs the program: the command line prints its sentence. They
are ValueErrors, for those who call the package from Python. Any other exception, OSError and
MemoryError apart, is a fault of this package. What is worth knowing but stops nothing goes to
`logger`.
"""

import logging

logger = logging.getLogger("firenet_jax")


class FirenetError(ValueError):
    """What a person can put right; the message is one sentence."""


class SettingsError(FirenetError):
    """Settings cannot be, or do not fit each other or the data: which, and what they can be."""


class RecordingError(FirenetError):
    """A recording cannot be used; the message is one sentence: file, place, found, what to do."""


class CheckpointError(FirenetError):
    """Weights cannot be used; the message is one sentence: file, what is wrong, what to do."""


class PictureError(FirenetError):
    """Pictures or a video file cannot be used: file, what is wrong, what to do."""


class OutputError(FirenetError):
    """A file cannot be written as asked; the message is one sentence."""
