"""Mutated inputs of everything that is read -> how many were read, refused, or broke the program.

    python tests/mutated.py --count 50000 --seed 0          an hour and more on one core

Input number n is a function of the seed, n and `--only`: `--first N --count 1` runs one again.
Inputs are small files of every format, written here, and with FIRENET_RECORDINGS and
FIRENET_REFERENCE set real ones, or their beginnings. Refusing is a FirenetError or OSError whose
message is one line; anything else is a fault of ours: another exception, a process that ends
(inputs are read in a worker, which is started again), more than 8 GB, more than a minute of the
processor's time (not of the clock: a busy machine changes nothing), or ten minutes asleep.
"""

import argparse
import collections
import contextlib
import gzip
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np

from firenet_jax.errors import FirenetError

SLOW = 60.0  # seconds of the processor's time
ASLEEP = 600.0  # seconds of the clock
AT_ONCE = 2500  # inputs that one worker reads: libraries keep a little of what they have opened
STATE = {"kernel": np.ones((3, 4), np.float32), "count": np.int32(3)}  # of a checkpoint
NASTY = [
    b"nan", b"-1", b"1e999", b"9" * 400, "١٢٣".encode(), b"\x0c", b"\x00", b"\xff\xfe", b"0x10",
    b"", b" ", b",", b"\n", b"\r", b'"', b"..", b"{", b"[" * 2000, b"1_000", b"\xef\xbb\xbf",
    b"inf", b"-0", b"2147483648", b"9223372036854775808", b"1.5", b"\t",
]  # fmt: skip


# ---- Whole inputs: name -> files of a folder, and which of them is read


