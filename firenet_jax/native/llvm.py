"""Words for writing a function of machine code -> the function, compiled for this processor.

`Function` writes LLVM's instructions (llvmlite): numbers that it adds or loads are values of the
function that is being written. Pointers are moved by bytes. Vectors hold one float32 for each of 16
channels; LLVM makes of them what the processor has.
"""

import os
import sys
from collections.abc import Callable
from math import factorial
from typing import Any, cast

import numpy as np
from llvmlite import binding, ir
from numpy.polynomial import Chebyshev, Polynomial

from firenet_jax.native.choice import SWITCH

LANES = 16
INT, INT32, FLOAT, POINTER = ir.IntType(64), ir.IntType(32), ir.FloatType(), ir.PointerType()
INT8, BIT = ir.IntType(8), ir.IntType(1)
VECTOR, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT32, LANES)
VECTOR_BYTES = 4 * LANES
ALIGNED = {VECTOR: VECTOR_BYTES, POINTER: 8, INT: 8, INT32: 4, FLOAT: 4}

LN2 = float(np.log(2))
# (e^r - 1 - r) / r^2 as a polynomial, to 1e-8 where |r| is at most half of ln 2.
EXP = (
    Chebyshev.interpolate(
        lambda r: sum((r**k / factorial(k + 2) for k in range(12)), np.zeros_like(r)),
        4,
        (-LN2 / 2, LN2 / 2),
    )
    .convert(kind=Polynomial)
    .coef
)

VOID, NULL = ir.VoidType(), ir.Constant(POINTER, None)
Module = ir.Module
Code = ir.Function  # of LLVM
# LLVM needs a function's type to call it; llvmlite has none for a pointer that was loaded.
CALL_POINTER = """
define ptr @call(ptr %function, ptr %argument) {
  %result = call ptr %function(ptr %argument)
  ret ptr %result
}
"""


def integer(value) -> ir.Value:
    return ir.Constant(INT, value) if isinstance(value, int) else value


def integer32(value: int) -> ir.Constant:
    return ir.Constant(INT32, value)


def number(value: float) -> ir.Constant:
    return ir.Constant(FLOAT, float(np.float32(value)))


def vector(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [float(np.float32(value))] * LANES)


