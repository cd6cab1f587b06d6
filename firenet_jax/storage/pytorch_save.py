"""{name: dict, list, text, number or numpy array} -> PyTorch file, without PyTorch.

The zip that torch.save has written since PyTorch 1.6, with members stored, not compressed:
`*/data.pkl`, `*/data/<key>` for the elements of each array, `*/byteorder` and `*/version`. The
pickle holds dicts, lists, texts, numbers and tensors alone, so torch.load reads it with
weights_only=True. A tensor is torch._utils._rebuild_tensor_v2(storage, offset, shape, strides,
requires_grad, hooks), and its storage a persistent id ("storage", type, key, device, count).

Instructions of pickles: pickletools in the standard library explains each; these are protocol 2.
"""

import io
import struct
import zipfile

import numpy as np

ROOT = "archive"
PROTOCOL, STOP = b"\x80\x02", b"."
FALSE, TRUE, NONE = b"\x89", b"\x88", b"N"
EMPTY_DICT = b"ccollections\nOrderedDict\n)R"


def pytorch_file(content: dict) -> bytes:
    """The whole file. Raises TypeError for arrays that are not float32, and for other types than
    those above; struct.error for integers of more than 255 bytes."""
    storages: list[np.ndarray] = []
    pickled = PROTOCOL + _pickled(content, storages) + STOP
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(_member("data.pkl"), pickled)
        archive.writestr(_member("byteorder"), b"little")
        for key, array in enumerate(storages):
            archive.writestr(_member(f"data/{key}"), array.astype("<f4").tobytes())
        archive.writestr(_member("version"), b"3\n")
    return stream.getvalue()


def _member(name: str) -> zipfile.ZipInfo:
    """No time of writing: the same weights give the same file."""
    return zipfile.ZipInfo(f"{ROOT}/{name}")


def _pickled(value, storages: list[np.ndarray]) -> bytes:
    """Instructions that leave this value on the stack."""

    def tuple_of(*items) -> bytes:
        return b"(" + b"".join(items) + b"t"

    def instructions(value) -> bytes:
        match value:
            case None:
                return NONE
            case bool():
                return TRUE if value else FALSE
            case int() if -(2**31) <= value < 2**31:
                return b"J" + struct.pack("<i", value)
            case int():
                number = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
                return b"\x8a" + struct.pack("<B", len(number)) + number
            case float():
                return b"G" + struct.pack(">d", value)
            case str():
                text = value.encode()
                return b"X" + struct.pack("<I", len(text)) + text
            case tuple():
                return tuple_of(*map(instructions, value))
            case list():
                return b"](" + b"".join(map(instructions, value)) + b"e"
            case dict():
                items = b"".join(instructions(x) for pair in value.items() for x in pair)
                return EMPTY_DICT + b"(" + items + b"u"
            case np.ndarray() if value.dtype == np.float32:
                return tensor(value)
        raise TypeError(f"a PyTorch file has no place for {type(value).__name__} here")

    def tensor(array: np.ndarray) -> bytes:
        kind = b"ctorch\nFloatStorage\n"
        key = instructions(str(len(storages)))
        storages.append(array)
        count = instructions(array.size)
        storage = tuple_of(instructions("storage"), kind, key, instructions("cpu"), count) + b"Q"
        strides = tuple(step // array.itemsize for step in np.empty(array.shape, "f4").strides)
        start, shape = instructions(0), instructions(array.shape)
        parts = storage, start, shape, instructions(strides), FALSE, EMPTY_DICT
        return b"ctorch._utils\n_rebuild_tensor_v2\n" + tuple_of(*parts) + b"R"

    return instructions(value)
