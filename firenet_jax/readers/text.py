"""Text -> Source: one event a line, `t x y p`, in .txt, .csv, .tsv, each also as .gz, or a .zip
with one of them.

    240 180                  the sensor's width and height: E2VID and FireNet; none in ECD
    0.003811000 96 133 0     seconds, column, row, polarity 0 or 1 (or -1 or 1, False or True)

Separators are spaces, tabs or commas. Times are seconds; where none of the first rows has a decimal
point they are microseconds, and a notice says so. A line of names (`x,y,p,t`, any order, further
columns are skipped) sets the order of the columns and, where it tells one (`t_us`, `time [ns]`),
the unit of the times; Metavision's `%geometry:1280,720` sets the size and that program's own order.
Lines are counted from 1, header and empty ones included.

Blocks of 2 MB go through pyarrow's parser, which takes half of the time that a zip takes; only a
block that it refuses is read again in Python, to name the line.
"""

import gzip
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Events, Rows
from firenet_jax.readers import Source, reading, to_events
from firenet_jax.settings import LONGEST_SIDE
from firenet_jax.storage.files import check_unpacking

BLOCK = 1 << 21  # bytes parsed at once: about 90,000 events
PIECE = 1 << 16  # bytes asked for at once: what a zip has unpacked of them is lost at damage
HEAD = 1 << 16  # bytes from which the layout is inferred
SUFFIXES = ".txt", ".csv", ".tsv"
SNIFFED = 1000  # rows from which units and the order of columns are inferred
BROKEN = zipfile.BadZipFile, zlib.error, EOFError, OSError  # what damaged compressed bytes raise

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "on"),
}
UNITS = {  # microseconds in a unit: its names
    1e6: ("s", "sec", "secs", "second", "seconds"),
    1e3: ("ms", "msec", "millisecond", "milliseconds"),
    1.0: ("us", "usec", "µs", "μs", "microsecond", "microseconds"),
    1e-3: ("ns", "nsec", "nanosecond", "nanoseconds"),
}
Named = tuple[tuple[str, ...], float | None]  # columns and unit, as in `Layout`
LOGICAL = ("False", "FALSE", "false", "True", "TRUE", "true")  # and 0 and 1: pyarrow's
SIDE = re.compile(r"\d{1,9}", re.ASCII)
ENDS = re.compile(rb"\r\n?|\n")  # of lines, as pyarrow has it
WORDS = "no one two three four five six seven eight nine ten".split()
EXPECTED = {
    "t": ("the time", "a number of seconds"),
    "x": ("x", f"a whole number below {LONGEST_SIDE}"),
    "y": ("y", f"a whole number below {LONGEST_SIDE}"),
    "p": ("the polarity", "0 or 1"),
}


class Layout(NamedTuple):
    """What the first lines say."""

    skip: int  # lines before the first row
    size: tuple[int, int] | None  # (height, width)
    names: tuple[str, ...]  # of the columns, in their order: t, x, y, p, and _i for others
    separator: str
    types: dict[str, pa.DataType]
    unit: float | None  # microseconds in the times' unit; None where no name says it


def matches(path: Path) -> bool:
    name = path.name.lower()
    return path.is_file() and name.removesuffix(".gz").endswith((*SUFFIXES, ".zip"))


def read(path: Path, member: str | None = None, columns: str | None = None) -> Source:
    """member: the file to read in a zip that holds several. columns: their order, as "x,y,p,t"."""
    if path.suffix.lower() == ".zip" and member is None:
        member = _only_text(path)
    if columns is not None and _names(columns.lower()) is None:
        raise RecordingError(f"{path}: columns are {columns!r}, expected an order such as x,y,p,t")
    layout = _sniff(path, member, columns)
    return Source(
        format="text" if member is None else "zipped text",
        events=lambda: _events(path, member, layout),
        size=layout.size,
        place=lambda row: _place(path, member, layout, row),
    )


@contextmanager
def opened(path: Path, member: str | None = None) -> Iterator[Any]:
    """A file, perhaps gzipped, or a file in a zip -> stream of its bytes; damage, while it is open,
    raises RecordingError."""
    with reading(path, *BROKEN), ExitStack() as stack:
        if member is not None:
            with reading(path, Exception):  # a damaged list of members raises every kind
                archive = stack.enter_context(zipfile.ZipFile(path))
                check_unpacking(path, archive, RecordingError)
                stream = stack.enter_context(archive.open(member))
        else:
            compressed = path.suffix.lower() == ".gz"
            stream = stack.enter_context(gzip.open(path) if compressed else open(path, "rb"))
        yield stream


