"""A file of times, a rate, triggers or frames -> times in microseconds on a recording's clock.

A file of times has one time per line, in its first column or in the one that a header line names
time, t or timestamp. Unit and origin are given by an option, after a number (`33.3ms`) or in the
header (`#timestamp [ns]`); otherwise those are taken for which most times lie within the recording
and cover most of it, and a notice says which.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np

from firenet_jax.errors import RecordingError, SettingsError, logger
from firenet_jax.events import MAX_TIME, Events, Recording, counted
from firenet_jax.instants import Grid, check_rate, grid
from firenet_jax.readers import text
from firenet_jax.settings import check_refined
from firenet_jax.storage.files import read_lines

UNITS = {"s": 10**6, "ms": 10**3, "us": 1, "ns": Decimal("0.001")}  # microseconds
UNIT_OF = {name: names[0] for names in text.UNITS.values() for name in names}
UNIT_NAMES = {names[0]: names[-1] for names in text.UNITS.values()}  # "ms": "milliseconds"
COLUMN = re.compile(r"t|time|timestamps?|stamps?")  # without its unit
# Of a column, in a header line.
NAME = re.compile(r"""(?<![\w.:+-])(?!(?:nan|inf)\b)[a-z_][a-z_0-9]*(?:[\s,;:\[("']|$)""")
NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d{1,4000})?)\s*([a-zµμ]*)", re.IGNORECASE)
SPLIT = re.compile(r"[\s,;]+")
REFINED = {
    "from_zero": "rate",
    "unit": "at",
    "since": "at",
    "trigger_edges": "triggers",
    "trigger_input": "triggers",
}


@dataclass(frozen=True)
class Times:
    """Images at given times instead of one per window. Of --rate, --at, --between-frames
    and --triggers, choose at most one."""

    rate: float | None = None
    """Images per second, from the first event on."""
    from_zero: bool = False
    """With --rate: count from time 0 of the recording's clock instead of the first event."""
    at: Path | None = None
    """Images at the times in this file, one per line."""
    unit: Literal["s", "ms", "us", "ns"] | None = None
    """With --at: unit of the times, if the file does not state it."""
    since: Literal["start", "zero"] | None = None
    """With --at: whether times count from the first event (start) or are on the recording's clock
    (zero). Default: whichever fits."""
    between_frames: bool = False
    """Images at the times of the camera's frames."""
    triggers: bool = False
    """Images at the edges of the camera's trigger inputs."""
    trigger_edges: Literal["rising", "falling", "both"] = "rising"
    """With --triggers: which edges."""
    trigger_input: int | None = None
    """With --triggers: only this input."""

    def __post_init__(self):
        ways = [self.rate, self.at, self.between_frames or None, self.triggers or None]
        if sum(way is not None for way in ways) > 1:
            raise SettingsError(
                "images are wanted in one way: choose one of --rate, --at, --between-frames and "
                "--triggers"
            )
        if self.rate is not None:
            check_rate(self.rate)
        check_refined(self, REFINED)

    @property
    def wanted(self) -> bool:
        return bool(self.rate or self.at or self.between_frames or self.triggers)

    def in_words(self) -> str:
        """ "images at 30 per second" """
        if self.rate is not None:
            return f"images at {self.rate:g} per second"
        what = "the times of its frames" if self.between_frames else "its triggers"
        return f"images at {f'the times of {self.at.name}' if self.at else what}"


def times_of(
    wanted: Times, recording: Recording, chunks: Iterable[Events]
) -> np.ndarray | Grid | None:
    """The times of the images, in order; None: one image per window.

    chunks: its events after filters in time, the first of which a rate counts from. The times of a
    file count from the recording's first event, whatever part is asked for; to determine their unit
    it is read to its end.
    Raises RecordingError for an invalid file of times, and for a recording without frames or
    triggers.
    """
    if not wanted.wanted:
        return None
    if wanted.rate is not None:
        first = next((int(events.t[0]) for events in chunks if len(events)), None)
        if first is None:
            raise RecordingError(f"{recording.path}: no events, or none that the filters let pass")
        return grid(first, wanted.rate, wanted.from_zero)
    if wanted.between_frames:
        if recording.frames is None or not len(recording.frames.times):
            raise RecordingError(
                f"{recording.path}: has no frames whose times could be taken: use --rate or --at"
            )
        return np.unique(np.asarray(recording.frames.times, np.int64))
    if wanted.at is not None:
        return _from_file(wanted.at, wanted, recording)
    return _triggers(wanted, recording)


def _triggers(wanted: Times, recording: Recording) -> np.ndarray:
    if (found := recording.triggers()) is None:
        raise RecordingError(
            f"{recording.path}: holds no triggers that its reader knows: use --rate or --at"
        )
    times, inputs, rising = (np.asarray(column) for column in found)
    keep = np.ones(len(times), bool)
    if wanted.trigger_edges != "both":
        keep &= rising.astype(bool) == (wanted.trigger_edges == "rising")
    if wanted.trigger_input is not None:
        keep &= inputs == wanted.trigger_input
    if not keep.any():
        there = ", ".join(map(str, np.unique(inputs).tolist()))
        raise RecordingError(
            f"{recording.path}: none of its {counted(len(times), 'trigger')} (inputs {there}) is "
            "asked for: choose --trigger-edges and --trigger-input as they are"
        )
    return np.unique(times[keep].astype(np.int64))


# ---- A file of times


def _from_file(path: Path, wanted: Times, recording: Recording) -> np.ndarray:
    numbers, unit, since_start = read_times(path)
    if wanted.unit and unit and unit != wanted.unit:
        logger.warning(
            "%s: says that its times are in %s, --unit takes them as %s",
            path, UNIT_NAMES[unit], UNIT_NAMES[wanted.unit],
        )  # fmt: skip
    unit = wanted.unit or unit
    since_start = since_start if wanted.since is None else wanted.since == "start"
    units = [unit] if unit else [*UNITS] if whole_numbers(numbers) else ["s", "ms"]
    origins = [False, True] if since_start is None else [since_start]
    first, last = _span(recording.events(), whole=len(units) * len(origins) > 1)
    if first is None:
        raise RecordingError(f"{recording.path}: holds no events")

    # Of a finer unit more times always lie within the recording: all in its first instant.
    found = []
    for name in units:
        scaled = _scaled(numbers, name)
        for relative in origins:
            times = scaled + first if relative else scaled
            inside = np.unique(times[(times >= first) & (times <= last)])
            span = np.ptp(inside) if len(inside) > 1 else (inside - first).sum()
            covered = float(span) / max(last - first, 1)
            found.append((inside.size / times.size * covered, inside.size, times, name, relative))
    _, inside, times, name, relative = max(found, key=lambda one: one[:2])  # of equals the first
    if len(units) * len(origins) > 1:
        if not inside:
            raise RecordingError(
                f"{path}: none of its {counted(len(times), 'time')} lies within the "
                f"recording, {first / 1e6:.6f} to {last / 1e6:.6f} s: name the unit with --unit, "
                "and with --since start that they count from the first event"
            )
        logger.warning(
            "%s: its %s are taken as %s, %s (--unit and --since say it otherwise)",
            path, counted(len(times), "time"), UNIT_NAMES[name],
            "since the first event" if relative else "on the recording's clock",
        )  # fmt: skip
    if (np.diff(times) < 0).any():
        logger.warning("%s: its times are not in order, the images will be", path)
    if again := len(times) - len(once := np.unique(times)):
        logger.warning("%s: %s of before: one image each", path, counted(again, "time"))
    return once


def whole_numbers(numbers: list[str]) -> bool:
    """Whether none has a fraction: 33333, 33333.0 and 1.0e+06 have none."""

    def whole(number: str) -> bool:
        digits, _, exponent = number.lower().partition("e")
        fraction = digits.partition(".")[2].rstrip("0")
        return len(fraction) <= int(exponent or 0)

    return all(map(whole, numbers))


def read_times(path: Path) -> tuple[list[str], str | None, bool | None]:
    """A file -> (numbers as written, unit, whether they count from the start); None for what it
    does not state. Raises RecordingError, which names the invalid line."""
    numbers, unit, since_start, column = [], None, None, 0
    for number, line in enumerate(read_lines(path, "list of times"), 1):
        line = line.strip()
        if not line:
            continue
        fields = SPLIT.split(line)
        found = NUMBER.fullmatch(fields[column]) if column < len(fields) else None
        if not numbers and (line.startswith("#") or found is None and NAME.search(line.lower())):
            column, unit, since_start = _header(line, column, unit, since_start)
            continue
        if line.startswith("#"):
            continue
        behind = found[2].lower() if found else None
        if behind == "" and len(fields) == 2 and fields[1].lower() in UNIT_OF:  # "33.3 ms"
            behind = fields[1].lower()
        if found is None or (behind and behind not in UNIT_OF):
            raise RecordingError(
                f"{path}, line {number}: expected a time, found {line[:40]!r}: write one a line"
            )
        if behind and UNIT_OF[behind] != (unit or UNIT_OF[behind]):
            raise RecordingError(f"{path}, line {number}: is in {behind}, but before it in {unit}")
        if behind and numbers and unit is None:
            raise RecordingError(f"{path}, line {number}: names a unit, but those before do not")
        unit = UNIT_OF[behind] if behind else unit
        numbers.append(found[1])
    if not numbers:
        raise RecordingError(f"{path}: holds no times: write one a line")
    return numbers, unit, since_start


def _header(line: str, column: int, unit: str | None, since_start: bool | None):
    """A header line -> (column of the time, unit, whether times count from the start)."""
    words = line.lstrip("#").strip().lower()
    if re.search(r"since (the )?(start|first event|beginning)|relative", words):
        since_start = True
    elif re.search(r"absolute|unix|epoch", words):
        since_start = False
    joined = re.sub(r"\s*[\[(]\s*(\w+)\s*[\])]", r"_\1", words)  # timestamp [ns] -> timestamp_ns
    for place, name in enumerate(SPLIT.split(joined)):
        stem, _, behind = name.rpartition("_")
        if behind in UNIT_OF and COLUMN.fullmatch(stem):
            return place, UNIT_OF[behind], since_start
        if COLUMN.fullmatch(name):
            column = place
    named = {UNIT_OF[word] for word in re.findall(r"\w+", words) if word in UNIT_OF}
    return column, named.pop() if len(named) == 1 else unit, since_start


def _scaled(numbers: list[str], unit: str) -> np.ndarray:
    """Decimal numbers -> int64 microseconds, correctly rounded; at most MAX_TIME from 0."""

    def scaled(number: str) -> int:
        try:
            time = Decimal(number) * UNITS[unit]
        except ArithmeticError:  # an exponent of millions
            return 0 if "e-" in number.lower() else MAX_TIME
        return int(min(max(time.to_integral_value(), -MAX_TIME), MAX_TIME))

    return np.array([scaled(number) for number in numbers], np.int64)


def _span(chunks: Iterable[Events], whole: bool) -> tuple[int | None, int]:
    """The times of the first event and, if `whole`, of the last event before any damage."""
    first, last = None, MAX_TIME
    try:
        for events in chunks:
            first = int(events.t[0]) if first is None else first
            if not whole:
                break
            last = int(events.t[-1])
    except RecordingError:
        if first is None:
            raise
    return first, last
