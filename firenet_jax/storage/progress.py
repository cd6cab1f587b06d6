"""What is done -> a bar with percent and the time left; without a terminal a line every minute."""

import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

SECONDS_PER_LINE = 60.0  # seconds between two lines where there is no terminal
LINE = "{desc}{percentage:.0f} %, {elapsed} passed, {remaining} left, {rate_fmt}{postfix}"
LINE_OF_UNKNOWN = "{desc}{n_fmt} {unit}, {elapsed} passed, {rate_fmt}{postfix}"


class _Lines(tqdm):
    """For logs: no line before the first minute is over, none that overwrites another."""

    def __init__(self, *args, **choices):
        self.said = time.monotonic()
        known = choices.get("total") is not None
        choices |= {"bar_format": LINE if known else LINE_OF_UNKNOWN}
        choices |= {"mininterval": SECONDS_PER_LINE}
        super().__init__(*args, **choices, miniters=1, maxinterval=math.inf, file=sys.stderr)

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        if time.monotonic() - self.said >= SECONDS_PER_LINE:
            self.said = time.monotonic()
            print(f"firenet: {msg or self}", file=sys.stderr, flush=True)
        return True

    def close(self) -> None:
        """Without tqdm's last line: commands print their own."""
        if not getattr(self, "disable", True):  # not there if it was interrupted early
            self.disable = True
            self._decr_instances(self)  # pyright: ignore[reportAttributeAccessIssue]


def bar(total: float | None, unit: str, quiet: bool = False, **choices) -> tqdm:
    """A bar of tqdm on a terminal, lines elsewhere. total: None where it is not known; quiet: shows
    nothing; choices: further arguments of tqdm."""
    kind = tqdm if quiet or sys.stderr.isatty() else _Lines
    return kind(total=total, unit=unit, disable=quiet, **choices)


def one_done(progress: tqdm, first: bool) -> None:
    """Counts one; the time of the first, as of compiling, says nothing of the time left."""
    if not first:
        progress.update()
        return
    progress.n += 1
    progress.initial = progress.last_print_n = progress.n
    progress.unpause()


class Bytes:
    """How far this process has read some files, whatever library reads them: from the positions of
    open files, which Linux tells; elsewhere `total` is None."""

    def __init__(self, paths: Sequence[Path]):
        self.sizes = {}
        for path in map(_largest, paths):
            if path is not None and os.path.isdir("/proc/self/fdinfo"):
                self.sizes[str(path.resolve())] = path.stat().st_size
        self.reached = dict.fromkeys(self.sizes, 0)

    @property
    def total(self) -> int | None:
        return sum(self.sizes.values()) or None

    def read(self) -> int:
        """Bytes up to the farthest position in each file, summed."""
        for number in os.listdir("/proc/self/fd") if self.sizes else ():
            try:
                name = os.readlink(f"/proc/self/fd/{number}")
                if name in self.sizes:
                    with open(f"/proc/self/fdinfo/{number}") as file:
                        place = int(file.readline().split()[1])  # pos: 123
                    self.reached[name] = max(self.reached[name], min(place, self.sizes[name]))
            except (OSError, ValueError, IndexError):  # closed meanwhile
                continue
        return sum(self.reached.values())


def _largest(path: Path) -> Path | None:
    """The file itself; of a folder the one that holds the events."""
    if path.is_file():
        return path
    files = [entry for entry in path.iterdir() if entry.is_file()]
    return max(files, key=lambda entry: entry.stat().st_size, default=None)