def members(path: Path) -> list[str]:
    """The names of the files in a zip. Raises RecordingError where it is damaged."""
    with reading(path, Exception), zipfile.ZipFile(path) as archive:
        names = [info.filename for info in archive.infolist() if not info.is_dir()]
    return [name for name in names if not name.startswith("__MACOSX/")]


def _only_text(path: Path) -> str:
    names = members(path)
    texts = [name for name in names if name.lower().endswith(SUFFIXES)]
    texts = texts or names[:1] * (len(names) == 1)  # a single file may have any name
    if len(texts) != 1:
        found = ", ".join(texts[:4]) + (", ..." if len(texts) > 4 else "")
        raise RecordingError(
            f"{path}: holds {len(texts)} text files{f' ({found})' if texts else ''} where one is "
            "expected: unpack it and name the recording"
        )
    return texts[0]


def _first_lines(path: Path, member: str | None) -> list[str]:
    with opened(path, member) as stream:
        head = next(_pieces(stream, HEAD), b"")
    lines = head.decode("utf-8-sig", "replace").split("\n")
    if len(head) == HEAD:
        if all(line.strip()[:1] in ("", "#", "%") for line in lines):
            raise RecordingError(
                f"{path}: its first {HEAD:,} bytes are comments: shorten them, if events follow"
            )
        lines.pop()  # cut off
    return lines


def _sniff(path: Path, member: str | None, columns: str | None = None) -> Layout:
    lines = _first_lines(path, member)
    size, names, unit, skip = None, ("t", "x", "y", "p"), None, len(lines)
    told = columns is not None
    if columns is not None and (named := _names(columns.lower())):
        names, unit = named
    for number, line in enumerate(map(str.strip, lines), 1):
        words = _words(line, "," if "," in line else " ")
        if match := re.fullmatch(r"%geometry:(\d{1,9}),(\d{1,9})", line):
            size = int(match[2]), int(match[1])
            names, told = (names if columns else ("x", "y", "p", "t")), True
        elif named := _names(line.lower().lstrip("#% ")):
            if columns is not None:
                named = _agreed(f"{path}, line {number}: {_shown(line)}", columns, named)
            (names, unit), told = named, True
        elif not line or line.startswith(("#", "%")):
            continue
        elif size is None and len(words) == 2 and all(map(SIDE.fullmatch, words)):
            size = (int(words[1]), int(words[0]))
        elif not (_is_number(words[0]) or names[0] == "p" and words[0] in LOGICAL):
            raise RecordingError(
                f"{path}, line {number}: {_shown(line)} where numbers, or the names of columns "
                f"t, x, y and p, are expected: it is not a text of events{_apart(line)}"
            )
        else:
            skip = number - 1
            break
    rows = [line for line in lines[skip:] if line.strip()][:SNIFFED]
    separator = "," if rows and "," in rows[0] else "\t" if rows and "\t" in rows[0] else " "
    rows = [_words(row, separator) for row in rows]
    if not told and (order := _other_order(rows)):
        raise RecordingError(
            f"{path}: its columns look like {order}, not t,x,y,p: pass --columns {order}, or let "
            "the file begin with such a line"
        )

    found = {name: [row[i] for row in rows if i < len(row)] for i, name in enumerate(names)}
    whole = {  # a word that is no number makes its row a bad one, and tells nothing
        name: not any(set(".e") & set(word.lower()) for word in filter(_is_number, found[name]))
        for name in NAMES
    }
    types = {name: pa.int32() if whole[name] else pa.float64() for name in "xyp"}
    polarity = names.index("p")
    if any(row[polarity] in LOGICAL for row in rows[:1] if polarity < len(row)):
        types["p"] = pa.bool_()
    fine = unit is None or unit <= 1  # of seconds, a whole number tells nothing of the next
    types["t"] = pa.int64() if rows and whole["t"] and fine else pa.float64()
    if types["t"] == pa.int64() and unit is None:
        logger.warning("%s: times without a decimal point: read as microseconds", path)
    elif unit is None and len(rows) == SNIFFED and _whole(filter(_is_number, found["t"])):
        logger.warning(
            "%s: times with a decimal point: read as seconds, though whole ones; if they are "
            "microseconds, let the file begin with a line of names, such as t_us x y p", path,
        )  # fmt: skip
    return Layout(skip, size, names, separator, types, unit)


