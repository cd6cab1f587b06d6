"""What is written -> files that are whole: each is made under a name beside its own, then renamed.

Files of our own that an earlier run left are read with the same care: whatever is wrong with one,
the error names it.
"""

import contextlib
import io
import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from firenet_jax.errors import OutputError, RecordingError

LARGEST_TEXT = 1 << 28  # bytes of a list of times or of pixels


def named(path: Path) -> Path:
    """The path with a last part that is a name: `.` and `..` are resolved, links are not."""
    return path.resolve() if path.name in ("", "..") else path


def partial_name(path: Path) -> Path:
    """Where an output is made: `video.mp4` -> `video.partial.mp4`, `out` -> `out.partial`.

    Raises OutputError for a name of this kind: the output without `.partial` would replace it.
    """
    if path.suffix == ".partial" or path.stem.endswith(".partial"):
        raise OutputError(
            f"{path}: .partial names what is not finished: choose an output (of several "
            "recordings: a recording) of another name"
        )
    return path.with_name(f"{path.stem}.partial{path.suffix}")


Noted = Callable[[Path], None]


def no_note(made: Path) -> None:
    """What writers call by default with what they have made, whole, before it gets its name."""


def identity(path: Path) -> list:
    """[name, bytes, time of the last change in ns], ready for JSON: it differs for other content.

    Of a folder: all bytes and the last change of the files in it and in its `images`, as its own
    time does not change when one of them is written anew. Its other folders may hold output.
    """
    kept = [path] if path.is_file() else [*path.iterdir(), *path.glob("images/*")]
    states = [file.stat() for file in kept if file.is_file()]
    changed = max((state.st_mtime_ns for state in states), default=0)
    return [path.name, sum(state.st_size for state in states), changed]


def check_readable(path: Path, error: type[ValueError] = OutputError) -> None:
    """Raises `error` where the user may not read a file or list a folder.

    Call it before a library opens the file: libraries call such a file damaged, or do not name it.
    """
    try:
        if path.is_dir():
            os.scandir(path).close()
        elif path.is_file():  # opening a pipe would take from it
            open(path, "rb").close()
    except PermissionError as refusal:
        raise error(forbidden(refusal.filename or path)) from refusal


def files_in(folder: Path) -> Iterator[Path]:
    """The files in a folder and in folders below it, also those that links lead to, each once; no
    pipes and devices, for which a reader would wait."""
    seen = set()
    for at, folders, names in os.walk(folder, followlinks=True):
        if (place := os.path.realpath(at)) in seen:
            folders.clear()
            continue
        seen.add(place)
        found = (Path(at) / name for name in names)
        yield from (path for path in found if path.is_file() or not path.exists())


def check_no_pipe(path: Path, error: type[ValueError] = OutputError) -> None:
    """Raises `error` for a pipe or device, which is empty when it is read a second time."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise error(f"{path}: is a pipe or device, but is read more than once: make it a file")


def forbidden(path: str | Path) -> str:
    """The message for a path that the user has no permission for."""
    return (
        f"{path}: permission denied: give yourself the right to it (chmod u+rwX), or use a copy or "
        "place that is yours"
    )


def check_apart(output: Path, inputs: Iterable[Path]) -> None:
    """Raises OutputError if an input is this output or lies in it, as it would be replaced."""
    for path in inputs:
        with contextlib.suppress(OSError, RuntimeError):  # a loop of links is reported elsewhere
            same = output.exists() and path.exists() and output.samefile(path)
            if same or path.resolve().is_relative_to(output.resolve()):
                where = "is" if same else "holds"
                raise OutputError(
                    f"{output}: {where} a recording that is read ({path}): choose another output"
                )


@contextlib.contextmanager
def writing(path: Path):
    """Turns an OSError (a full disk, say) into an OutputError that names the output, and the file
    concerned if that is another one."""
    try:
        yield
    except OSError as error:
        where = "" if error.filename in (None, path, str(path)) else f", {error.filename}"
        raise OutputError(
            f"{path}: cannot write ({_reason(error)}{where}): nothing is under this "
            "name yet; make room or choose another output"
        ) from error


def _reason(error: OSError) -> str:
    """What the system says: HDF5 puts it amid two lines with the time and an address in memory."""
    text = error.strerror or str(error)
    told = re.search(r"error message = '([^']+)'", text)
    return told[1] if told else " ".join(text.split())


def lock(handle: int, path: Path, shared: bool = False) -> None:
    """Locks an open file or folder until it is closed or its process ends, even by a kill.

    shared: others may lock it so, too, but none for itself.

    Raises OutputError, which names `path`, where another run has locked it. Does nothing where
    there are no such locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(
            f"{path}: another run is writing it: wait for that, or choose another output"
        ) from None
    except OSError:  # some network disks
        return


