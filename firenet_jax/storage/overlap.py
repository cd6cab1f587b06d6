"""Iterator -> the same iterator, run ahead in a thread: reading, device and writing overlap.

Used as `for chunk in prefetch(device(prefetch(reader)))`. The work inside releases the GIL (text
parser, HDF5, XLA, zlib), so the stages really run side by side.
"""

import contextlib
import queue
import threading
from collections.abc import Generator, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")
_END = object()


def until_set(stop: threading.Event, items: Iterable[Item]) -> Iterator[Item]:
    """The items, as long as this is not set: who waits for the end of a thread waits for what it is
    at, which may be to look for the next item among many."""
    for item in items:
        if stop.is_set():
            return
        yield item


def prefetch(items: Iterator, depth: int = 2, broken: threading.Event | None = None) -> Generator:
    """Yields what `items` yields, computed by a thread: `depth` items wait, and one is in hand.

    An exception of `items` is raised here, in its place among the items. Closing this iterator
    (or leaving the loop over it) ends the thread and closes `items`, which is waited for.
    broken: set before that, where this ends early, by closing it or by Ctrl-C; for `until_set`.
    """
    ready: queue.Queue = queue.Queue(depth)
    stop = threading.Event()

    def put(entry) -> bool:
        while not stop.is_set():
            with contextlib.suppress(queue.Full):
                ready.put(entry, timeout=0.1)
                return True
        return False

    def work():
        try:
            for item in items:
                if not put((item, None)):
                    break
            else:
                put((_END, None))
        except BaseException as error:  # whatever it is, the consumer must see it
            put((None, error))
        finally:
            close = getattr(items, "close", None)
            if close:
                close()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            item, error = ready.get()
            if error is not None:
                raise error
            if item is _END:
                return
            yield item
    except BaseException:
        if broken is not None:
            broken.set()
        raise
    finally:
        stop.set()
        thread.join()