def _agreed(line: str, columns: str, named: Named) -> Named:
    """The names of a line, and its unit or, if it tells none, that of `columns`.

    Raises RecordingError where the two put a column in another place, or differ in the unit.
    """
    told = _names(columns.lower()) or named
    places, others = ([names.index(key) for key in NAMES] for names, _ in (named, told))
    units = {unit for _, unit in (named, told)} - {None}
    if places != others or len(units) > 1:
        raise RecordingError(
            f"{line}, but columns are told to be {columns!r}: leave out --columns, or this line"
        )
    return named[0], units.pop() if units else None


def _apart(line: str) -> str:
    return ", or its columns are not apart by spaces, tabs or commas" if ";" in line else ""


def _names(line: str) -> Named | None:
    """A line of names -> those of `Layout`, and the unit of the times, in microseconds, if told.

    None if t, x, y, p are not all among them.
    """
    known = {name: key for key, names in NAMES.items() for name in names}
    units = {name: unit for unit, names in UNITS.items() for name in names}
    if len(line) > 1000:  # which the pattern below would take long for
        return None
    unit_in_brackets = r"\s*[\[(]\s*([^\s,\[\]()]*)[^\[\]()]*[\])]"
    line = re.sub(unit_in_brackets, r"|\1", line.replace('"', ""))
    words = [word.partition("|") for word in _words(line, "," if "," in line else " ")]
    named = [known.get(name, f"_{i}") for i, (name, _, _) in enumerate(words)]
    told = {i: units.get(in_brackets) for i, (_, _, in_brackets) in enumerate(words)}
    if "t" not in named:  # then `t_us`; the finest, if there are several
        finest = math.inf
        for i, (name, _, _) in enumerate(words):
            stem, _, unit = name.rpartition("_")
            if known.get(stem) == "t" and unit in units and units[unit] < finest:
                told[i] = finest = units[unit]
                named = [f"_{k}" if key == "t" else key for k, key in enumerate(named)]
                named[i] = "t"
    if any(named.count(key) != 1 for key in NAMES):
        return None
    return tuple(named), told[named.index("t")]


def _other_order(rows: list[list[str]]) -> str | None:
    """As `other_order`, of the words of rows."""
    if len(rows) < 5 or any(len(row) != 4 or not all(map(_is_number, row)) for row in rows):
        return None
    return other_order(np.array([[float(word) for word in row] for row in rows]).T)


def other_order(columns: np.ndarray) -> str | None:
    """(4, N) numbers -> "x,y,p,t", say, where no other order is possible: one column alone never
    falls, and exceeds coordinates or has fractions; one alone is 0 and 1 (or -1 and 1). None where
    that is unclear, or the order is t, x, y, p."""
    if not columns.size:
        return None
    signs = [set(column.tolist()) in ({0, 1}, {-1, 1}) for column in columns]
    times = [
        (np.diff(column) >= 0).all()
        and (column.max() >= LONGEST_SIDE or (column != np.rint(column)).any())
        for column in columns
    ]
    if sum(signs) != 1 or sum(times) != 1 or (times[0] and signs[3]):
        return None
    rest = iter("xy")
    named = zip(times, signs, strict=True)
    return ",".join("t" if time else "p" if sign else next(rest) for time, sign in named)


def _whole(seconds: Iterable[float | str]) -> bool:
    different = set(map(float, seconds))
    return len(different) > 1 and all(map(float.is_integer, different))


def warn_of_coarse_times(path: Path, t: np.ndarray, unit: str = "s") -> None:
    """A warning where neighbouring times are more than a microsecond apart as they are stored."""
    if t.dtype in (np.float16, np.float32) and len(t):
        apart = float(np.spacing(np.abs(t[[0, -1]]).max())) * {"ms": 1e3, "us": 1.0}.get(unit, 1e6)
        if apart > 1:
            logger.warning(
                "%s: t is %s, which tells these times apart by %.3g us: pass float64 or whole "
                "microseconds, from before they were rounded", path, t.dtype, apart,
            )  # fmt: skip


