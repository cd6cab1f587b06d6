"""PyTorch file -> {name: numpy array}, without PyTorch and without running what the file holds.

The arrays are read-only views of the file's storages, in the shape, dtype and strides that
PyTorch gave them; only bfloat16, which numpy lacks, becomes float32. Whatever else the file
holds (optimiser, configuration) is skipped.

A checkpoint is a pickle, a pickle is a program, and a checkpoint from the web may be anyone's
program. Here a small interpreter follows only the instructions that build data. A class must
stand in `GLOBALS`, which maps it to a function of this module; every other name is refused
before anything is made of it, and state for an object (`BUILD`) is dropped.

Two layouts. Old, before PyTorch 1.6: five pickles after each other (magic number, protocol,
machine, object, list of storage keys), then for each key an int64 count and the elements, all
little-endian. New: an uncompressed zip with `*/data.pkl`, `*/data/<key>` and perhaps
`*/byteorder`. In both the object names its storages by persistent ids
("storage", type, key, device, count), and a tensor is (storage, offset, shape, strides),
counted in elements.
"""

import io
import math
import os
import pickletools
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firenet_jax.errors import CheckpointError
from firenet_jax.storage.files import check_readable

MAGIC_NUMBER = 0x1950A86A20F9469CFC6C
PROTOCOL = 1001
MAX_BYTES = 2**30  # of the old format, which is read whole
MAX_ELEMENTS = 2**28  # 100 times the largest network of this field; a stride of 0 can claim any
MAX_DIMENSIONS = 64  # numpy's
MAX_KEY = 16  # items of a tuple that is a key: it is hashed anew each time
# Of a pickle. A checkpoint with its optimiser and log has thousands; an instruction of one byte can
# make an object of a hundred.
MAX_INSTRUCTIONS = 2**22

AGAIN = "copy or download it again"


