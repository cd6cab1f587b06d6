"""What HDF5 writes -> a file, and afterwards the first write that found no room.

Where the last writes of a file fail, HDF5 ends the whole process, or prints tracebacks that nobody
can catch: so it gets a file object whose writes never fail. `sequence_file` shows its use.
"""

import io
from collections.abc import Iterable, Iterator


class Disk:
    """A file object for h5py. From the first write on that fails, all are kept in memory: what HDF5
    has yet to write."""

    def __init__(self, file: io.FileIO):
        self.file, self.at, self.error = file, 0, None
        self.late: list[tuple[int, bytes]] = []  # (offset, bytes) that are not on the disk

    def check(self) -> None:
        """Raises the OSError of the first write that failed."""
        if self.error is not None:
            raise self.error

    def during(self, items: Iterable) -> Iterator:
        """The same items, up to the first write that fails."""
        for item in items:
            self.check()
            yield item

    # What h5py asks of a file.

    def seek(self, offset: int, whence: int = 0) -> int:
        self.at = offset + (0, self.at, self.file.seek(0, 2))[whence]
        return self.at

    def tell(self) -> int:
        return self.at

    def write(self, data) -> int:
        data = bytes(data)
        try:
            self.check()
            self.file.seek(self.at)
            rest = memoryview(data)
            while rest:  # a disk that becomes full takes a part first
                rest = rest[self.file.write(rest) :]
        except OSError as error:
            self.error = error
            self.late.append((self.at, data))
        self.at += len(data)
        return len(data)

    def read(self, size: int) -> bytes:
        into = bytearray(size)
        self.readinto(into)
        return bytes(into)

    def readinto(self, into) -> int:
        into = memoryview(into).cast("B")
        self.file.seek(self.at)
        read = self.file.readinto(into)
        into[read:] = bytes(len(into) - read)
        for place, data in self.late:
            first, last = max(place, self.at), min(place + len(data), self.at + len(into))
            if first < last:
                into[first - self.at : last - self.at] = data[first - place : last - place]
        self.at += len(into)
        return len(into)

    def truncate(self, size: int) -> int:
        try:
            self.check()
            self.file.truncate(size)
        except OSError as error:
            self.error = error
        return size

    def flush(self) -> None:
        """Nothing waits: the file has no buffer."""
