import threading
import time

import pytest

from firenet_jax.storage.overlap import prefetch


def test_gives_the_same_items_in_order():
    assert list(prefetch(iter(range(100)))) == list(range(100))
    assert list(prefetch(iter([]))) == []


def test_depth_items_wait_and_one_is_in_hand():
    made = []

    def items():
        for i in range(10):
            made.append(i)
            yield i

    stream = prefetch(items(), depth=2)
    assert next(stream) == 0
    time.sleep(0.3)
    assert 3 <= len(made) <= 4  # one taken, two waiting, one in hand
    assert list(stream) == list(range(1, 10))


def test_an_exception_arrives_in_its_place():
    def items():
        yield 1
        raise ZeroDivisionError("here")

    stream = prefetch(items())
    assert next(stream) == 1
    with pytest.raises(ZeroDivisionError, match="here"):
        next(stream)


def test_leaving_early_ends_the_thread_and_closes_the_source():
    closed = threading.Event()

    def items():
        try:
            while True:
                yield 0
        finally:
            closed.set()

    before = threading.active_count()
    stream = prefetch(prefetch(items()))
    next(stream)
    stream.close()
    assert closed.wait(5) and threading.active_count() == before


def test_leaving_early_waits_until_the_source_is_closed():
    closed = []

    def items():
        try:
            while True:
                yield 0
        finally:
            time.sleep(0.3)
            closed.append(True)

    stream = prefetch(items())
    next(stream)
    stream.close()
    assert closed
