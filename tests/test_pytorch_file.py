import io
import os
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from firenet_jax.storage import pytorch_file
from firenet_jax.storage.pytorch_file import CheckpointError, read_state_dict

# ---- a writer of both layouts that needs no PyTorch: pickles put together by instruction

ORDERED_DICT = b"ccollections\nOrderedDict\n"


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def number(value: int) -> bytes:
    data = value.to_bytes(9, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def numbers(values) -> bytes:
    return b"(" + b"".join(number(value) for value in values) + b"t"


def tensor(key: str, total: int, shape, strides, offset=0, kind="FloatStorage") -> bytes:
    """As PyTorch writes it: a function, and a storage's persistent id among its arguments."""
    storage = b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(key) + text("cpu")
    storage += number(total) + b"tQ"
    view = number(offset) + numbers(shape) + numbers(strides)
    hooks = ORDERED_DICT + b")R"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + view + b"\x89" + hooks + b"tR"


def mapping(**values: bytes) -> bytes:
    items = b"".join(text(name) + value for name, value in values.items())
    return b"}(" + items + b"u"


def whole(*parts: bytes) -> bytes:
    return b"\x80\x02" + b"".join(parts) + b"."


def old_file(tree: bytes, storages: dict[str, bytes], itemsize=4, order=None) -> bytes:
    machine = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}
    start = [pickle.dumps(value, 2) for value in (0x1950A86A20F9469CFC6C, 1001, machine)]
    keys = pickle.dumps(order or list(storages), 2)
    data = [struct.pack("<q", len(d) // itemsize) + d for d in storages.values()]
    return b"".join([*start, tree, keys, *data])


def new_file(tree: bytes, storages: dict[str, bytes], byteorder="little", **options) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", **options) as archive:
        archive.writestr("model/data.pkl", tree)
        archive.writestr("model/byteorder", byteorder)
        for key, data in storages.items():
            archive.writestr(f"model/data/{key}", data)
        archive.writestr("model/version", "3\n")
    return buffer.getvalue()


LAYOUTS = {"old": old_file, "new": new_file}
VALUES = np.arange(6, dtype="<f4")
TREE = whole(
    mapping(
        epoch=number(7),
        state_dict=mapping(
            a=tensor("0", 6, (2, 3), (3, 1)),
            b=tensor("0", 6, (3, 2), (1, 3)),  # the same storage, transposed
            c=tensor("1", 1, (), ()),
        ),
        config=b"cparse_config\nConfigParser\n)\x81" + mapping(lr=number(1)) + b"b",
    )
)
STORAGES = {"0": VALUES.tobytes(), "1": np.float32(9).tobytes()}


def one(shape, strides, offset=0, total=6, kind="FloatStorage") -> bytes:
    return whole(mapping(a=tensor("0", total, shape, strides, offset, kind)))


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return LAYOUTS[request.param]


@pytest.fixture
def file(tmp_path):
    """Bytes -> the path of a file that holds them."""

    def write(content: bytes) -> Path:
        path = tmp_path / "model.pth"
        path.write_bytes(content)
        return path

    return write


# ---- good files


def test_values_strides_and_shared_storages(file, layout):
    tensors = read_state_dict(file(layout(TREE, STORAGES)))
    assert list(tensors) == ["a", "b", "c"]
    np.testing.assert_array_equal(tensors["a"], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(tensors["b"], tensors["a"].T)
    assert tensors["c"].shape == () and tensors["c"] == 9
    assert np.shares_memory(tensors["a"], tensors["b"])
    assert all(value.dtype == np.float32 for value in tensors.values())


@pytest.mark.parametrize("wrap", ["state_dict", "model_state_dict", None])
def test_finds_the_state_dict(file, wrap):
    tree = mapping(a=tensor("0", 6, (6,), (1,)))
    tree = mapping(**{"epoch": number(1), wrap: tree}) if wrap else tree
    assert list(read_state_dict(file(new_file(whole(tree), STORAGES)))) == ["a"]


def test_big_endian_zip(file):
    storages = {"0": VALUES.astype(">f4").tobytes(), "1": np.array(9, ">f4").tobytes()}
    tensors = read_state_dict(file(new_file(TREE, storages, "big")))
    np.testing.assert_array_equal(tensors["a"].ravel(), VALUES)


def test_bfloat16_becomes_float32(file, layout):
    # 1.5 and -2 are 0x3FC0 and 0xC000: the upper halves of float32
    tree = whole(mapping(a=tensor("0", 2, (2,), (1,), kind="BFloat16Storage")))
    options = {"itemsize": 2} if layout is old_file else {}
    found = read_state_dict(file(layout(tree, {"0": b"\xc0\x3f\x00\xc0"}, **options)))["a"]
    assert found.dtype == np.float32 and found.tolist() == [1.5, -2.0]


def test_view_of_a_storage_in_the_old_layout(file):
    """Before PyTorch 0.4 a storage could be a part of another: (key, offset, size) at the end."""
    tree = TREE.replace(number(1) + b"tQ", number(6) + b"(" + text("v") + b"K\x02K\x01ttQ")
    tree = tree.replace(text("1") + text("cpu"), text("0") + text("cpu"))
    assert tree != TREE
    assert read_state_dict(file(old_file(tree, {"0": VALUES.tobytes()})))["c"] == 2


def test_expanded_tensor_costs_no_memory(file, layout):
    tree = whole(mapping(a=tensor("1", 1, (4, 1000), (0, 0))))
    found = read_state_dict(file(layout(tree, {"1": STORAGES["1"]})))["a"]
    assert found.shape == (4, 1000) and found.strides == (0, 0) and (found == 9).all()


@pytest.mark.parametrize(
    "name",
    [
        "parse_config ConfigParser",
        "pathlib PosixPath",
        "pathlib._local PosixPath",
        "logger.logger Logger",
        "argparse Namespace",
        "numpy.core.multiarray scalar",
        "collections Counter",
        "__builtin__ set",
    ],
)
def test_known_companions_are_skipped(file, layout, name):
    made = f"c{name.replace(' ', chr(10))}\n".encode()
    made += b"(" + text("/") + text("results") + b"tR" + mapping(lr=number(1)) + b"b"
    tree = whole(mapping(config=made, state_dict=mapping(a=tensor("0", 6, (6,), (1,)))))
    assert list(read_state_dict(file(layout(tree, {"0": STORAGES["0"]})))) == ["a"]


# ---- programs instead of data


class Evil:
    def __init__(self, function, *args):
        self.reduced = function, args

    def __reduce__(self):
        return self.reduced


PROGRAMS = {
    "os.system": lambda command: Evil(os.system, command),
    "eval": lambda command: Evil(eval, f"__import__('os').system({command!r})"),
    "exec": lambda command: Evil(exec, f"import os; os.system({command!r})"),
    "nested": lambda command: {"state_dict": {"a": [1, ("b", Evil(os.system, command))]}},
    "getattr": lambda command: Evil(getattr, Evil(__import__, "os"), "system"),
}


@pytest.mark.parametrize("protocol", [2, 4, 5])
@pytest.mark.parametrize("program", PROGRAMS)
def test_nothing_is_executed(file, layout, tmp_path, program, protocol):
    sentinel = tmp_path / "sentinel"
    tree = pickle.dumps(PROGRAMS[program](f"touch {sentinel}"), protocol)
    pickle.loads(tree)  # the attack is real ...
    assert sentinel.exists() or program == "getattr"
    sentinel.unlink(missing_ok=True)
    expected = f"{os.name}.system" if program in ("os.system", "nested") else ""
    with pytest.raises(CheckpointError, match=f"model.pth asks for .*{expected}.*not.* executed"):
        read_state_dict(file(layout(tree, STORAGES)))
    assert not sentinel.exists()  # ... and does nothing here


@pytest.mark.parametrize("place", range(5))
def test_nothing_is_executed_in_any_pickle_of_the_old_layout(file, tmp_path, place):
    sentinel = tmp_path / "sentinel"
    parts = [pickle.dumps(v, 2) for v in (0x1950A86A20F9469CFC6C, 1001, {}, {}, ["0"])]
    parts[3] = one((6,), (1,))
    parts[place] = pickle.dumps(Evil(os.system, f"touch {sentinel}"), 2)
    with pytest.raises(CheckpointError, match=f"model.pth asks for {os.name}.system"):
        read_state_dict(file(b"".join(parts)))
    assert not sentinel.exists()


@pytest.mark.parametrize(
    "tree",
    [
        b"(S'touch {}'\nios\nsystem\n.",  # INST
        b"(cos\nsystem\nS'touch {}'\no.",  # OBJ
        b"\x80\x02\x82\x01.",  # EXT1
        b'\x80\x02cbuiltins\neval\n(S\'open("{}", "w")\'\nt\x81.',  # NEWOBJ
        b"\x80\x02cparse_config\nConfigParser.__init__.__globals__\n.",
        b"\x80\x02ctorch._utils\nos.system\n.",
        b"Ptouch {}\n.",  # PERSID
    ],
)
def test_other_ways_to_a_class(file, layout, tmp_path, tree):
    sentinel = tmp_path / "sentinel"
    tree = tree.replace(b"{}", str(sentinel).encode())
    with pytest.raises(CheckpointError, match="model.pth"):
        read_state_dict(file(layout(tree, STORAGES)))
    assert not sentinel.exists()


def test_state_cannot_change_what_later_files_see(file):
    """BUILD would set attributes, even of the functions that rebuild tensors."""
    state = b"N" + mapping(__defaults__=b"(K\x01K\x02t", __code__=b"N") + b"\x86"
    tree = whole(b"ccollections\nOrderedDict\n" + state + b"b")
    with pytest.raises(CheckpointError, match="no tensors"):
        read_state_dict(file(new_file(tree, {})))
    assert list(read_state_dict(file(new_file(TREE, STORAGES)))) == ["a", "b", "c"]


# ---- damage

SMALL = {"0": STORAGES["0"]}


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (one((7,), (1,)), "outside its storage"),
        (one((2, 3), (4, 1)), "outside its storage"),
        (one((6,), (1,), 1), "outside its storage"),
        (one((2,), (1,), -1), "outside its storage"),
        (one((2,), (-1,), 3), "outside its storage"),
        (one((-2, -3), (3, 1)), "claims the shape"),
        (one((2**40,), (0,)), "claims the shape"),
        (one((2**62, 2**62), (0, 0)), "claims the shape"),
        (one((2,), (1, 1)), "damaged"),
        (one((6,), (1,), total=7), "damaged"),
        (one((6,), (1,), total=2**60), "damaged"),
        (one((3,), (1,), kind="DoubleStorage", total=6), "damaged"),
        (whole(mapping(a=tensor("5", 6, (6,), (1,)))), "damaged"),  # storage is not there
        (whole(mapping(a=number(1))), "no tensors by name.*found a;"),
        (whole(b"]"), "no tensors by name.*found a list;"),
        (whole(b"K\x01r\xff\xff\xff\xff"), "no tensors"),  # memo index 2**32 - 1
        (b"\x80\x02X\xff\xff\xff\xffabc.", "damaged or cut short"),  # a text of 4 GB
        (b"\x80\x05\x96" + b"\xff" * 7 + b"\x00abc.", "damaged or cut short"),  # BYTEARRAY8
        (b"\x80\x02.", "damaged or cut short"),
        (b"\x80\x02K\x01K\x02R.", "damaged or cut short"),
        (b"\x80\x02a.", "damaged or cut short"),
    ],
)
def test_damaged_objects(file, layout, tree, message):
    with pytest.raises(CheckpointError, match=f"model.pth .*{message}"):
        read_state_dict(file(layout(tree, SMALL)))


def test_sizes_of_thousands_of_dimensions(file, layout):
    tree = whole(b"ctorch\nSize\n(" + b"]" + b"(" + b"K\x01" * 65 + b"e" + b"tR")
    with pytest.raises(CheckpointError, match="damaged"):
        read_state_dict(file(layout(tree, SMALL)))


def test_key_that_takes_for_ever_to_hash(file, layout):
    tree = whole(b"}", b")" + b"2\x86" * 60, number(1), b"s")  # t = (t, t), 60 times
    tree = tree.replace(b"2\x86", b"q\x01h\x01\x86")
    with pytest.raises(CheckpointError, match="damaged"):
        read_state_dict(file(layout(tree, SMALL)))


LONG = 3000
NOTHING = b"](" + LONG * b"N" + b"eq\x01"  # a list, which h\x01 puts onto the stack again
STORAGE = tensor("0", 6, (6,), (1,)).partition(b"_v2\n(")[2].partition(b"Q")[0] + b"Qq\x02"
REBUILD = b"ctorch._utils\n_rebuild_tensor_v2\nq\x03"


@pytest.mark.parametrize(
    "tree",
    [
        ORDERED_DICT + b"(](" + NOTHING + (LONG - 1) * b"h\x01" + b"etR",
        b"(" + STORAGE + REBUILD + NOTHING.replace(b"N", b"K\x01")
        + LONG * b"h\x03(h\x02K\x00h\x01h\x01tR" + b"l",
        b"}(" + text("a" * LONG) + b"q\x01" + LONG * b"h\x01" + b"tNs",
    ],
    ids=["pairs", "shapes", "key"],
)  # fmt: skip
def test_lists_that_are_long_and_many_take_no_memory(file, layout, tree):
    """Of n bytes n^2 numbers or characters would be made."""
    path = file(layout(whole(tree), SMALL))
    tracemalloc.start()
    try:
        with pytest.raises(CheckpointError):
            read_state_dict(path)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_keys_that_are_long_and_many_take_no_time(file, layout):
    tuple_ = b"(" + 100 * b"K\x01" + b"tq\x01"
    whole_number = b"\x8b" + struct.pack("<I", 100) + 100 * b"\x01" + b"q\x01"  # of 100 bytes
    for key in (tuple_, whole_number):
        tree = whole(b"}(", key, b"Nh\x01Nu")
        with pytest.raises(CheckpointError, match="put into something that takes none"):
            read_state_dict(file(layout(tree, SMALL)))


def test_a_shape_of_long_numbers(file, layout):
    long = b"\x8b" + struct.pack("<I", 100) + 100 * b"\x01"
    tree = one((7,), (1,)).replace(number(7), long)
    with pytest.raises(CheckpointError, match="a storage and whole numbers"):
        read_state_dict(file(layout(tree, SMALL)))


def test_instructions_without_end(file, layout, monkeypatch):
    monkeypatch.setattr(pytorch_file, "MAX_INSTRUCTIONS", 1000)
    assert list(read_state_dict(file(layout(TREE, STORAGES)))) == ["a", "b", "c"]
    with pytest.raises(CheckpointError, match="more than 1000 instructions"):
        read_state_dict(file(layout(whole(1000 * b"}"), SMALL)))


def test_one_list_of_pairs_from_which_dicts_are_made_without_end(file, layout, monkeypatch):
    """Six bytes of the file make a dict of all pairs: a megabyte could fill all memory."""
    monkeypatch.setattr(pytorch_file, "MAX_INSTRUCTIONS", 2000)
    pairs = b"]q\x01(" + b"".join(number(n) + b"N\x86" for n in range(200)) + b"e0"
    made = b"ccollections\nOrderedDict\nq\x020](" + 20 * b"h\x02h\x01\x85R" + b"e"
    with pytest.raises(CheckpointError, match="more than 2000 instructions and items"):
        read_state_dict(file(layout(whole(pairs, made), SMALL)))


def test_one_long_tuple_that_is_given_without_end(file, layout, monkeypatch):
    """To a function, or as the name of a storage: each time it was copied."""
    monkeypatch.setattr(pytorch_file, "MAX_INSTRUCTIONS", 3000)
    given = b"(" + 200 * b"N" + b"tq\x01"
    storage = text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu") + number(1)
    named = b"(" + storage + 200 * b"N" + b"tq\x01"
    calls = b"cnumpy\ndtype\nq\x02](" + 20 * b"h\x02h\x01R" + b"e"
    for parts in ((given, b"0", calls), (named, b"0](", 20 * b"h\x01Q", b"e")):
        with pytest.raises(CheckpointError, match="more than 3000 instructions and items"):
            read_state_dict(file(layout(whole(*parts), SMALL)))


def test_members_of_a_zip_that_overlap(file):
    """Each holds all that follow it: of n bytes n^2 would be read."""
    content = new_file(whole(mapping(a=tensor("0", 6, (6,), (1,)))), SMALL | {"1": bytes(4000)})
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        end = archive.start_dir
        found = archive.getinfo("model/data/0")
    start = found.header_offset + 30 + len(found.filename)
    at = content.index(b"model/data/0", end) - 46  # in the list of members: checksum, two sizes
    sizes = struct.pack("<III", zlib.crc32(content[start:end]), end - start, end - start)
    with pytest.raises(CheckpointError, match="its members overlap each other"):
        read_state_dict(file(content[: at + 16] + sizes + content[at + 28 :]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "model.pth is not a PyTorch checkpoint .it is empty.; copy or download"),
        (b"<!DOCTYPE html><html>", "starts with b'<!DOCTYPE html>"),
        (b"PK\x03\x04 and no more", "damaged or cut short"),
        (pickle.dumps({"a": 1}, 4), "is a pickle but not a PyTorch checkpoint"),
        (old_file(TREE, STORAGES)[:-1], "storage 1 should hold 1 elements"),
        (old_file(TREE, STORAGES)[:300], "damaged or cut short"),
        (new_file(TREE, STORAGES)[:300], "damaged or cut short"),
        (new_file(TREE, {"0": STORAGES["0"]}), "data/1 is missing"),
        (new_file(TREE, STORAGES | {"1": b"\0" * 8}), "storage 1 holds 8 bytes, expected 4"),
        (new_file(TREE, STORAGES, compression=zipfile.ZIP_DEFLATED), "is compressed or larger"),
    ],
)
def test_damaged_files(file, content, message):
    with pytest.raises(CheckpointError, match=message):
        read_state_dict(file(content))


