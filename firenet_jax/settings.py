"""What a user passes -> checked, parsed values, or an error that says what is wrong with it."""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, overload

from firenet_jax.errors import SettingsError

LONGEST_SIDE = 2**15  # pixels; coordinates are int16
MOST_PIXELS = 2**24  # of a sensor: several times as many as any has


@overload
def parse_size(text: str) -> tuple[int, int]: ...
@overload
def parse_size(text: str | None) -> tuple[int, int] | None: ...
def parse_size(text: str | None) -> tuple[int, int] | None:
    """ "240x180" -> (height, width) = (180, 240); None stays None. Raises SettingsError."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    # Python makes no number of more than 4,300 digits.
    if not all(side.isdecimal() and len(side) <= 20 and int(side) for side in (width, height)):
        raise SettingsError(f"sensor size {text[:60]!r}: expected WIDTHxHEIGHT, such as 240x180")
    if max(int(width), int(height)) > LONGEST_SIDE:
        raise SettingsError(f"sensor size {text}: a side is at most {LONGEST_SIDE} pixels")
    _check_pixels(text, int(height) * int(width))
    return int(height), int(width)


def sides(size: tuple[int, int] | str | None) -> tuple[int, int] | None:
    """(height, width), or "WIDTHxHEIGHT" -> (height, width). Raises SettingsError."""
    if size is None or isinstance(size, str):
        return parse_size(size)
    try:
        height, width = map(int, size)
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        height = width = whole = 0
    if not (whole and 0 < min(height, width) and max(height, width) <= LONGEST_SIDE):
        raise SettingsError(f'sensor size {size}: expected (height, width), or "WIDTHxHEIGHT"')
    _check_pixels(size, height * width)
    return height, width


def _check_pixels(size: Any, pixels: int) -> None:
    if pixels > MOST_PIXELS:
        raise SettingsError(f"sensor size {size}: a sensor has at most {MOST_PIXELS:,} pixels")


def check_seed(seed: int) -> None:
    """Raises SettingsError unless jax, numpy and grain all accept this seed."""
    if not 0 <= seed < 2**32:
        raise SettingsError(f"seed is {seed}, but must be 0 or more, and less than 2^32")


def check_share(name: str, share: float, of: str) -> None:
    """Raises SettingsError unless this is a share of all `of`."""
    if not 0 <= share <= 1:
        raise SettingsError(f"{name} is {share}, but must be a share of the {of}, from 0 to 1")


def check_sizes(settings: Any, *names: str, zero: bool = False) -> None:
    """Raises SettingsError unless these fields are finite and more than 0 (zero: or 0), or None."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not (0 < value < math.inf or zero and value == 0):
            least = "0 or more" if zero else "more than 0"
            finite = " and finite" if value == math.inf else ""
            raise SettingsError(f"{name} is {value}, but must be {least}{finite}")


def check_none_idle(settings, names: Iterable[str], where: str) -> None:
    """Raises SettingsError for those of these options, or of the options in them, that are not at
    their defaults: they have no effect there."""
    idle = []
    for name in names:
        now, default = getattr(settings, name), getattr(type(settings), name)
        if dataclasses.is_dataclass(default):
            inner = (field.name for field in dataclasses.fields(default))
            idle += [n for n in inner if getattr(now, n) != getattr(default, n)]
        elif now != default:
            idle.append(name)
    if idle:
        said = ", ".join(idle).replace("_", "-")
        them = "it" if len(idle) == 1 else "them"
        raise SettingsError(f"{said}: no effect with {where}: leave {them} out")


def check_refined(
    settings: Any, needs: dict[str, str], is_on: Callable[[Any], bool] = bool
) -> None:
    """Raises SettingsError for an option that only refines another one which is off.

    needs: option -> the one that it refines, both as the fields are named."""
    for name, needed in needs.items():
        changed = getattr(settings, name) != getattr(type(settings), name)
        if changed and not is_on(getattr(settings, needed)):
            more, option = name.replace("_", "-"), needed.replace("_", "-")
            raise SettingsError(f"--{more} has no effect without --{option}: pass that, too")


def check_range(name: str, bounds: tuple[float, float]) -> None:
    """Raises SettingsError unless a number can be drawn log-uniformly between these bounds."""
    least, greatest = bounds
    if not (0 < least <= greatest and math.isfinite(greatest)):
        raise SettingsError(
            f"{name} is {least:g} {greatest:g}, but is drawn log-uniformly: "
            "both must be more than 0, the least first"
        )


def check_arrays(**arrays) -> None:
    """Raises TypeError for lists and the like; None is nothing to check."""
    for name, array in arrays.items():
        if array is not None and not hasattr(array, "shape"):
            raise TypeError(f"{name} is a {type(array).__name__}: pass an array")