def warn_of_whole_seconds(path: Path, t: np.ndarray, remedy: str) -> None:
    """Floating times are seconds; a warning says so where the first of them are whole ones."""
    if t.dtype.kind == "f" and len(t) and _whole(t[:SNIFFED].tolist()):
        logger.warning(
            "%s: floating times: read as seconds, though whole ones; if they are microseconds, %s",
            path, remedy,
        )  # fmt: skip


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return word.isascii() and "_" not in word  # float() takes other digits and 1_000, too


def _words(line: str, separator: str) -> list[str]:
    return [word.strip() for word in line.split(",")] if separator == "," else line.split()


def _pieces(stream: Any, size: int) -> Iterator[bytes]:
    """So many bytes at a time. An error of `BROKEN` is raised after the bytes that precede it."""
    error, found = None, b"."
    while found:
        pieces, missing = [], size
        while missing and found:
            try:
                found = stream.read1(min(missing, PIECE))
            except BROKEN as damage:  # kept: asked again, a zip would say that it has ended
                error, found = damage, b""
            pieces.append(found)
            missing -= len(found)
        if missing < size:
            yield b"".join(pieces)
    if error is not None:
        raise error


def _blocks(path: Path, member: str | None, skip: int) -> Iterator[tuple[int, bytes]]:
    """(number of its first line, whole lines), without the header."""
    number, rest = 1, b""
    with opened(path, member) as stream:
        for data in _pieces(stream, BLOCK):
            end = data.rfind(b"\n") + 1
            if not end and len(rest) > HEAD:
                raise RecordingError(
                    f"{path}, line {number}: does not end: it is not a text of events"
                )
            block, rest = rest + data[:end], data[end:] if end else rest + data
            if not end:
                continue
            if number == 1:
                block = block.removeprefix(b"\xef\xbb\xbf")  # the byte order mark of Windows
                block, number = block.split(b"\n", skip)[-1], 1 + skip
            yield number, block
            # bytes.count takes four times as long, 7 % of all reading.
            number += int(np.count_nonzero(np.frombuffer(block, np.uint8) == ord("\n")))
    if rest and (number > 1 or not skip):  # the last line may lack its end
        yield number, rest.removeprefix(b"\xef\xbb\xbf")


def _events(path: Path, member: str | None, layout: Layout) -> Iterator[Events | Rows]:
    only_events = set(layout.names) == set("txyp")
    for number, block in _blocks(path, member, layout.skip):
        if not block or block.isspace():
            continue
        place = partial(_line, number, block)
        if only_events and (b"x" in block or b"X" in block):  # 0x10, a number for pyarrow
            yield _sorted_out(path, number, block, layout, place)
            continue
        try:
            try:
                table = _table(block, layout)
            except pa.ArrowInvalid:
                # once more with single spaces between words: rare, and it costs a third of the time
                table = _table(_tidied(block, layout.separator), layout)
        except pa.ArrowInvalid:
            yield _sorted_out(path, number, block, layout, place)
            continue
        yield to_events(path, 0, *_columns(table, layout), place=place)


def _columns(table: pa.Table, layout: Layout) -> list[np.ndarray]:
    """t, x, y, p; times in microseconds where they are whole numbers, else in seconds."""
    t, *others = (table[name].to_numpy() for name in "txyp")
    if layout.unit is not None and t.dtype.kind == "f":
        t = t * (layout.unit / 1e6)
    elif layout.unit not in (None, 1):
        t = t // 1000
    return [t, *others]


def _table(block: bytes, layout: Layout) -> pa.Table:
    return pyarrow.csv.read_csv(
        pa.BufferReader(block),
        # One thread: the device needs the cores, and the memory that two threads need varies.
        pyarrow.csv.ReadOptions(column_names=layout.names, use_threads=False),
        pyarrow.csv.ParseOptions(delimiter=layout.separator, quote_char=False),
        pyarrow.csv.ConvertOptions(
            column_types=layout.types, include_columns=list("txyp"), null_values=[]
        ),
    )


def numbers(lines: bytes) -> np.ndarray | None:
    """Lines of four numbers with a space between them -> (N, 4) float64; None for any others."""
    kinds = dict.fromkeys("txyp", pa.float64())
    try:
        table = pyarrow.csv.read_csv(
            pa.BufferReader(lines),
            pyarrow.csv.ReadOptions(column_names=list(kinds), use_threads=False),
            pyarrow.csv.ParseOptions(delimiter=" ", quote_char=False),
            pyarrow.csv.ConvertOptions(column_types=kinds, null_values=[]),
        )
    except pa.ArrowInvalid:
        return None
    return np.stack([table[name].to_numpy() for name in kinds], 1)