def test_a_file_that_is_far_too_large_is_not_read(tmp_path):
    with (tmp_path / "w.pth").open("wb") as sparse:
        sparse.write(b"\x80\x02")
        sparse.truncate(2**31)
    with pytest.raises(CheckpointError, match="w.pth holds 2147483648 bytes"):
        read_state_dict(tmp_path / "w.pth")


def test_other_zip(tmp_path):
    with zipfile.ZipFile(tmp_path / "events.zip", "w") as archive:
        archive.writestr("events.txt", "240 180\n")
    with pytest.raises(CheckpointError, match="events.zip is a zip file but not a PyTorch"):
        read_state_dict(tmp_path / "events.zip")


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.pth", tmp_path):
        with pytest.raises(CheckpointError, match=f"{path.name} cannot be read"):
            read_state_dict(path)


def mutations(content: bytes, count: int):
    rng = np.random.default_rng(0)
    for i in range(count):
        at, other = sorted(rng.integers(0, len(content), 2))
        data = bytearray(content)
        match i % 4:
            case 0:
                data[at] ^= 1 << rng.integers(8)
            case 1:
                data[at] = rng.integers(256)
            case 2:
                del data[at : min(other, at + rng.integers(1, 9))]
            case 3:
                del data[at:]
        yield bytes(data)


