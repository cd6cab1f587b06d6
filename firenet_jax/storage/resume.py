"""An output and its record -> how far an interrupted run came with it, for the next one to go on.

The record holds all that the output depends on (`runs.recorded`). Of several outputs each that is
whole has a note beside it until all are. A folder of pictures that is not whole holds a position:
how many steps were taken, how many pictures they made, and arrays to go on from. It is kept in a
file of its own before these pictures are on disk, and published (renamed) when they are: so the
pictures of a published position are there.
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


def mark_done(output: Path, record: dict, made: Path) -> None:
    """Notes beside an output that it is whole, though others of the same run are not.

    made: where it is whole, before it is renamed: who is killed in between has lost neither."""
    write_text(done_file(output), _note(output, record, made))


def is_done(output: Path, record: dict) -> bool:
    """Whether an interrupted run of the same settings completed this output, unchanged since."""
    try:
        return done_file(output).read_text() == _note(output, record, output)
    except (OSError, UnicodeDecodeError):
        return False


def _note(output: Path, record: dict, made: Path) -> str:
    _, *state = identity(made)
    return json.dumps([record, [output.name, *state]])


# ---- Positions in a folder of pictures


def position_file(output: Path) -> Path:
    return partial_name(output) / "resume.npz"


def _kept(output: Path, steps: int) -> Path:
    return position_file(output).with_suffix(f".{steps}.npz")


def keep_position(output: Path, record: dict, steps: int, pictures: int, **arrays) -> None:
    """Saves what is needed to go on after so many steps, whose pictures may not be on disk yet.

    Raises OutputError where it cannot be written."""
    path = _kept(output, steps)
    with writing(output):
        path.parent.mkdir(exist_ok=True)
        np.savez(path, record=json.dumps(record), steps=steps, pictures=pictures, **arrays)


def publish_position(output: Path, steps: int) -> None:
    """Makes what was kept after so many steps, if anything was, the position to go on from. Call it
    when their pictures are on disk."""
    if _kept(output, steps).exists():
        os.replace(_kept(output, steps), position_file(output))


def read_position(output: Path, record: dict, overwrite: bool) -> dict[str, Any] | None:
    """`steps`, `pictures` and the arrays that an interrupted run of the same settings published;
    None if there are none.

    Raises OutputError for those of another run and for a file that cannot be read, for both of
    which `overwrite` gives None.
    """
    path = position_file(output)
    if not path.exists():
        return None
    try:
        saved = read_arrays(path)
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
    """Removes what an interrupted run kept and did not publish. Only for a run that has locked the
    folder."""
    for path in partial_name(output).glob("resume.*.npz"):
        path.unlink()
