"""Stages of machine code, each in parts -> a function that XLA's programs call on a CPU.

A stage is a function (pointers to all arrays, image of the batch, part). The parts of a stage may
run at once and in any order, by as many of XLA's threads as come; a stage begins when the one
before it is done. The arrays are XLA's (`jax.ffi`): none is copied, nothing waits for Python.
"""

import ctypes
from collections.abc import Callable

import jax

from firenet_jax.native.choice import Unavailable
from firenet_jax.native.llvm import (
    INT,
    INT32,
    NULL,
    POINTER,
    VOID,
    Code,
    Function,
    Module,
    compiled,
    integer,
    integer32,
)

# Places in the structures of XLA's foreign function interface, in bytes (jaxlib's
# include/xla/ffi/api/c_api.h). XLA refuses a handler of a version whose places it has moved.
API_VERSION = (0, 3)
FRAME_EXTENSION, FRAME_API, FRAME_CONTEXT, FRAME_ARGUMENTS, FRAME_RESULTS = 8, 16, 24, 72, 112
EXTENSION_TYPE, EXTENSION_METADATA, IS_METADATA = 8, 24, 1
METADATA_MAJOR, METADATA_MINOR = 24, 28
BUFFER_DATA, BUFFER_DIMENSIONS = 24, 40
API_CREATE_ERROR, API_DESTROY_ERROR, API_SCHEDULE, API_THREADS = 48, 64, 136, 144
RESOURCE_EXHAUSTED = 8

# A call's record on the heap: how many may still use it, images, who has come, arrays; and for each
# stage, in cache lines of their own, how many parts are done, and taken of each half.
USERS, IMAGES, WORKERS, ARRAYS, COUNTERS, COUNTER = 0, 8, 16, 24, 128, 64
MOST_ARRAYS = (COUNTERS - ARRAYS) // 8

# Memory that the stages of a call share is kept for the next call, of whatever function: to have
# new pages from the system takes as long as a good part of the work. One block, its size before it.
LINE, MOST_KEPT = 64, 2**31
_kept = ctypes.c_int64(0)


def register(
    name: str,
    module: Module,
    stages: list[Code],
    parts: int,
    arguments: int,
    results: int,
    scratch: int = 0,
) -> None:
    """Compiles the module and makes it known to XLA under this name.

    stages: functions of the module, (pointer to pointers, int64 image, int64 part).
    parts: of each stage, for each image of the batch: the first axis of argument 0.
    arguments, results: how many; the stages get pointers of them, and then, if there is some, of
    scratch: bytes of memory for each image, a multiple of 64, that all stages of a call share.
    Raises RuntimeError where XLA's interface has another version than this was written for, and
    Unavailable for more arrays than a record has room for.
    """
    if arguments + results + bool(scratch) > MOST_ARRAYS:
        raise Unavailable
    work = _work(module, stages, parts)
    _handler(module, work, len(stages), parts, arguments, results, scratch)
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(compiled(module)("handler"))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")


def _work(module: Module, stages: list[Code], parts: int) -> Code:
    """work(record): takes parts of one stage after the other, until all are done.

    Every other thread begins with the lower half of the images, from below; and each stage goes the
    other way than the one before it, so that it finds what a thread has just written in that
    processor's cache. Whoever is done with a half helps with the other; whoever comes too late
    finds no part left to take and touches nothing but the record.
    """
    f = Function(module, "work", [POINTER])
    (record,) = f.arguments
    images = f.load(INT, record, IMAGES)
    all_parts = f.times(images, parts)
    mine = f.b.atomic_rmw("add", f.at(record, WORKERS), integer(1), "monotonic")
    mine = f.b.and_(mine, integer(1))
    upper, lower = parts - parts // 2, parts // 2
    for i, stage in enumerate(stages):
        done = f.at(record, COUNTERS + 3 * i * COUNTER)

        def take_all(half, i=i, stage=stage, done=done):
            is_lower = f.b.icmp_signed("==", half, integer(1))
            taken = f.at(done, COUNTER, f.times(half, COUNTER))
            each = f.b.select(is_lower, integer(lower), integer(upper))
            ask, run, after = (f.b.append_basic_block() for _ in range(3))
            f.b.branch(ask)

            f.b.position_at_end(ask)
            part = f.b.atomic_rmw("add", taken, integer(1), "monotonic")
            f.b.cbranch(f.less(part, f.b.mul(images, each)), run, after)

            f.b.position_at_end(run)
            image, part = f.b.sdiv(part, each), f.b.srem(part, each)
            if i % 2:
                image = f.b.sub(f.b.sub(images, integer(1)), image)
                part = f.b.sub(f.b.sub(each, integer(1)), part)
            part = f.b.select(is_lower, f.b.sub(integer(parts - 1), part), part)
            f.b.call(stage, [f.at(record, ARRAYS), image, part])
            f.b.atomic_rmw("add", done, integer(1), "release")
            f.b.branch(ask)

            f.b.position_at_end(after)

        take_all(mine)
        take_all(f.b.sub(integer(1), mine))
        _wait(f, lambda done=done: f.less(f.b.load_atomic(done, "acquire", 8, typ=INT), all_parts))
    f.b.ret_void()
    return f.function


