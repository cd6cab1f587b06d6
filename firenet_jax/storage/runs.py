"""A run's settings -> what of it is done: the protocol by which an interrupted command goes on.

A run is a folder that one process at a time writes into (`alone_in`), with a record of its settings
in it, and what is done. A record holds, ready for JSON, all that the output depends on. Whoever
finds one asks `check_same`: are these the same settings? If so it goes on with what is missing; if
not, one sentence names each setting that differs and what to do. Files appear when they are whole
(`files`), so what is there is done. `commands.simulate` goes through all of it.
"""

import contextlib
import dataclasses
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from firenet_jax.errors import OutputError
from firenet_jax.storage.files import locked


def recorded(settings: Any, but: Collection[str] = (), **others: Any) -> dict:
    """A dataclass of settings -> a dict that JSON gives back as it is: paths as text, lists.

    but: fields that say nothing about what is computed. others: what is added or takes their place.
    """
    choices = {k: v for k, v in dataclasses.asdict(settings).items() if k not in but}
    return json.loads(json.dumps(choices | others, default=str))


def as_text(record: dict) -> str:
    """The record as JSON, which people can read, too."""
    return json.dumps(record, indent=1)


def read_record(path: Path, way_out: str) -> dict | None:
    """What an earlier run wrote, None where there is nothing.

    way_out: what to do about one that is damaged. Raises OutputError for that.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"holds a {type(found).__name__}")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise OutputError(f"{path} is damaged ({error}): {way_out}") from error
    return found


def completed(found: dict, defaults: dict) -> dict:
    """A record with the defaults that it lacks, in the dicts within it too: a run from before an
    option existed had its default."""
    inner = {
        k: completed(v, defaults[k] if isinstance(defaults.get(k), dict) else {})
        for k, v in found.items()
        if isinstance(v, dict)
    }
    return defaults | found | inner


def differences(found: dict, now: dict, but: Collection[str] = ()) -> list[str]:
    """ "seed was 0, now 1" for each setting that differs; "a.b was ..." for one in a dict.

    but: names that may differ."""
    said = []
    for name in sorted({*found, *now} - set(but)):
        was, is_now = found.get(name), now.get(name)
        if isinstance(was, dict) and isinstance(is_now, dict):
            said += [f"{name}.{inner}" for inner in differences(was, is_now)]
        elif was != is_now:
            said.append(f"{name} was {was}, now {is_now}")
    return said


def check_same(found: dict, now: dict, what: str, way_out: str, but: Collection[str] = ()) -> None:
    """Raises OutputError, "{what} (seed was 0, now 1): {way_out}", unless both are the same."""
    if other := differences(found, now, but):
        raise OutputError(f"{what} ({', '.join(other)}): {way_out}")


def make_folder(folder: Path) -> None:
    """Makes it, and its parents. Raises OutputError where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot make this folder ({error.strerror or error}): choose another output"
        ) from error


@contextlib.contextmanager
def alone_in(folder: Path):
    """Makes this folder where it is missing; no other run can write into it meanwhile.

    Raises OutputError where it cannot be made, or another run writes into it."""
    make_folder(folder)
    with locked(folder):
        yield


@contextlib.contextmanager
def side_by_side_in(folder: Path):
    """Likewise for each of several processes that share the work: no run that is `alone_in` it."""
    make_folder(folder)
    with locked(folder, shared=True):
        yield