@pytest.mark.parametrize("part", ["file", "object"])
def test_fuzz(file, layout, part):
    """Whatever happened to the bytes: an answer or CheckpointError, and little memory."""
    if part == "file":
        contents = mutations(layout(TREE, STORAGES), 300)
    else:  # damage that no checksum of a zip file can see
        contents = (layout(tree, STORAGES) for tree in mutations(TREE, 300))
    refused = 0
    tracemalloc.start()
    try:
        for content in contents:
            try:
                tensors = read_state_dict(file(content))
            except CheckpointError as error:
                assert "\n" not in str(error) and "model.pth" in str(error)
                refused += 1
            else:
                assert all(isinstance(value, np.ndarray) for value in tensors.values())
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert refused > 150


# ---- against PyTorch


@pytest.fixture
def saved(tmp_path):
    """An object and a layout -> a file written by PyTorch, and what torch.load makes of it."""
    torch = pytest.importorskip("torch", reason="needs PyTorch")

    def save(value, new: bool):
        path = tmp_path / "torch.pth"
        torch.save(value, path, _use_new_zipfile_serialization=new)
        return path, torch.load(path, weights_only=True)

    return save


def assert_same(path, state_dict):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    found = read_state_dict(path)
    assert list(found) == list(state_dict)
    for name, value in state_dict.items():
        value = value.detach()
        value = value.float() if value.dtype == torch.bfloat16 else value
        assert found[name].dtype == value.numpy().dtype
        np.testing.assert_array_equal(found[name], value.numpy())


