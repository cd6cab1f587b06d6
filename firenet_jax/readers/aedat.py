"""The header of an AEDAT file -> its version, its lines of text, the sensor that a line names.

#!AER-DAT2.0\r\n       the first line says which format it is: aedat2.py, aedat3.py, aedat4.py
# any text\r\n         further lines start with #; 3.1 ends them with #!END-HEADER, and recent
                       jAER with #End Of ASCII Header; else they end where no such line follows
"""

import re
from io import BufferedReader
from pathlib import Path

LINE = 1 << 16  # bytes of a line at most
END = r"#\s*(!END-HEADER|End Of ASCII Header)"
SUFFIXES = ".aedat", ".aedat2", ".aedat3", ".aedat4"

# The sensors of jAER, cAER and libcaer, by a part of their names: (height, width).
SENSORS = {
    r"dvs132s": (104, 132),
    r"davis240|dvs240|sbret": (180, 240),
    r"davis346|dvs346|346": (260, 346),
    r"davis208": (192, 208),
    r"dvxplorer.?lite|dvs.?xplorer.?lite": (240, 320),
    r"davis640|davisrgb|cdavis|dvs640|xplorer|samsung": (480, 640),
    r"davis128|dvs128|tmpdiff128|edvs": (128, 128),
}


def version(path: Path) -> str | None:
    """ "2.0", "3.1" or "4.0" as the first bytes say; None if they do not, or for other suffixes."""
    if not path.is_file() or path.suffix.lower() not in SUFFIXES:
        return None
    with open(path, "rb") as file:
        found = re.match(rb"#!AER-DAT(\d\.\d)", file.read(16))
    return found[1].decode() if found else None


def read_header(file: BufferedReader) -> list[str]:
    """The lines that start with #, without their ends; leaves the file at the first byte after
    them. An event may begin with the byte of #, too: the control characters in it tell."""
    lines = []
    while file.peek(1)[:1] == b"#":
        start = file.tell()
        line = file.readline(LINE)
        if not line.endswith(b"\n") or re.search(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", line):
            file.seek(start)
            break
        lines.append(line.decode("utf-8", "replace").rstrip("\r\n"))
        if re.match(END, lines[-1]):
            break
    return lines


def sensor_size(name: str) -> tuple[int, int] | None:
    """ "eu.seebetter.ini.chips.davis.DAVIS240C" -> (180, 240); None for other sensors"""
    name = name.rpartition(".")[2].lower()
    return next((size for part, size in SENSORS.items() if re.search(part, name)), None)


def is_grey(name: str) -> bool:
    """Whether no sensor of this name has a colour filter array."""
    return re.search(r"dvs|davis240|sbret|xplorer", name.rpartition(".")[2].lower()) is not None
