"""Iterator -> the same iterator, run ahead in a thread: reading, device and writing overlap.

Used as `for chunk in ahead(device(ahead(reader)))`. The work inside releases the GIL (text parser,
HDF5, XLA, zlib), so the stages really run side by side.
"""

import contextlib
import queue
import threading
from collections.abc import Generator, Iterator

_END = object()


def ahead(items: Iterator, depth: int = 2) -> Generator:
    """Yields what `items` yields, computed by a thread: `depth` items wait, and one is in hand.

    An exception of `items` is raised here, in its place among the items. Closing this iterator
    (or leaving the loop over it) ends the thread and closes `items`.
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
    finally:
        stop.set()
        thread.join()