both = pytest.mark.parametrize("new", [False, True], ids=["old", "new"])


@pytest.mark.reference
@both
def test_torch_dtypes(saved, new):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    names = "float32 float64 float16 bfloat16 int8 int16 int32 int64 uint8 bool"
    path, loaded = saved(
        {name: torch.arange(-3, 3).to(getattr(torch, name)) for name in names.split()}, new
    )
    assert_same(path, loaded)


@pytest.mark.reference
def test_torch_dtypes_without_a_storage_of_their_own(saved):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    path, loaded = saved({"a": torch.arange(6).to(torch.uint16).reshape(2, 3)[:, 1:]}, True)
    assert_same(path, loaded)


@pytest.mark.reference
@both
def test_torch_views(saved, new):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    base = torch.arange(120, dtype=torch.float32).reshape(2, 3, 4, 5)
    views = {
        "base": base,
        "permuted": base.permute(2, 0, 3, 1),
        "sliced": base[:, 1:, ::2, 1:4],
        "channels_last": base.contiguous(memory_format=torch.channels_last),
        "expanded": base[0, 0, 0, :1].expand(7, 1, 3),
        "scalar": base[1, 2, 3, 4],
        "empty": base[:, :0],
        "parameter": torch.nn.Parameter(base[0].clone()),
    }
    path, loaded = saved({"epoch": 1, "state_dict": views}, new)
    assert_same(path, loaded["state_dict"])


