"""An output and its record -> how far an interrupted run came with it, for the next one to go on.

The record holds all that the output depends on (`runs.recorded`). Of several outputs each that is
whole has a note beside it until all are. A folder of pictures that is not whole holds a position:
steps taken, their pictures, and arrays to go on from. It is kept before these pictures are on disk
and published when they are, so what is published is true.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from firenet_jax.errors import OutputError
from firenet_jax.storage.files import identity, partial_name, read_arrays, write_text, writing
from firenet_jax.storage.runs import check_same

# ---- Outputs that are whole


def done_file(output: Path) -> Path:
    return output.with_name(f"{output.name}.done.json")


def mark_done(output: Path, record: dict) -> None:
    """This output is whole, though others of the same run are not."""
    write_text(done_file(output), _note(output, record))


def is_done(output: Path, record: dict) -> bool:
    """Whether an interrupted run of the same settings has left this output, as it is now."""
    try:
        return done_file(output).read_text() == _note(output, record)
    except (OSError, UnicodeDecodeError):
        return False


def _note(output: Path, record: dict) -> str:
    return json.dumps([record, identity(output)])


# ---- Positions in a folder of pictures


def position_file(output: Path) -> Path:
    return partial_name(output) / "resume.npz"


def _kept(output: Path, steps: int) -> Path:
    return position_file(output).with_suffix(f".{steps}.npz")


def keep_position(output: Path, record: dict, steps: int, pictures: int, **arrays) -> None:
    """To go on after these pictures, which may not be on disk yet."""
    path = _kept(output, steps)
    with writing(output):
        path.parent.mkdir(exist_ok=True)
        np.savez(path, record=json.dumps(record), steps=steps, pictures=pictures, **arrays)


def publish_position(output: Path, steps: int) -> None:
    """What was kept after so many steps, if anything was: their pictures are on disk."""
    if _kept(output, steps).exists():
        os.replace(_kept(output, steps), position_file(output))


def read_position(output: Path, record: dict, overwrite: bool) -> dict[str, Any] | None:
    """The arrays that an interrupted run of the same settings has published; None: there are none.

    Raises OutputError where those of another run are there, which `overwrite` allows to replace.
    """
    path = position_file(output)
    if not path.exists():
        return None
    saved = read_arrays(path)
    try:
        found = json.loads(str(saved["record"]))
        what = f"{path.parent} holds an unfinished run of other settings or another recording"
        check_same(found, record, what, "remove it or pass --overwrite")
    except (KeyError, ValueError) as error:  # OutputError is a ValueError
        if overwrite:
            return None
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{path} is damaged ({error}): remove it and run again") from error
    return saved


def remove_unpublished(output: Path) -> None:
    """By whoever holds the folder's lock: what an interrupted run kept and nobody can use."""
    for path in partial_name(output).glob("resume.*.npz"):
        path.unlink()