def _wait(f: Function, is_missing: Callable) -> None:
    """Until the others are done: at first awake, for they soon are.

    Then in longer and longer sleeps, so that threads without a processor of their own (in a
    container that may use a few of many) do not take the time of those that work.
    """
    awake, doublings, microseconds = 200, 4, 20
    before = f.b.block
    ask, wait, rest, sleep, again, after = (f.b.append_basic_block() for _ in range(6))
    f.b.branch(ask)

    f.b.position_at_end(ask)
    times = f.b.phi(INT)
    times.add_incoming(integer(0), before)
    f.b.cbranch(is_missing(), wait, after)

    f.b.position_at_end(wait)
    f.b.cbranch(f.less(times, awake), rest, sleep)

    f.b.position_at_end(rest)
    f.b.call(f.external("sched_yield", INT32), [])
    f.b.branch(again)

    f.b.position_at_end(sleep)
    doubled = f.min(f.b.sub(times, integer(awake)), doublings)
    time = f.b.trunc(f.b.shl(integer(microseconds), doubled), INT32)
    f.b.call(f.external("usleep", INT32, INT32), [time])
    f.b.branch(again)

    f.b.position_at_end(again)
    times.add_incoming(f.b.add(times, integer(1)), again)
    f.b.branch(ask)

    f.b.position_at_end(after)


def _leave(f: Function, record) -> None:
    """The last user of a record gives its memory back."""
    users = f.b.atomic_rmw("sub", f.at(record, USERS), integer(1), "acq_rel")
    with f.b.if_then(f.b.icmp_signed("==", users, integer(1))):
        f.b.call(f.external("free", VOID, POINTER), [record])


def _take(f: Function, size):
    """Where so many bytes, a multiple of a line, may be used; null if there are none."""
    kept = f.b.inttoptr(integer(ctypes.addressof(_kept)), POINTER)
    found = f.alloca(LINE)
    f.store(f.b.atomic_rmw("xchg", kept, integer(0), "acquire"), found)

    def block():
        return f.load(POINTER, found)

    def is_there():
        return f.b.icmp_unsigned("!=", block(), NULL)

    with f.b.if_then(is_there()), f.b.if_then(f.less(f.load(INT, block()), size)):
        f.b.call(f.external("free", VOID, POINTER), [block()])
        f.store(NULL, found)
    with f.b.if_then(f.b.not_(is_there())):
        allocate = f.external("aligned_alloc", POINTER, INT, INT)
        f.store(f.b.call(allocate, [integer(LINE), f.b.add(size, integer(LINE))]), found)
        with f.b.if_then(is_there()):
            f.store(size, block())
    return f.b.select(is_there(), f.at(block(), LINE), NULL)


def _give_back(f: Function, memory) -> None:
    """Keeps it for the next call, in place of what was kept before."""
    kept = f.b.inttoptr(integer(ctypes.addressof(_kept)), POINTER)
    block, free = f.at(memory, -LINE), f.external("free", VOID, POINTER)
    with f.b.if_else(f.less(MOST_KEPT, f.load(INT, block))) as (too_large, otherwise):
        with too_large:
            f.b.call(free, [block])
        with otherwise:
            before = f.b.atomic_rmw("xchg", kept, f.b.ptrtoint(block, INT), "acq_rel")
            f.b.call(free, [f.b.inttoptr(before, POINTER)])  # of null: nothing