class Function:
    """A function that is being written; `b` (llvmlite's IRBuilder) is where the writing is."""

    def __init__(self, module: Module, name: str, arguments: list, result=None, public=False):
        signature = ir.FunctionType(result or VOID, arguments)
        self.module, self.function = module, ir.Function(module, signature, name)
        self.function.linkage = "" if public else "internal"
        self.arguments = self.function.args
        self.b = ir.IRBuilder(self.function.append_basic_block())

    # Memory

    def at(self, pointer, *byte_offsets):
        for offset in byte_offsets:
            pointer = self.b.gep(pointer, [integer(offset)], source_etype=ir.IntType(8))
        return pointer

    def load(self, kind, pointer, *byte_offsets):
        return self.b.load(self.at(pointer, *byte_offsets), typ=kind, align=ALIGNED[kind])

    def masked_load(self, pointer, count):
        """A vector of the numbers from here on, zeros from the count-th (int64) on."""
        mask = ir.VectorType(ir.IntType(1), LANES)
        load = self.external(
            f"llvm.masked.load.v{LANES}f32.p0", VECTOR, POINTER, INT32, mask, VECTOR
        )
        lanes = ir.Constant(INTS, list(range(LANES)))
        exist = self.b.icmp_signed("<", lanes, self.splat(self.b.trunc(count, INT32)))
        return self.b.call(load, [pointer, integer32(ALIGNED[FLOAT]), exist, vector(0)])

    def store(self, value, pointer, *byte_offsets):
        self.b.store(value, self.at(pointer, *byte_offsets), align=ALIGNED[value.type])

    def load_unaligned(self, kind, pointer, *byte_offsets):
        """From an array that begins and whose rows begin at no round address."""
        return self.b.load(self.at(pointer, *byte_offsets), typ=kind, align=ALIGNED[FLOAT])

    def store_unaligned(self, value, pointer, *byte_offsets):
        self.b.store(value, self.at(pointer, *byte_offsets), align=ALIGNED[FLOAT])

    def memset(self, pointer, size):
        """So many bytes of zeros."""
        fill = self.external("llvm.memset.p0.i64", VOID, POINTER, INT8, INT, BIT)
        self.b.call(fill, [pointer, ir.Constant(INT8, 0), integer(size), ir.Constant(BIT, 0)])

    def memcpy(self, target, source, size):
        copy = self.external("llvm.memcpy.p0.p0.i64", VOID, POINTER, POINTER, INT, BIT)
        self.b.call(copy, [target, source, integer(size), ir.Constant(BIT, 0)])

    def alloca(self, size: int):
        """So many bytes that last until the function returns."""
        with self.b.goto_entry_block():
            memory: Any = self.b.alloca(VECTOR, -(-size // VECTOR_BYTES))
            memory.align = VECTOR_BYTES
            return self.b.inttoptr(self.b.ptrtoint(memory, INT), POINTER)

    def patch(self, image, area, pixel: int, corner, patch, memory):
        """Rows of a patch of an image -> where they begin, and the bytes from one to the next.

        Where the patch goes beyond the image, it is copied, with zeros around, to this memory.
        area, patch: rows and columns; the patch begins at corner, values, at most one before the
        image. pixel: bytes.
        """
        (height, width), (rows, columns), (top, left) = area, patch, corner
        line, whole = width * pixel, columns * pixel
        inside = self.b.not_(self.b.or_(self.less(top, 0), self.less(left, 0)))
        inside = self.b.and_(inside, self.less(top, height - rows + 1))
        inside = self.b.and_(inside, self.less(left, width - columns + 1))

        def row(i, _):
            y = self.b.add(top, i)
            with self.b.if_then(self.b.and_(self.less(-1, y), self.less(y, height))):
                first = self.b.select(self.less(left, 0), integer(0), left)
                last = self.min(self.b.add(left, integer(columns)), width)
                target = self.at(memory, self.times(i, whole))
                target = self.at(target, self.times(self.b.sub(first, left), pixel))
                source = self.at(image, self.times(y, line), self.times(first, pixel))
                self.memcpy(target, source, self.times(self.b.sub(last, first), pixel))

        with self.b.if_then(self.b.not_(inside)):
            self.memset(memory, rows * whole)
            self.loop(0, rows, row)
        here = self.at(image, self.times(top, line), self.times(left, pixel))
        begin = self.b.select(inside, here, memory)
        return begin, self.b.select(inside, integer(line), integer(whole))

    def text(self, characters: str):
        """The address of a text, which stands as long as the module."""
        value = bytearray(characters.encode() + b"\0")
        constant = ir.Constant(ir.ArrayType(INT8, len(value)), value)
        name = self.module.get_unique_name("text")
        variable: Any = ir.GlobalVariable(self.module, constant.type, name)
        variable.linkage, variable.global_constant = "internal", True
        variable.initializer = constant
        return self.b.ptrtoint(variable, INT)

    # Whole numbers

    def times(self, number, factor: int):
        return self.b.mul(integer(number), integer(factor))

    def less(self, a, b):
        return self.b.icmp_signed("<", integer(a), integer(b))

    def min(self, a, b):
        return self.b.select(self.less(a, b), integer(a), integer(b))

    def rows(self, part, each: int, height: int):
        """Of this part, of so many rows each: the first row, and the one after the last."""
        first = self.times(part, each)
        return first, self.min(self.b.add(first, integer(each)), height)

    def pointers(self, pointer, count: int) -> list:
        """So many that lie one after the other."""
        return [self.load(POINTER, pointer, 8 * i) for i in range(count)]

    # Control

    def external(self, name: str, result, *arguments) -> Code:
        """A function of the C library, of LLVM or of another module."""
        known = self.module.globals.get(name)
        return known or ir.Function(self.module, ir.FunctionType(result, arguments), name)

    def call_pointer(self, function, argument):
        return self.b.call(self.external("call", POINTER, POINTER, POINTER), [function, argument])

    def loop(self, start, stop, body: Callable, carried: list | tuple = ()) -> list:
        """body(i, carried) -> carried, for start <= i < stop, at least once."""
        before, inside = self.b.block, self.b.append_basic_block()
        self.b.branch(inside)
        self.b.position_at_end(inside)
        first = [integer(start), *carried]
        phis = [self.b.phi(value.type) for value in first]
        following = [self.b.add(phis[0], integer(1)), *(body(phis[0], phis[1:]) or [])]
        for phi, value, again in zip(phis, first, following, strict=True):
            phi.add_incoming(value, before)
            phi.add_incoming(again, self.b.block)
        after = self.b.append_basic_block()
        self.b.cbranch(self.less(following[0], stop), inside, after)
        self.b.position_at_end(after)
        return following[1:]

    # Vectors

    def intrinsic(self, name: str, *arguments):
        """One of LLVM's functions of numbers, for each lane."""
        kinds = [VECTOR] * len(arguments)
        return self.b.call(self.external(f"llvm.{name}.v{LANES}f32", VECTOR, *kinds), arguments)

    def fma(self, a, b, c):
        return self.intrinsic("fma", a, b, c)

    def splat(self, number):
        undefined = ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined)
        first = self.b.insert_element(undefined, number, integer32(0))
        return self.b.shuffle_vector(first, undefined, ir.Constant(INTS, [0] * LANES))

    def reduce_add(self, lanes, start):
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        add = self.external(name, FLOAT, FLOAT, VECTOR)
        return self.b.call(add, [start, lanes], fastmath=("reassoc",))

    def max(self, x, bound):
        """Of vectors; not a number stays so."""
        return self.b.select(self.b.fcmp_ordered("<", x, bound), bound, x)

    def is_not_zero(self, x):
        return self.b.fcmp_unordered("!=", x, vector(0))

    def is_positive(self, x):
        return self.b.fcmp_ordered(">", x, vector(0))

    def relu(self, x):
        return self.max(x, vector(0))

    def exp(self, x):
        """2^n e^r, r between half of -ln 2 and of ln 2. What is not a number stays so."""
        given, x = x, self.max(x, vector(-87))
        x = self.b.select(self.b.fcmp_ordered(">", x, vector(88)), vector(88), x)
        # Added to a number this large, a fraction is rounded away; n is in the last bits.
        large = vector(1.5 * 2**23)
        shifted = self.fma(x, vector(1 / LN2), large)
        r = self.fma(self.b.fsub(shifted, large), vector(-LN2), x)
        series = vector(EXP[-1])
        for term in EXP[-2::-1]:
            series = self.fma(series, r, vector(term))
        series = self.fma(self.b.fmul(series, r), r, self.b.fadd(r, vector(1)))
        exponent = self.b.shl(self.b.bitcast(shifted, INTS), ir.Constant(INTS, [23] * LANES))
        result = self.b.bitcast(self.b.add(self.b.bitcast(series, INTS), exponent), VECTOR)
        # Added to the last bits of NaN, the exponent may make a number of it.
        return self.b.select(self.b.fcmp_unordered("uno", given, given), given, result)

    def sigmoid(self, x):
        """1 / (1 + e^-x). "arcp": by an estimate and a Newton step, a division takes longer."""
        one, b = vector(1), cast(Any, self.b)  # its types do not know flags
        return b.fdiv(one, b.fadd(one, self.exp(b.fneg(x))), flags=("arcp",))

    def tanh(self, x):
        return self.fma(vector(2), self.sigmoid(self.b.fadd(x, x)), vector(-1))


def _features() -> binding.FeatureMap:
    """What this processor has, as far as it is to be used."""
    features = binding.get_host_cpu_features()
    if os.environ.get(SWITCH) == "avx2":
        for name in features:
            features[name] &= not name.startswith(("avx512", "avx10"))
    return features


def vectors() -> int:
    """How many vectors this processor's registers hold; 0 where nothing of this was tried."""
    if not binding.get_process_triple().startswith("x86_64") or sys.platform != "linux":
        return 0
    features = _features()
    if features.get("avx512f"):
        return 32
    return 8 if features.get("avx2") and features.get("fma") else 0  # each in two of 16


_engines = []  # what was compiled stays for as long as the process


def machine() -> binding.TargetMachine:
    """This processor, for LLVM."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_triple(binding.get_process_triple()).create_target_machine(
        cpu=binding.get_host_cpu_name(),
        # Some processors have vectors of 512 bits of which LLVM would use only half.
        features=_features().flatten() + ",-prefer-256-bit",
        opt=2,
    )


def optimised(module: Module, target: binding.TargetMachine) -> binding.ModuleRef:
    module.triple = target.triple
    code = binding.parse_assembly(str(module))
    code.link_in(binding.parse_assembly(CALL_POINTER))
    passes = binding.create_pass_builder(
        target, binding.create_pipeline_tuning_options(speed_level=1)
    )
    passes.getModulePassManager().run(code, passes)
    return code


def compiled(module: Module) -> Callable[[str], int]:
    """Compiles a module -> where its function of a name is; only public ones have names."""
    target = machine()
    engine = binding.create_mcjit_compiler(optimised(module, target), target)
    engine.finalize_object()
    _engines.append(engine)
    return engine.get_function_address