def _tidied(block: bytes, separator: str) -> bytes:
    """Any run of spaces and tabs -> one separator between words, none at the ends of a line; no
    word begins with a plus, which pyarrow takes for no number."""
    block = block.replace(b"\r\n", b"\n").replace(b"\t", b" ")
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    block = block.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
    block = block.replace(b", ", b",").replace(b" ,", b",")  # pyarrow trims numbers, not True
    if b"+-" not in block:  # no number, and would become one
        for before in (b" ", b",", b"\n"):
            block = block.replace(before + b"+", before)
        block = block.removeprefix(b"+")
    return block if separator == "," else block.replace(b" ", separator.encode())


def _sorted_out(
    path: Path, number: int, block: bytes, layout: Layout, place: Callable[[int], str]
) -> Rows:
    """A block with lines that are no events -> Rows, line by line in Python, which is slow."""
    good, bad, first_fault = [], [], ""
    text = ENDS.sub(b"\n", block).decode("utf-8", "replace")
    for line in filter(None, map(str.strip, text.split("\n"))):
        fault = _fault(line, layout)
        if fault and not first_fault:
            first_fault = f"{path}, {place(len(bad))}: {fault}"
        bad.append(bool(fault))
        good += [] if fault else [line]
    columns = [[]] * 4
    try:
        if good:
            rows = _tidied("\n".join(good).encode(), layout.separator)
            columns = _columns(_table(rows, layout), layout)
        if not first_fault or len(columns[0]) != len(good):
            raise pa.ArrowInvalid("the parser refuses lines that look right")
    except pa.ArrowInvalid as error:
        raise RecordingError(
            f"{path}, in the lines from {number}: not rows of t x y p ({_shown(str(error))})"
        ) from error
    bad = np.array(bad)
    everything = []
    for column in map(np.asarray, columns):  # bad rows are zero
        everything.append(np.zeros(len(bad), column.dtype))
        everything[-1][~bad] = column
    rest = to_events(path, 0, *everything, place=place)
    if isinstance(rest, Events):
        return Rows(rest, bad, RecordingError(first_fault))
    earlier = np.argmax(rest.bad) < np.argmax(bad)
    return Rows(rest.events, bad | rest.bad, rest.error if earlier else RecordingError(first_fault))


def _fault(line: str, layout: Layout) -> str:
    """What is wrong with a line; empty where it is an event."""
    words, columns = _words(line, layout.separator), len(layout.names)
    if len(words) != columns:
        return f"{_count(len(words))} instead of {_count(columns, '')}: {_shown(line)}"
    for name, word in zip(layout.names, words, strict=True):
        if name in EXPECTED and not _fits(word, layout.types[name]):
            what, expected = EXPECTED[name]
            if name == "t" and layout.types["t"] == pa.int64():
                expected = "whole microseconds, as in the first lines"
            if name == "p" and layout.types["p"] == pa.bool_():
                expected = "False or True, as in the first lines"
            return f"{what} is {_shown(word)[1:-1]}, expected {expected}"
    return ""


def _fits(word: str, kind: pa.DataType) -> bool:
    if kind == pa.float64():
        return _is_number(word)
    if kind == pa.bool_():
        return word in (*LOGICAL, "0", "1")
    limit = 2 ** (kind.bit_width - 1)
    return re.fullmatch(r"[-+]?[0-9]{1,19}", word) is not None and -limit <= int(word) < limit


def _count(number: int, noun: str = " words") -> str:
    number_in_words = WORDS[number] if number < len(WORDS) else str(number)
    return number_in_words + (noun.rstrip("s") if number == 1 else noun)


def _shown(line: str) -> str:
    line = line.strip()
    return repr(line if len(line) <= 60 else line[:57] + "...")


def _filled(block: bytes) -> list[int]:
    """The lines of a block that are not empty: pyarrow's rows."""
    return [i for i, line in enumerate(ENDS.split(block)) if line.strip()]


def _line(number: int, block: bytes, row: int) -> str:
    return f"line {number + _filled(block)[row]}"


def _place(path: Path, member: str | None, layout: Layout, row: int) -> str:
    """Reads the file again up to that row: for an error message, of which there is one."""
    for number, block in _blocks(path, member, layout.skip):
        rows = len(_filled(block))
        if row < rows:
            return _line(number, block, row)
        row -= rows
    return "its last line"