def read_state_dict(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors by name: what stands under `state_dict`, `model_state_dict` or at the top.

    Raises CheckpointError for whatever is not a PyTorch checkpoint, is damaged, or names a class or
    function that is not in `GLOBALS`.
    """
    path = Path(path)
    check_readable(path, CheckpointError)
    try:
        with open(path, "rb") as file:
            start = file.read(16)
            old = start[:1] == b"\x80"
            if old and (size := os.fstat(file.fileno()).st_size) > MAX_BYTES:
                raise CheckpointError(
                    f"{path} holds {size} bytes and is no network of this field; {AGAIN}"
                )
            file.seek(0)
            content = file.read() if old else b""
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be read ({error.strerror or error}); check the path"
        ) from error
    try:
        if content:
            return _read_old(content)
        if start[:2] == b"PK":
            return _read_new(path)
        found = f"it starts with {start!r}" if start else "it is empty"
        raise CheckpointError(f"is not a PyTorch checkpoint ({found}); {AGAIN}")
    except CheckpointError as error:
        raise CheckpointError(f"{path} {error}") from None
    except Exception as error:  # damaged bytes raise every kind: Index, Key, Type, Memory, BadZip
        reason = _shown(f"{type(error).__name__}: {error}")
        raise CheckpointError(f"{path} is damaged or cut short ({reason}); {AGAIN}") from error


# ---- from its tensors to a network; path, kind and advice are for the message of an error

Tensors = dict[str, np.ndarray]


def identify(
    tensors: Tensors, firsts: dict[str, str], path: str | Path, kind: str, advice: str
) -> tuple[str, str]:
    """Which network the tensors are of: its title, and the prefix of their names ("net.").

    firsts: title -> the name of a tensor that only this network has. Raises CheckpointError where
    none of them is found, or more than one.
    """
    found = [
        (title, name.removesuffix(first))
        for title, first in firsts.items()
        for name in tensors
        if f".{name}".endswith(f".{first}")
    ]
    if not found:
        anchors = " or ".join(f"{first} ({title})" for title, first in firsts.items())
        raise CheckpointError(
            f"{path} holds no {kind}: expected {anchors}, found {len(tensors)} other names, "
            f"the first '{_shown(next(iter(tensors)))}'; {advice}"
        )
    if len(found) > 1:
        prefixes = ", ".join(f"'{_shown(prefix)}'" for _, prefix in found)
        raise CheckpointError(f"{path} holds several networks ({prefixes}); save one of them alone")
    return found[0]


def take(
    tensors: Tensors, prefix: str, path: str | Path, kind: str, advice: str, name: str, shape: tuple
) -> np.ndarray:
    """Takes the tensor prefix + name out of the dict: a float32 copy.

    Raises CheckpointError where it is missing, of another shape, not of floats or not finite.
    """
    problem = f"{path} holds no {kind}: {prefix + name!a}"
    found = tensors.pop(prefix + name, None)
    if found is None:
        raise CheckpointError(f"{problem} is missing; {advice}")
    if found.shape != shape or found.dtype.kind != "f":
        raise CheckpointError(
            f"{problem} should be floats {shape} and is {found.dtype} {found.shape}; {advice}"
        )
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf: refused here
        found = found.astype(np.float32)
    if not np.isfinite(found).all():
        raise CheckpointError(f"{problem} has values that are not finite; {advice}")
    return found


def refuse_unused(tensors: Tensors, prefix: str, path: str | Path, kind: str, advice: str) -> None:
    """Raises CheckpointError where `take` has left a tensor of the network.

    It would be a layer that we leave out: the images would be quietly wrong.
    """
    for name in tensors:
        if name.startswith(prefix):
            problem = f"{path} holds no {kind}: {kind} has no place for {name!a}"
            raise CheckpointError(f"{problem}; {advice}")


# ---- the two layouts


def _read_old(content: bytes) -> dict[str, np.ndarray]:
    stream = io.BytesIO(content)
    if _unpickle(stream, {}) != MAGIC_NUMBER:
        raise CheckpointError("is a pickle but not a PyTorch checkpoint; pass one of torch.save")
    if _unpickle(stream, {}) != PROTOCOL:
        raise CheckpointError(f"is not of PyTorch's file protocol {PROTOCOL}; save it again")
    _unpickle(stream, {})  # about the writer's machine; the elements are always little-endian
    storages: dict[str, _Storage] = {}
    tensors = _state_dict(_unpickle(stream, storages))

    elements = {}
    keys: Any = _unpickle(stream, {})
    listed = isinstance(keys, list) and all(isinstance(key, str) for key in keys)
    if not listed or sorted(keys) != sorted(storages):
        raise CheckpointError(f"is damaged (it does not list the storages it needs); {AGAIN}")
    for key in keys:
        storage = storages[key]
        (count,) = struct.unpack("<q", stream.read(8))
        size = storage.total * storage.type.itemsize
        left = len(content) - stream.tell()
        if count != storage.total or size > left:
            raise CheckpointError(
                f"is damaged or cut short (storage {_shown(key)} should hold {storage.total} "
                f"elements, its header says {count} and {left} bytes are left); {AGAIN}"
            )
        elements[key] = stream.read(size)
    return _arrays(tensors, elements.__getitem__, "<")


def _read_new(path: Path) -> dict[str, np.ndarray]:
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        stored = (i.file_size for i in archive.infolist() if i.compress_type == zipfile.ZIP_STORED)
        if sum(stored) > size:  # each could be as large as the file: that fills the memory
            raise CheckpointError(f"is damaged (its members overlap each other); {AGAIN}")
        names = set(archive.namelist())
        roots = [name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl")]
        if len(roots) != 1:
            raise CheckpointError(
                "is a zip file but not a PyTorch checkpoint (it does not hold one data.pkl); "
                "pass the checkpoint itself"
            )

        def member(name: str) -> bytes:
            if roots[0] + name not in names:
                raise CheckpointError(f"is damaged ({_shown(name)} is missing in it); {AGAIN}")
            info = archive.getinfo(roots[0] + name)
            # PyTorch never compresses; what claims to grow when read could fill the memory
            if info.compress_type != zipfile.ZIP_STORED or info.file_size > size:
                raise CheckpointError(
                    f"is damaged ({_shown(name)} is compressed or larger than the file); {AGAIN}"
                )
            return archive.read(info)

        big = roots[0] + "byteorder" in names and member("byteorder") == b"big"
        tensors = _state_dict(_unpickle(io.BytesIO(member("data.pkl")), {}))
        return _arrays(tensors, lambda key: member(f"data/{key}"), ">" if big else "<")


# ---- objects -> arrays


@dataclass(frozen=True, eq=False)
class _Type:
    code: str  # numpy's, without byte order; V2 is bfloat16

    @property
    def itemsize(self) -> int:
        return int(self.code[1:])


@dataclass(frozen=True, eq=False)
class _Storage:
    type: _Type
    key: str
    total: int  # elements of the whole storage
    start: int  # the part of it that this one is, in elements: an old file may hold views
    count: int


@dataclass(frozen=True, eq=False)
class _Tensor:
    type: _Type
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Inert:
    """Stands in for an object that nobody needs: takes any arguments, keeps and does nothing."""

    def __init__(self, *args, **kwargs):
        pass


def _arrays(
    tensors: dict[str, _Tensor], storage_bytes: Callable[[str], bytes], order: str
) -> dict[str, np.ndarray]:
    """Each storage is read once, and only if a tensor needs it."""
    cache: dict[tuple[str, str], np.ndarray] = {}

    def elements(tensor: _Tensor) -> np.ndarray:
        """The tensor's storage as (count,) elements of the tensor's type."""
        storage = tensor.storage
        at = (storage.key, tensor.type.code)
        if at not in cache:
            data = storage_bytes(storage.key)
            if len(data) != storage.total * storage.type.itemsize:
                raise CheckpointError(
                    f"is damaged or cut short (storage {_shown(storage.key)} holds {len(data)} "
                    f"bytes, expected {storage.total * storage.type.itemsize}); {AGAIN}"
                )
            cache[at] = _decode(data, tensor.type, order)
        first = storage.start * storage.type.itemsize // tensor.type.itemsize
        count = storage.count * storage.type.itemsize // tensor.type.itemsize
        return cache[at][first : first + count]

    named = {}
    for name, tensor in tensors.items():
        shape, strides, offset = tensor.shape, tensor.strides, tensor.offset
        count = math.prod(shape)
        base = elements(tensor)
        reach = offset + sum((n - 1) * s for n, s in zip(shape, strides, strict=True)) + 1
        if min(shape, default=0) < 0 or count > MAX_ELEMENTS:
            raise CheckpointError(
                f"is damaged (the tensor {_shown(name)} claims the shape {_shown(str(shape))}); "
                f"{AGAIN}"
            )
        if count and (min(offset, *strides, 0) < 0 or reach > base.size):
            raise CheckpointError(
                f"is damaged (the tensor {_shown(name)} reaches outside its storage); {AGAIN}"
            )
        if count == 0:
            named[name] = np.zeros(shape, base.dtype)
        else:
            steps = [base.itemsize * s for s in strides]
            named[name] = np.ndarray(shape, base.dtype, base, base.itemsize * offset, steps)
    return named


def _decode(data: bytes, type: _Type, order: str) -> np.ndarray:
    if type.code == "V2":  # bfloat16 is the upper half of a float32
        return (np.frombuffer(data, f"{order}u2").astype(np.uint32) << 16).view(np.float32)
    array = np.frombuffer(data, order + type.code)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _state_dict(tree) -> dict[str, _Tensor]:
    if isinstance(tree, dict):
        for place in (tree.get("state_dict"), tree.get("model_state_dict"), tree):
            items = place.items() if isinstance(place, dict) else ()
            tensors = {k: v for k, v in items if isinstance(k, str) and isinstance(v, _Tensor)}
            if tensors:
                return tensors
        # Only texts: what names a tuple can be of any length.
        found = ", ".join(_named(key) for key in list(tree)[:8]) or "nothing"
    else:
        found = f"a {type(tree).__name__.lstrip('_')}"
    raise CheckpointError(
        "holds no tensors by name: expected a state dict, alone or under 'state_dict' or "
        f"'model_state_dict', found {found}; save one with torch.save(network.state_dict(), FILE)"
    )


def _named(key) -> str:
    return _shown(key) if isinstance(key, str) else f"a {type(key).__name__.lstrip('_')}"


def _shown(text: str) -> str:
    """Text out of a file, fit for a one-line message."""
    shown = ascii(text)[1:-1]
    return shown if len(shown) <= 100 else shown[:100] + "..."


# ---- the pickle interpreter


def _ordered_dict(pairs=()) -> dict:
    if any(len(pair) != 2 for pair in pairs):  # thousands of one long list would take gigabytes
        raise TypeError("a dict is made of something else than pairs")
    result = {}
    _put(result, [item for pair in pairs for item in pair])
    return result


def _size(sizes=()) -> tuple:
    if len(sizes) > MAX_DIMENSIONS:  # thousands of long ones would take gigabytes
        raise TypeError(f"a tensor of {len(sizes)} dimensions")
    return tuple(sizes)


def _rebuild_tensor(storage, offset, shape, strides, *rest) -> _Tensor:
    """rest: whether it has a gradient, hooks, perhaps metadata."""
    return _tensor(storage.type, storage, offset, shape, strides, rest[2:])


def _rebuild_untyped(storage, offset, shape, strides, _grad, _hooks, type, *metadata) -> _Tensor:
    return _tensor(type, storage, offset, shape, strides, metadata)


def _tensor(type, storage, offset, shape, strides, metadata: tuple) -> _Tensor:
    if any(metadata):
        raise CheckpointError(
            "holds a tensor that is a view with a negative or conjugate bit; save "
            "tensor.resolve_neg().resolve_conj()"
        )
    whole = isinstance(storage, _Storage) and isinstance(type, _Type) and len(shape) == len(strides)
    shape, strides = _size(shape), _size(strides)
    # Products of numbers of a megabyte would take for ever.
    if not whole or any(
        not isinstance(n, int) or n.bit_length() > 64 for n in (offset, *shape, *strides)
    ):
        raise TypeError("a tensor is not made of a storage and whole numbers")
    return _Tensor(type, storage, offset, shape, strides)


def _rebuild_parameter(tensor, *_):
    return tensor


_STORAGES = {
    "FloatStorage": "f4",
    "DoubleStorage": "f8",
    "HalfStorage": "f2",
    "BFloat16Storage": "V2",
    "ByteStorage": "u1",
    "CharStorage": "i1",
    "ShortStorage": "i2",
    "IntStorage": "i4",
    "LongStorage": "i8",
    "BoolStorage": "b1",
    "UntypedStorage": "u1",
}
_NUMBERS = "float16 float32 float64 uint8 uint16 uint32 uint64 int8 int16 int32 int64 bool".split()
_DTYPES = {name: np.dtype(name).str[1:] for name in _NUMBERS} | {"bfloat16": "V2"}
# Neighbours of the weights in published checkpoints; nothing of them is needed.
_HARMLESS = [
    "parse_config.ConfigParser",  # event_cnn_minimal (FireNet+, E2VID+) saves its configuration
    "utils.parse_config.ConfigParser",  # the same, later versions
    "logger.logger.Logger",  # the training template of E2VID and FireNet saves its log
    "pathlib.Path",  # folders inside those configurations
    "pathlib.PosixPath",
    "pathlib.WindowsPath",
    "pathlib.PurePosixPath",
    "pathlib.PureWindowsPath",
    "pathlib._local.PosixPath",  # Python 3.13
    "pathlib._local.WindowsPath",
    "argparse.Namespace",  # the command line, as many training programs save it
    "numpy.dtype",  # a best loss so far is often a numpy scalar ...
    "numpy.core.multiarray.scalar",
    "numpy._core.multiarray.scalar",  # numpy 2
    "_codecs.encode",  # ... whose bytes protocol 2 writes as text
    "torch.device",
    "collections.Counter",  # of learning-rate schedulers
    "builtins.set",
    "__builtin__.set",  # protocol 2
]
GLOBALS: dict[str, Callable | _Type] = {
    "collections.OrderedDict": _ordered_dict,
    "torch.Size": _size,
    "torch._utils._rebuild_tensor": _rebuild_tensor,
    "torch._utils._rebuild_tensor_v2": _rebuild_tensor,
    "torch._utils._rebuild_tensor_v3": _rebuild_untyped,
    "torch._utils._rebuild_parameter": _rebuild_parameter,
    **{f"torch.{name}": _Type(code) for name, code in (_STORAGES | _DTYPES).items()},
    **{f"torch.cuda.{name}": _Type(code) for name, code in _STORAGES.items()},
    "torch.storage.UntypedStorage": _Type("u1"),
    **dict.fromkeys(_HARMLESS, _Inert),
}


def _global(name: str):
    if name not in GLOBALS:
        raise CheckpointError(
            f"asks for {_shown(name)}, which is not part of a PyTorch checkpoint: nothing was "
            "executed; if you trust the file, load it in PyTorch and save only its state dict"
        )
    return GLOBALS[name]


def _storage(storages: dict[str, _Storage], pid) -> _Storage:
    """Persistent id -> storage; `storages` gathers the whole ones by key."""
    kind, type, key, _device, total, *view = pid
    whole = kind == "storage" and isinstance(type, _Type) and isinstance(key, str)
    if not whole or not isinstance(total, int) or total < 0:
        raise TypeError("a storage is not described as PyTorch describes one")
    start, count = 0, total
    if view and view[0] is not None:
        _view_key, start, count = view[0]
        if min(start, count) < 0 or start + count > total:
            raise ValueError("a part of a storage reaches outside it")
    storages.setdefault(key, _Storage(type, key, total, 0, total))
    return _Storage(type, key, total, start, count)


def _plain(key) -> bool:
    """Whether hashing is quick: a tuple of tuples of tuples can take for ever, and so can a long
    tuple or number that is a key thousands of times."""
    if isinstance(key, tuple):
        short = len(key) <= MAX_KEY
        return short and all(not isinstance(item, tuple) and _plain(item) for item in key)
    if isinstance(key, int):
        return key.bit_length() <= 64
    return key is None or isinstance(key, str | bytes | float | _Inert)


def _put(target, items: list) -> None:
    """Adds keys and values, which alternate in `items`, to a dict."""
    if isinstance(target, _Inert):
        return
    keys, values = items[::2], items[1::2]
    if not isinstance(target, dict) or not all(map(_plain, keys)):
        raise TypeError("items are put into something that takes none")
    target.update(zip(keys, values, strict=True))


def _extend(target, items: list) -> None:
    if isinstance(target, _Inert):
        return
    if not isinstance(target, list):
        raise TypeError("items are appended to something that takes none")
    target.extend(items)


def _length(args) -> int:
    """Items that a function is given, and those of the lists and dicts among them."""
    args = args if isinstance(args, list | tuple) else ()
    return len(args) + sum(len(arg) for arg in args if isinstance(arg, list | tuple | dict))


def _call(function, args):
    # Nothing callable reaches the stack but the functions and stand-ins of GLOBALS.
    if not callable(function) or not isinstance(args, tuple):
        raise TypeError("something is called that cannot be")
    return function(*args)


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
# Instructions whose argument is a value: texts, numbers, bytes, and those of Python 2.
_VALUES = set(
    "BINUNICODE SHORT_BINUNICODE BINUNICODE8 UNICODE BININT BININT1 BININT2 LONG1 LONG4 INT LONG "
    "BINFLOAT FLOAT BINBYTES SHORT_BINBYTES BINBYTES8 STRING BINSTRING SHORT_BINSTRING".split()
)


def _unpickle(stream: io.BytesIO, storages: dict[str, _Storage]):
    """One pickle from the stream -> its object, of dicts, lists, tuples, scalars and tensors.

    Every instruction is read by the standard library's disassembler, which never reads past the
    stream. The memo is a dict, so that an index out of a damaged file costs no memory.
    """
    stack: list = []
    marks: list[int] = []
    memo: dict[int, object] = {}

    def since_mark() -> list:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    def last(n: int) -> list:
        if len(stack) < n:
            raise IndexError("the stack is empty")
        items = stack[len(stack) - n :]
        del stack[len(stack) - n :]
        return items

    arg: Any
    copied = 0
    for number, (opcode, arg, _position) in enumerate(pickletools.genops(stream)):
        if number + copied >= MAX_INSTRUCTIONS:
            raise ValueError(f"a pickle of more than {MAX_INSTRUCTIONS} instructions and items")
        match opcode.name:
            case name if name in _VALUES:
                stack.append(arg)
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_SET":
                stack.append(_Inert())  # no set holds weights
            case "MARK":
                marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(last(int(opcode.name[-1]))))
            case "LIST":
                stack.append(since_mark())
            case "DICT":
                items = since_mark()
                stack.append({})
                _put(stack[-1], items)
            case "FROZENSET":
                since_mark()
                stack.append(_Inert())
            case "APPEND" | "APPENDS" | "ADDITEMS":
                items = last(1) if opcode.name == "APPEND" else since_mark()
                _extend(stack[-1], items)
            case "SETITEM" | "SETITEMS":
                items = last(2) if opcode.name == "SETITEM" else since_mark()
                _put(stack[-1], items)
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                memo[arg] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                stack.append(memo[arg])
            case "POP" | "BUILD":
                last(1)
            case "POP_MARK":
                since_mark()
            case "GLOBAL":
                stack.append(_global(arg.replace(" ", ".", 1)))
            case "STACK_GLOBAL":
                stack.append(_global(".".join(last(2))))
            case "REDUCE" | "NEWOBJ":
                function, args = last(2)
                copied += _length(args)  # one list can be named again and again
                stack.append(_call(function, args))
            case "NEWOBJ_EX":
                function, args, _keywords = last(3)
                copied += _length(args)
                stack.append(_call(function, args))
            case "BINPERSID":
                (pid,) = last(1)
                copied += _length(pid)
                stack.append(_storage(storages, pid))
            case "PROTO" | "FRAME":
                pass
            case "STOP":
                return stack.pop()
            case name:
                raise ValueError(f"the pickle instruction {name} has no place in a checkpoint")
