import ctypes
import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("llvmlite")

from firenet_jax.native import foreign_call
from firenet_jax.native.foreign_call import register
from firenet_jax.native.llvm import INT, POINTER, Function, Module, integer, vectors
from firenet_jax.native.whole_step import Size

pytestmark = pytest.mark.skipif(
    vectors() == 0 or jax.default_backend() != "cpu", reason="no machine code for this processor"
)


def test_memory_is_kept_for_the_next_window_of_any_usual_size():
    """New pages for each window took a quarter of the time of 1280x720."""
    module, scratch = Module(), Size(720, 1280).inner
    f = Function(module, "nothing", [POINTER, INT, INT])
    f.b.ret_void()
    register("firenet_test_kept", module, [f.function], 1, 1, 1, scratch)

    @jax.jit
    def call(numbers):
        return jax.ffi.ffi_call("firenet_test_kept", numbers)(numbers)

    for batch in (1, 4):
        jax.block_until_ready(call(jnp.zeros((batch, 1))))
        block = foreign_call._kept.value
        assert block and ctypes.c_int64.from_address(block).value >= batch * scratch
        jax.block_until_ready(call(jnp.zeros((batch, 1))))
        assert foreign_call._kept.value == block


def test_every_part_runs_once_and_stages_wait_for_each_other():
    """Stage 0 adds 1 to each part's number, stage 1 adds its neighbour's to it (of 0: of the last).

    What stage 1 reads must be finished whoever wrote it, and no part may run twice; the memory in
    between belongs to one call alone, whatever sizes others ask for.
    """
    parts, scratch, runs = 37, 320, 300
    module = Module()

    def stage(name, write):
        f = Function(module, name, [POINTER, INT, INT])
        pointers, image, part = f.arguments
        numbers, result, between = (f.load(POINTER, pointers, 8 * i) for i in range(3))
        here = f.times(f.b.add(f.times(image, parts), part), 8)

        def of_image(part):
            return f.at(between, f.times(image, scratch), f.times(part, 8))

        left = f.b.srem(f.b.add(part, integer(parts - 1)), integer(parts))
        write(f, numbers, result, here, of_image(part), of_image(left))
        f.b.ret_void()
        return f.function

    def one(f, numbers, result, here, at, left):
        f.store(integer(0), result, here)
        f.store(f.b.add(f.load(INT, numbers, here), integer(1)), at)

    def two(f, numbers, result, here, at, left):
        value = f.b.add(f.load(INT, at), f.load(INT, left))
        f.store(f.b.add(f.load(INT, result, here), value), result, here)

    stages = [stage("one", one), stage("two", two)]
    register("firenet_test_parts", module, stages, parts, 1, 1, scratch)
    with jax.enable_x64(True):

        @jax.jit
        def call(numbers):
            shape = jax.ShapeDtypeStruct(numbers.shape, jnp.int64)
            return jax.ffi.ffi_call("firenet_test_parts", shape)(numbers)

        rng = np.random.default_rng(0)
        cases = [jnp.asarray(rng.integers(0, 1000, (images, parts))) for images in (3, 1, 7)]
        compiled = {numbers.shape: call.lower(numbers).compile() for numbers in cases}

        def run(i):
            numbers = cases[i % len(cases)]
            return numbers, np.asarray(compiled[numbers.shape](numbers))

        with ThreadPoolExecutor(8) as pool:
            for numbers, found in pool.map(run, range(runs)):
                expected = numbers + 1 + np.roll(numbers + 1, 1, axis=1)
                np.testing.assert_array_equal(found, expected)


# Each number of the source and what the header says it is.
OF_THE_HEADER = {
    "FRAME_EXTENSION": "offsetof(XLA_FFI_CallFrame, extension_start)",
    "FRAME_API": "offsetof(XLA_FFI_CallFrame, api)",
    "FRAME_CONTEXT": "offsetof(XLA_FFI_CallFrame, ctx)",
    "FRAME_ARGUMENTS": "offsetof(XLA_FFI_CallFrame, args) + offsetof(XLA_FFI_Args, args)",
    "FRAME_RESULTS": "offsetof(XLA_FFI_CallFrame, rets) + offsetof(XLA_FFI_Rets, rets)",
    "EXTENSION_TYPE": "offsetof(XLA_FFI_Extension_Base, type)",
    "EXTENSION_METADATA": "offsetof(XLA_FFI_Metadata_Extension, metadata)",
    "IS_METADATA": "XLA_FFI_Extension_Metadata",
    "METADATA_MAJOR": "offsetof(XLA_FFI_Metadata, api_version)"
    " + offsetof(XLA_FFI_Api_Version, major_version)",
    "METADATA_MINOR": "offsetof(XLA_FFI_Metadata, api_version)"
    " + offsetof(XLA_FFI_Api_Version, minor_version)",
    "BUFFER_DATA": "offsetof(XLA_FFI_Buffer, data)",
    "BUFFER_DIMENSIONS": "offsetof(XLA_FFI_Buffer, dims)",
    "API_CREATE_ERROR": "offsetof(XLA_FFI_Api, XLA_FFI_Error_Create)",
    "RESOURCE_EXHAUSTED": "XLA_FFI_Error_Code_RESOURCE_EXHAUSTED",
    "API_DESTROY_ERROR": "offsetof(XLA_FFI_Api, XLA_FFI_Error_Destroy)",
    "API_SCHEDULE": "offsetof(XLA_FFI_Api, XLA_FFI_ThreadPool_Schedule)",
    "API_THREADS": "offsetof(XLA_FFI_Api, XLA_FFI_ThreadPool_NumThreads)",
}
# Structures that `handler` makes itself: 16 bytes of head, then these, 8 bytes each.
MADE = {
    "XLA_FFI_Error_Create_Args": ["message", "errc"],
    "XLA_FFI_Error_Destroy_Args": ["error"],
    "XLA_FFI_ThreadPool_Schedule_Args": ["ctx", "task", "data"],
    "XLA_FFI_ThreadPool_NumThreads_Args": ["ctx", "num_threads"],
}


@pytest.fixture(scope="module")
def header():
    return Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h"


def test_places_in_structures_are_those_of_the_header(header, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler")
    numbers = dict(OF_THE_HEADER)
    for name, fields in MADE.items():
        numbers |= {f"{name}.{field}": f"offsetof({name}, {field})" for field in fields}
        numbers |= {name: f"sizeof({name})"}
    lines = [f'printf("{name} %zu\\n", (size_t)({code}));' for name, code in numbers.items()]
    code = f'#include <stddef.h>\n#include <stdio.h>\n#include "{header}"\n'
    (tmp_path / "places.c").write_text(code + "int main() {" + "\n".join(lines) + "}\n")
    program = tmp_path / "places"
    subprocess.run([compiler, "-o", program, tmp_path / "places.c"], check=True)
    output = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    found = {name: int(number) for name, number in map(str.split, output.splitlines())}
    for name in OF_THE_HEADER:
        assert found[name] == getattr(foreign_call, name), name
    for name, fields in MADE.items():
        assert found[name] == 16 + 8 * len(fields)
        assert [found[f"{name}.{field}"] for field in fields] == [
            16 + 8 * i for i in range(len(fields))
        ]


def test_the_interface_is_that_of_the_header_or_older(header):
    """XLA calls handlers of older versions; a newer one than its own it refuses."""
    text = header.read_text()
    major, minor = (
        int(re.search(rf"#define XLA_FFI_API_{part} (\d+)", text)[1]) for part in ("MAJOR", "MINOR")
    )
    assert foreign_call.API_VERSION[0] == major and foreign_call.API_VERSION[1] <= minor