def _handler(
    module, work, stages: int, parts: int, arguments: int, results: int, scratch: int
) -> None:
    """handler(frame): what XLA calls: asks XLA's threads for help, works itself, leaves."""
    f = Function(module, "helper", [POINTER])
    (record,) = f.arguments
    f.b.call(work, [record])
    _leave(f, record)
    f.b.ret_void()
    helper = f.function

    f = Function(module, "handler", [POINTER], POINTER, public=True)
    (frame,) = f.arguments
    _answer_version(f, frame)
    context, api = f.load(POINTER, frame, FRAME_CONTEXT), f.load(POINTER, frame, FRAME_API)

    def structure(*values):
        memory = f.alloca(8 * (2 + len(values)))
        for i, value in enumerate((integer(16 + 8 * len(values)), NULL, *values)):
            f.store(value, memory, 8 * i)
        return memory

    def succeeds(function: int, *values):
        """Calls one of XLA's functions; forgets its error, if any."""
        error = f.call_pointer(f.load(POINTER, api, function), structure(context, *values))
        failed = f.b.icmp_unsigned("!=", error, NULL)
        with f.b.if_then(failed):
            f.call_pointer(f.load(POINTER, api, API_DESTROY_ERROR), structure(error))
        return f.b.not_(failed)

    inputs = f.load(POINTER, frame, FRAME_ARGUMENTS)
    outputs = f.load(POINTER, frame, FRAME_RESULTS)
    buffers = [f.load(POINTER, inputs, 8 * i) for i in range(arguments)]
    buffers += [f.load(POINTER, outputs, 8 * i) for i in range(results)]
    images = f.load(INT, f.load(POINTER, buffers[0], BUFFER_DIMENSIONS))

    if scratch:
        memory = _take(f, f.times(images, scratch))
        with f.b.if_then(f.b.icmp_unsigned("==", memory, NULL)):
            text = f.text("no memory for the maps of a step")
            error = structure(text, integer(RESOURCE_EXHAUSTED))
            f.b.ret(f.call_pointer(f.load(POINTER, api, API_CREATE_ERROR), error))

    number = f.alloca(8)
    f.store(integer(1), number)
    succeeds(API_THREADS, number)  # else XLA has no threads to share: one
    threads = f.min(f.load(INT, number), f.times(images, parts))

    size = COUNTERS + 3 * stages * COUNTER
    record = f.b.call(f.external("malloc", POINTER, INT), [integer(size)])
    f.loop(0, size // 8, lambda i, _: f.store(integer(0), record, f.times(i, 8)))
    f.store(threads, record, USERS)
    f.store(images, record, IMAGES)
    for i, buffer in enumerate(buffers):
        f.store(f.load(POINTER, buffer, BUFFER_DATA), record, ARRAYS + 8 * i)
    if scratch:
        f.store(memory, record, ARRAYS + 8 * len(buffers))

    def hire(i, _):
        hired = succeeds(API_SCHEDULE, f.b.ptrtoint(helper, INT), record)
        with f.b.if_then(f.b.not_(hired)):
            _leave(f, record)

    with f.b.if_then(f.less(1, threads)):
        f.loop(1, threads, hire)
    f.b.call(work, [record])
    if scratch:  # nobody works any more, though some may still look for work
        _give_back(f, memory)
    _leave(f, record)
    f.b.ret(NULL)


def _answer_version(f: Function, frame) -> None:
    """XLA asks once, when the function is registered, by an extension of the frame."""
    extension = f.load(POINTER, frame, FRAME_EXTENSION)
    with f.b.if_then(f.b.icmp_unsigned("!=", extension, NULL)):
        kind = f.load(INT32, extension, EXTENSION_TYPE)
        with f.b.if_then(f.b.icmp_signed("==", kind, integer32(IS_METADATA))):
            metadata = f.load(POINTER, extension, EXTENSION_METADATA)
            for place, part in zip((METADATA_MAJOR, METADATA_MINOR), API_VERSION, strict=True):
                f.store(integer32(part), metadata, place)
            f.b.ret(NULL)