def open_alone(beside: Path, path: Path) -> io.FileIO:
    """The file in the making of `path`, open and empty; no other run can write it meanwhile.

    Raises OutputError where another run is writing it or has just written it."""
    beside.touch()
    opened = beside.open("r+b", buffering=0)  # "w+b" would empty another run's
    try:
        lock(opened.fileno(), path)
        if not (beside.exists() and os.path.samestat(os.fstat(opened.fileno()), beside.stat())):
            raise OutputError(f"{path}: another run has just written it: choose another name")
        opened.truncate(0)
    except BaseException:
        opened.close()
        raise
    return opened


def read_lines(path: Path, what: str) -> list[str]:
    """The lines of a small text file. Raises RecordingError, which says that it is no `what`."""
    check_readable(path, RecordingError)
    check_no_pipe(path, RecordingError)
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise RecordingError(f"{path}: is larger than {LARGEST_TEXT >> 20} MB: no {what}")
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise RecordingError(f"{path}: cannot read this {what}: {reason}") from error


def check_unpacking(path: Path, archive: zipfile.ZipFile, error: type[ValueError]) -> None:
    """Raises `error` where a member is compressed by bzip2 or LZMA: Python unpacks such a piece
    whole, whatever size the archive states, so that a few bytes could take all memory."""
    for info in archive.infolist():
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise error(
                f"{path}: {info.filename!r} is compressed by another method than deflate, which is "
                "not read: pack it anew, or unpack it"
            )


def publish(held: io.FileIO, beside: Path, path: Path) -> None:
    """Gives the file beside an output, which is whole and locked, the output's name."""
    if os.name == "nt":  # an open file cannot be renamed there, and has no lock
        held.close()
    beside.replace(path)
    held.close()


def discard(held: io.FileIO, beside: Path) -> None:
    """Removes the file beside an output, which is not whole."""
    if os.name == "nt":
        held.close()
    beside.unlink(missing_ok=True)
    held.close()


def remove_left(beside: Path) -> None:
    """Removes the file in the making that a killed run left, but not one that is being written."""
    try:
        opened = beside.open("rb")
    except FileNotFoundError:
        return
    with opened, contextlib.suppress(OutputError):
        lock(opened.fileno(), beside)
        if os.name == "nt":  # an open file cannot be removed there, and has no lock
            opened.close()
        beside.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(folder: Path, name: Path | None = None, shared: bool = False):
    """No other run can lock this folder meanwhile. Raises OutputError where one has.

    name: what the error calls it. shared: others that share it may."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except PermissionError:  # Windows opens no folders
        yield
        return
    try:
        lock(handle, name or folder, shared)
        yield
    finally:
        os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 atomically: a reader finds the old text or the new one, even after a kill.

    Raises OutputError where the file cannot be written."""
    # names of files may hold bytes that are no text
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file, likewise, and leaves no part of one that cannot be written."""
    beside = partial_name(path)
    with writing(path), _removed_unless_written(beside):
        beside.write_bytes(content)
        beside.replace(path)


def write_arrays(path: Path, **arrays) -> None:
    """Writes an .npz, likewise."""
    beside = partial_name(path)
    with writing(path), _removed_unless_written(beside):
        np.savez_compressed(beside, **arrays)
        beside.replace(path)


@contextlib.contextmanager
def _removed_unless_written(beside: Path):
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # that of what went wrong says more
            beside.unlink(missing_ok=True)
        raise


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All of an .npz; never unpickles. Raises OutputError for one that is not whole."""
    check_readable(path)
    try:
        # opened here, as numpy leaves a file that is no archive open
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # damaged bytes raise every kind: Value, BadZip, EOF, tokenize's
        reason = " ".join(str(error).split())[:100]  # numpy's span lines
        raise OutputError(f"{path} is damaged ({reason}): remove it and run again") from error