@pytest.mark.reference
@both
def test_torch_views_that_count_negated_are_refused(tmp_path, new):
    """The file holds the numbers as they are, and beside them that they are not."""
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    path, view = tmp_path / "m.pth", torch._neg_view(torch.ones(3))
    torch.save({"a": view}, path, _use_new_zipfile_serialization=new)
    with pytest.raises(CheckpointError, match="m.pth holds a tensor that is a view .*resolve_neg"):
        read_state_dict(path)


@pytest.mark.reference
@both
@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_torch_modules_and_optimisers(tmp_path, new, protocol):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    network = torch.nn.Sequential(torch.nn.Conv2d(2, 3, 3), torch.nn.BatchNorm2d(3))
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.zeros(1, 2, 5, 5)).sum().backward()
    optimiser.step()
    value = {
        "state_dict": network.state_dict(),
        "optimizer": optimiser.state_dict(),
        "config": {"path": Path("results"), "loss": np.float64(0.5)},
        "device": torch.device("cpu"),
        "size": torch.Size([1, 2]),
    }
    path = tmp_path / "torch.pth"
    torch.save(value, path, pickle_protocol=protocol, _use_new_zipfile_serialization=new)
    assert_same(path, network.state_dict())


@pytest.mark.reference
@both
def test_torch_whole_module_is_refused(tmp_path, new):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    torch.save(torch.nn.Conv2d(1, 1, 1), tmp_path / "m.pth", _use_new_zipfile_serialization=new)
    with pytest.raises(CheckpointError, match="m.pth asks for torch.nn.modules.conv.Conv2d"):
        read_state_dict(tmp_path / "m.pth")


@pytest.mark.reference
def test_published_checkpoint(reference):
    tensors = read_state_dict(reference / "firenet_published.pth")
    assert sum(value.size for value in tensors.values()) == 37_777  # the paper's "38k"
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    loaded = torch.load(reference / "firenet_published.pth", weights_only=True, map_location="cpu")
    assert_same(reference / "firenet_published.pth", loaded["state_dict"])