def inputs(folder: Path) -> dict[str, Path]:
    """Writes them; returns what is opened, by name."""
    import h5py
    from PIL import Image

    from firenet_jax.checkpoint import save_weights
    from firenet_jax.live.sources import BINARY
    from firenet_jax.network import Weights
    from firenet_jax.storage.video import write_video

    rng = np.random.default_rng(0)
    count, found = 300, {}
    t = np.sort(rng.integers(0, 10**6, count))
    x, y, p = rng.integers(0, 24, count), rng.integers(0, 20, count), rng.integers(0, 2, count)
    rows = [f"{a / 1e6:.6f} {b} {c} {d}" for a, b, c, d in zip(t, x, y, p, strict=True)]

    def made(name: str, content: bytes) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        top = name.partition("/")[0]
        found.setdefault(top, folder / top if top.startswith("bag_") else path)
        return path

    text = "24 20\n" + "\n".join(rows) + "\n"
    made("a.txt", text.encode())
    made("named.csv", ("t,x,y,p\n" + "\n".join(row.replace(" ", ",") for row in rows)).encode())
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", text)
    found["a.zip"] = folder / "a.zip"
    for name, content in (("events.txt", "\n".join(rows)), ("images.txt", "0.1 images/a.png\n")):
        made(f"ecd/{name}", content.encode())
    (folder / "ecd/images").mkdir()
    Image.fromarray(np.zeros((20, 24), np.uint8)).save(folder / "ecd/images/a.png")
    found["ecd"] = folder / "ecd"
    with h5py.File(folder / "a.h5", "w") as file:
        for name, column in (("xs", x), ("ys", y), ("ts", t / 1e6), ("ps", p > 0)):
            file[f"events/{name}"] = column
        for k in range(4):
            file[f"images/image{k:09d}"] = np.zeros((20, 24), np.uint8)
            file[f"images/image{k:09d}"].attrs["timestamp"] = k / 4
        file.attrs["sensor_resolution"] = (20, 24)
    found["a.h5"] = found["training.h5"] = folder / "a.h5"
    folder_of = folder / "npy"
    folder_of.mkdir()
    for name, column in (("t", t / 1e6), ("xy", np.stack([x, y], 1)), ("p", p > 0)):
        np.save(folder_of / f"{name}.npy", column)
    (folder_of / "metadata.json").write_text('{"sensor_resolution": [20, 24]}')
    found["npy"] = folder_of
    words = np.stack([t, x | y << 14 | p << 28], 1).astype("<u4").tobytes()
    made("a.dat", b"% Version 2\n% Width 24\n% Height 20\n\x00\x08" + words)
    bits = [x, y, p << 7 | t >> 16, t >> 8 & 255, t & 255]
    made("a.bin", np.stack(bits, 1).astype(np.uint8).tobytes())
    words = [0x8001, 0x6001, 0x0003, 0x2805, 0xA101, 0x3002, 0x4FFF, 0x50FF]  # a trigger, too
    evt3 = np.array(words * 60, "<u2")
    made("a.raw", b"% evt 3.0\n% geometry 1280x720\n% end\n" + evt3.tobytes())
    _newer(made, t.tolist(), x.tolist(), y.tolist(), p.tolist())
    save_weights(folder / "weights.npz", Weights(_params(), True))
    found["weights.npz"] = found["resume.npz"] = folder / "weights.npz"
    made("hot.txt", b"1,1\n2,3\n17,4\n")
    write_video(folder / "clip.mp4", rng.integers(0, 256, (6, 48, 64), np.uint8))
    write_video(folder / "clip.gif", rng.integers(0, 256, (6, 48, 64), np.uint8))
    found |= {name: folder / name for name in ("clip.mp4", "clip.gif")}
    Image.fromarray(rng.integers(0, 256, (40, 50, 3), np.uint8)).save(folder / "picture.png")
    Image.fromarray(rng.integers(0, 256, (40, 50, 3), np.uint8)).save(folder / "picture.jpg")
    found |= {name: folder / name for name in ("picture.png", "picture.jpg")}
    _arrays(folder, found, t, x, y, p)
    made("a.txt.gz", gzip.compress(text.encode(), mtime=0))
    made("settings.json", json.dumps({"steps": 30, "batch": {"size": 2, "names": ["a"]}}).encode())
    made("wire.text", text.partition("\n")[2].encode())
    for name, kind in BINARY.items():
        made(f"wire.{name}", np.zeros(40, kind).tobytes())
    made("times.txt", "".join(f"{k / 30:.6f} 0.1 0.2\n" for k in range(30)).encode())
    made("stamps.csv", b"#timestamp [ns],filename\n33300000,a.png\n66600000,b.png\n")
    _unfinished(folder, found)
    entry = {"step": 1, "kind": "validation", "loss": 0.5, "seconds": 1.0}
    made("log.jsonl", "".join(json.dumps(entry | {"step": k}) + "\n" for k in range(20)).encode())
    if samples := os.environ.get("FIRENET_RECORDINGS"):
        beginnings = {"davis346_frames.aedat4": None, "ncars.dat": None,
                      "e2vid_slider_depth.zip": None, "ncaltech101_faces_easy_0001.bin": 20_000,
                      "dvxplorer_face.aedat4": 60_000,
                      "ros1_event_camera_msgs.bag": None, "evt2_sparklers.raw": 20_000,
                      "dvs_synthetic_sweep.es": 20_000, "davis346_59_frames.aedat4": 150_000,
                      "evt3_driving.raw": 20_000, "davis240_boxes.aedat": 200_000,
                      "ros2_mcap/test_events_2_0.mcap": 200_000}  # fmt: skip
        for name, size in beginnings.items():
            if (Path(samples) / name).is_file():
                made(Path(name).name, (Path(samples) / name).read_bytes()[:size])
    if reference := os.environ.get("FIRENET_REFERENCE"):
        for path in Path(reference).glob("*.pth*"):
            if path.stat().st_size < 1 << 20:
                made(path.name, path.read_bytes())
    return found


def _arrays(folder: Path, found: dict[str, Path], t, x, y, p) -> None:
    """numpy's files of one array and of several; HDF5 of DSEC, MVSEC, v2e and Metavision."""
    import h5py

    names = {"t": t, "x": x, "y": y, "p": p}
    fields = np.zeros(len(t), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
    for name, column in names.items():
        fields[name] = column
    rows = np.stack([t, x, y, p], 1)
    np.save(folder / "rows.npy", rows)
    np.save(folder / "fields.npy", fields)
    np.savez_compressed(folder / "events.npz", **names)
    with h5py.File(folder / "dsec.h5", "w") as file:
        file["t_offset"] = 5
        for name, column in names.items():
            file.create_dataset(f"events/{name}", data=column, compression="gzip")
    with h5py.File(folder / "mvsec.h5", "w") as file:
        file["davis/left/events"] = np.stack([x, y, t / 1e6, 2 * p - 1], 1)
        file["davis/left/image_raw"] = np.zeros((2, 20, 24), np.uint8)
        file["davis/left/image_raw_ts"] = [0.1, 0.5]
    with h5py.File(folder / "v2e.h5", "w") as file:
        file.create_dataset("events", data=rows.astype(np.uint32), chunks=True, compression="gzip")
    with h5py.File(folder / "metavision.h5", "w") as file:
        file["CD/events"] = fields
        file.attrs["geometry"] = "24x20"
    for path in folder.iterdir():
        if path.name in ("rows.npy", "fields.npy", "events.npz", "dsec.h5", "mvsec.h5", "v2e.h5",
                         "metavision.h5"):  # fmt: skip
            found[path.name] = path


def _unfinished(folder: Path, found: dict[str, Path]) -> None:
    """What interrupted runs leave: pictures and a position, a note on a video, a checkpoint."""
    import orbax.checkpoint as ocp

    from firenet_jax.storage.resume import keep_position, mark_done, publish_position
    from firenet_jax.storage.video import FolderWriter

    output = folder / "unfinished/out"
    output.parent.mkdir()
    writer = FolderWriter(output, at_times=True)
    for number in range(3):
        writer.write(np.zeros((20, 24), np.uint8), 1000 * number, 10)
    writer.flush()
    writer.holding.close()
    keep_position(output, {"seed": 0}, 3, 3, state0=np.zeros((4, 5), np.float32))
    publish_position(output, 3)
    video = output.with_name("video.gif")
    video.write_bytes(b"whole")
    mark_done(video, {"seed": 0}, video)
    with ocp.CheckpointManager(folder / "checkpoint") as saved:
        saved.save(3, args=ocp.args.StandardSave(STATE))
    found |= {"unfinished": output.parent, "checkpoint": folder / "checkpoint"}


def _newer(made, t: list, x: list, y: list, p: list) -> None:
    """AEDAT of three versions with frames, triggers; ROS 2 in MCAP, whole and torn; EVT2, 2.1."""
    import formats as f
    import pyarrow

    frame = np.arange(24 * 20).reshape(20, 24)
    scans = [
        (f.pixel(i, j, 600 - 200 * exposed, exposed, 180), 1000 * exposed + i)
        for exposed in (0, 1)
        for i in range(240)
        for j in range(180)
    ]
    rows = list(zip(t, x, y, p, strict=True))
    davis = [(f.davis(a, b, c), time) for time, a, b, c in rows]
    others = [(f.EDGE, 5), (f.IMU, 6)]
    made("frames.aedat", f.aedat2(scans + others + davis))
    made("davis.aedat", f.aedat2(others + davis))
    made("nameless.aedat", f.aedat2(davis, chip=None))
    dvs = [(f.dvs128(a, b, c), time) for time, a, b, c in rows]
    made("dvs128.aedat", f.aedat2([*dvs, (1 << 15, 7)], chip="retina.DVS128"))
    entries = [f.polarity31(*row) for row in rows]
    pictures = [f.frame31((k, k + 9, k + 2, k + 4), frame) for k in (0, 100)]
    specials = [f.special31(k, 2 + k % 3) for k in range(9)]
    packets = [(0, specials), (1, entries[:200]), (2, pictures), (1, entries[200:])]
    made("three.aedat", f.aedat31(*(f.packet31(*packet) for packet in packets)))
    streams = {0: ("EVTS", 240, 180), 1: ("TRIG", 0, 0)}
    edges = f.triggers4([(5 * k, k % 6) for k in range(20)])
    made("four.aedat", f.aedat4(streams, [(0, f.events4(rows[:9])), (1, edges)]))
    evt3 = np.array([0x8001, 0x6001, 0x0003, 0x2805, 0xA101, 0x3002, 0x4FFF] * 9, "<u2").tobytes()
    cmp = np.array([0x0001, 0x1002, 0x2005, 0x3803, 0x4064, 0x5081] * 9, "<u2").tobytes()
    plain = b"".join(f.polarity31(*row) for row in rows[:40])
    for name, payload, encoding, how in (
        ("evt3", evt3, "evt3", "lz4"), ("cmp", cmp, "libcaer_cmp", ""),
        ("plain", plain, "libcaer", "zstd"),
    ):  # fmt: skip
        chunks = [
            [(10**9 * k, f.event_packet(10**6 * k, payload, encoding, 10**9 * k))]
            for k in range(1, 5)
        ]
        pack = (lambda data, how=how: pyarrow.compress(data, how, asbytes=True)) if how else None
        made(f"{name}.mcap", f.mcap(chunks, pack=pack, how=how))
        told = b"storage_identifier: ''\nrelative_file_paths:\n- a.mcap\n"
        made(f"bag_{name}/metadata.yaml", told)
        made(f"bag_{name}/a.mcap", f.mcap(chunks, pack=pack, how=how))
    made("bag_sqlite/metadata.yaml", told.replace(b"mcap", b"db3"))
    _sqlite(made("bag_sqlite/a.db3", b""), [message for chunk in chunks for message in chunk])
    words = [0x80000001, 0x10000803, 0xA0000101, 0x00001004] * 20
    made("two.raw", b"% evt 2.0\n% geometry 1280x720\n% end\n" + np.array(words, "<u4").tobytes())
    words = [0x80000001, 0, 0x10000803, 0xF00F, 0xA0000101, 0, 0x00001004, 1] * 10
    evt21 = b"% format EVT21;endianness=legacy;height=720;width=1280\n% end\n"
    made("evt21.raw", evt21 + np.array(words, "<u4").tobytes())


def _sqlite(path: Path, messages: list) -> None:
    import sqlite3

    name, kind = "/event_camera/events", "event_camera_msgs/msg/EventPacket"
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.execute(
            "create table topics (id integer primary key, name text, type text,"
            " serialization_format text, offered_qos_profiles text)"
        )
        file.execute(
            "create table messages (id integer primary key, topic_id integer,"
            " timestamp integer, data blob)"
        )
        file.execute("insert into topics values (1, ?, ?, 'cdr', '')", (name, kind))
        rows = [(time, data) for time, data in messages]
        file.executemany("insert into messages (topic_id, timestamp, data) values (1, ?, ?)", rows)


def _params():
    import jax

    from firenet_jax.network import initial_params

    return initial_params(jax.random.key(0))


# ---- Mutations


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    data = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 4, 16]))):
        kind, size = int(rng.integers(8)), max(len(data), 1)
        # Half of the places are near the beginning, where headers are.
        at = int(rng.integers(min(size, 400) if rng.random() < 0.5 else size))
        length = int(rng.integers(1, 40))
        if kind == 0 and data:
            data[min(at, len(data) - 1)] = int(rng.integers(256))
        elif kind == 1 and data:
            data[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            data[at:at] = NASTY[int(rng.integers(len(NASTY)))]
        elif kind == 5:
            data[at : at + length] = rng.bytes(length)
        elif kind == 6:
            data[at : at + 4] = [b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f"][int(rng.integers(3))]
        else:
            other = int(rng.integers(size))
            data[at:at] = data[other : other + length]
    return bytes(data)


def read(name: str, path: Path) -> None:
    """As the program reads it."""
    from firenet_jax.checkpoint import load_weights
    from firenet_jax.commands.times import read_times
    from firenet_jax.filters import read_hot_pixels
    from firenet_jax.live import sources
    from firenet_jax.readers import open_recording
    from firenet_jax.simulation import textures
    from firenet_jax.simulation.clip import read_clip
    from firenet_jax.storage.files import read_arrays
    from firenet_jax.storage.runs import read_record
    from firenet_jax.training import batches
    from firenet_jax.training import log as training_log

    if name == "hot.txt":
        read_hot_pixels(path, 20, 24)
    elif name == "training.h5":
        facts = batches._facts(path)
        index = batches._index(path)
        batches._example(
            np.random.default_rng(0), facts, index, batches.Augment(),
            windows=2, crop=16, chain=1, part=0,
        )  # fmt: skip
    elif name == "resume.npz":
        read_arrays(path)
    elif name == "unfinished":
        _go_on(path / "out")
    elif name == "checkpoint":
        _restore(path)
    elif name in ("times.txt", "stamps.csv"):
        read_times(path)
    elif name == "settings.json":
        read_record(path, "remove it")
    elif name.startswith("wire."):
        data = path.read_bytes()
        pieces = (data[start : start + 100] for start in range(0, len(data), 100))
        for _ in sources.decoded(pieces, name.removeprefix("wire.")):
            pass
    elif name == "weights.npz" or name.endswith((".pth", ".tar")):
        load_weights(path)
    elif name.startswith("clip"):
        for _ in read_clip(path):
            pass
    elif name.startswith("picture"):
        textures.load_textures(path.parent, 1, 32, 0)
    elif name == "log.jsonl":
        log = training_log.Log.__new__(training_log.Log)
        log.entries = [entry for entry in training_log.entries(path) if entry["step"] <= 100]
        f"{log.best():.4f}"
    else:
        recording = open_recording(path)
        for number, _ in enumerate(recording.events()):
            if number > 50:
                break
        recording.triggers()
        if recording.frames is not None:
            for number in range(min(3, len(recording.frames.times))):
                recording.frames.read(number)


def _go_on(output: Path) -> None:
    """As `reconstruct` does after an interruption, to the end."""
    from firenet_jax.storage.resume import is_done, read_position
    from firenet_jax.storage.video import FolderWriter, check_output

    check_output(output, overwrite=False)
    is_done(output.with_name("video.gif"), {"seed": 0})
    saved = read_position(output, {"seed": 0}, overwrite=False)
    writer = FolderWriter(output, at_times=True)
    if saved is not None:
        writer.keep(int(saved["pictures"]))
    writer.write(np.zeros((20, 24), np.uint8), 4000, 10)
    writer.finish()


def _restore(folder: Path) -> None:
    import orbax.checkpoint as ocp

    from firenet_jax.training.run import restored

    with ocp.CheckpointManager(folder) as saved:
        if saved.latest_step() is not None:
            restored(saved, STATE)


def one(seed: int, number: int, whole: dict[str, Path], folder: Path) -> tuple[str, str]:
    """(what was read, what came of it): "read", "refused: ..." or "FAULT: ..." """
    import shutil

    rng = np.random.default_rng((seed, number))
    name = sorted(whole)[number % len(whole)]
    source = whole[name]
    target = folder / ("training.h5" if name == "training.h5" else source.name)
    if source.is_dir():
        shutil.copytree(source, target)
        files = sorted(file for file in target.rglob("*") if file.is_file())
        changed = files[int(rng.integers(len(files)))]
    else:
        target.write_bytes(source.read_bytes())
        changed = target
    changed.write_bytes(mutated(rng, changed.read_bytes()))
    try:
        read(name, target)
    except (FirenetError, OSError) as error:
        if len(str(error).splitlines()) == 1:
            return name, "refused"
        return name, f"FAULT: {type(error).__name__}: {str(error)[:300]!r}"
    except BaseException as error:
        return name, f"FAULT: {type(error).__name__}: {str(error)[:300]!r}"
    finally:
        shutil.rmtree(target, ignore_errors=True)
        target.unlink(missing_ok=True)
    return name, "read"


def work(seed: int, first: int, count: int, only: str = "") -> None:
    """In a process of its own: a line for each input before and after it is read."""
    import resource

    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as place:
        folder, inside = Path(place) / "whole", Path(place) / "mutated"
        folder.mkdir()
        inside.mkdir()
        whole = inputs(folder)
        if only:
            words = only.split(",")
            whole = {name: path for name, path in whole.items() if any(w in name for w in words)}
        for name, path in whole.items():  # loads libraries, which takes its time on a busy machine
            with contextlib.suppress(Exception):
                read(name, path)
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        for number in range(first, first + count):
            print(json.dumps([number, "begins", ""]), flush=True)
            # All threads count, and code that never returns to Python is ended, too.
            signal.setitimer(signal.ITIMER_PROF, SLOW)
            print(json.dumps([number, *one(seed, number, whole, inside)]), flush=True)


def run(seed: int, first: int, count: int, only: str = "") -> tuple[collections.Counter, list[str]]:
    """(how many came to what, the faults)"""
    import selectors

    counts, faults, number, stop = collections.Counter(), [], first, first + count
    while number < stop:
        command = [sys.executable, __file__, "--worker", "--seed", str(seed), "--first",
                   str(number), "--count", str(min(stop - number, AT_ONCE)), "--only",
                   only]  # fmt: skip
        end = min(stop, number + AT_ONCE)
        worker = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        watch = selectors.DefaultSelector()
        watch.register(worker.stdout, selectors.EVENT_READ)
        last, what = number, "ends the process"
        ready = False  # its start is no input's fault
        while True:
            if not watch.select(ASLEEP if ready else None):
                what = "sleeps"
                worker.kill()
                break
            line = worker.stdout.readline()
            if not line:
                break
            ready = True
            last, name, came = json.loads(line)
            if name == "begins":
                continue
            counts[came.partition(":")[0]] += 1
            if came.startswith("FAULT"):
                faults.append(f"{last}: {name}: {came}")
                print(faults[-1], flush=True)
            number = last + 1
            if number % 1000 == 0:
                print(number, dict(counts), file=sys.stderr, flush=True)
        code = worker.wait()
        if code == -signal.SIGPROF:
            what = "takes more than a minute"
        watch.close()
        worker.stdout.close()
        if number < end:
            counts["FAULT"] += 1
            faults.append(f"{last}: {what} (exit {code})")
            print(faults[-1], flush=True)
            number = last + 1
    return counts, faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="", help="words in the inputs' names, commas between")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options.seed, options.first, options.count, options.only)
        return 0
    began = time.monotonic()
    counts, faults = run(options.seed, options.first, options.count, options.only)
    print(f"{dict(counts)} in {time.monotonic() - began:.0f} s")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
