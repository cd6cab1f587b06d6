"""Two checkouts -> whether every command's output is the same in both, byte for byte.

    python tests/same_outputs.py OLD NEW [--recordings FOLDER] [--only reconstruct]

    git worktree add ../old HEAD~ && python tests/same_outputs.py ../old .       ten minutes

For changes that should change nothing. Each checkout runs the commands below in a process of its
own, on a small recording and a set that it simulates, and on what is in FOLDER. What it writes,
what it prints and how it ends is compared; in texts, how long something took is left out, and of
TensorBoard's, Orbax's and StableHLO's files, which hold dates or lines of source, that they are
there. `firenet live` is left out: what it gives depends on the clock. Ends with 1 where something
differs.
"""

import argparse
import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

SMALL = "--sensor-size 48x36"
COMMANDS = f"""
simulate -o set --sequences 2 --seconds 0.4 {SMALL} --seed 3 --faults
info sample.txt
info set/train/000001.h5 --json
convert built-in -o converted.npz
reconstruct sample.txt -o folder -N 200
reconstruct sample.txt -o folder.mp4
simulate --video folder.mp4 -o clip.h5
reconstruct sample.txt -o slow.gif --speed 0.5 --preview -T 40
reconstruct sample.txt -o images.h5 -N 300
reconstruct sample.txt -o cam.bag --rate 20
reconstruct sample.txt -o cam.ros2 --rate 20 --flip
reconstruct sample.txt -o at --at times.txt --names nanoseconds
reconstruct sample.txt -o colour -N 300 --color --start 0.1 --stop 0.5 --hot-pixels auto
reconstruct sample.txt -o range -N 300 --range extremes --pad 16 --no-recurrent --bilateral 25
reconstruct sample.txt -o frames --between-frames
reconstruct set/train/000001.h5 -o between --between-frames
reconstruct sample.txt set/train/000001.h5 set/train/000002.h5 -o several --batch 2 -N 200
reconstruct sample.txt -o folder -N 300
reconstruct broken.txt -o broken
reconstruct nothing.txt -o nothing
demo -o demo.mp4 --seconds 0.5 {SMALL} --faults
evaluate set/train -o report --methods firenet,hf,mr --warm-up 1
train -o run --data set --steps 2 --crop 32 --windows 12 --batch 2
train -o drawn --steps 2 --crop 32 --windows 12 --batch 2 --textures 4
export -o firenet.onnx --picture
export -o firenet.stablehlo
export -o firenet.pth
export run -o firenet.safetensors
"""
OF_EACH = """
info {path} --json
reconstruct {path} -o {name}.mp4 --stop 0.15
reconstruct {path} -o {name} --stop 0.1 --hot-pixels auto
"""
DATED = re.compile(
    r"\.stablehlo|events\.out\.tfevents|/checkpoints?/|\.orbax|_METADATA|manifest\.ocdbt|/d/"
)
TEXTS = (".json", ".jsonl", ".txt", ".csv", ".html")
# 59 pictures of 78,830 events in 15.0 s (3.9 pictures/s, 5.2 kev/s); "seconds": 1.25
TOOK = re.compile(
    r"in [\d.]+ m?s \([^)]*/s\)|[\d.,]+ m?s\b( a step)?|\"[a-z_]*(seconds|time|_ms|_s)\": [\d.e-]+"
)
UNORDERED = re.compile(rb'"__metadata__":\{(.*?)\}')


def write_samples() -> None:
    """A recording of a bar that moves over noise, images' times, and a recording that is broken."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 600_000, 6000))
    x = (t // 12_500 + rng.integers(0, 3, 6000)) % 48
    columns = t / 1e6, x, rng.integers(0, 36, 6000), rng.integers(0, 2, 6000)
    rows = [f"{t:.6f} {x} {y} {p}" for t, x, y, p in zip(*columns, strict=True)]
    Path("sample.txt").write_text("\n".join(["48 36", *rows]) + "\n")
    Path("broken.txt").write_text("\n".join(["48 36", *rows[:900], "0.0 1 1 1"]) + "\n")
    Path("nothing.txt").write_text("48 36\n")
    Path("times.txt").write_text("0.05\n0.1\n0.31\n")


def run_all(lines: list[str]) -> None:
    """In a checkout's own process, in an empty folder: one process, so that compiling is shared."""
    from firenet_jax import cli

    write_samples()
    for number, line in enumerate(lines):
        for path in Path().rglob("*"):  # a recording is known by when it was changed, too
            os.utime(path, (1e9, 1e9))
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                code = cli.main(shlex.split(line))
            except SystemExit as end:
                code = end.code
        kept = "\n".join(part for part in re.split("[\r\n]", said.getvalue()) if "%" not in part)
        print(f"  {code}  {line}", file=sys.stderr, flush=True)
        Path(f"said_{number:02d}.txt").write_text(f"{line}\n{code}\n{kept}")


def outputs_of(checkout: Path, lines: list[str], work: Path) -> dict[str, bytes]:
    """Runs them -> what each file holds, by its name; always in the same folder, as some files
    name it."""
    work.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(checkout), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(Path(__file__).resolve()), "--inside", *lines]
    subprocess.run(command, cwd=work, env=environment, check=True)
    found = {}
    for path in sorted(path for path in work.rglob("*") if path.is_file()):
        content, name = path.read_bytes(), path.relative_to(work).as_posix()
        if DATED.search(name):
            name, content = re.sub(r"[\d.]{6,}.*|/d/.*", "", name), b""
        elif path.suffix in TEXTS:
            content = TOOK.sub("", content.decode(errors="replace")).encode()
        elif path.suffix == ".safetensors":  # whose library has its metadata in any order
            content = UNORDERED.sub(lambda m: b",".join(sorted(m[1].split(b","))), content)
        found[name] = content
    shutil.rmtree(work)
    return found


def compare(old: dict[str, bytes], new: dict[str, bytes]) -> list[str]:
    """The names of files that differ, or that only one has."""
    return sorted(name for name in {*old, *new} if old.get(name) != new.get(name))


def main() -> int:
    if sys.argv[1:2] == ["--inside"]:
        run_all(sys.argv[2:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--only", nargs="+", help="these commands, and what they need")
    parser.add_argument("--keep", type=Path, help="what differs goes into this folder")
    options = parser.parse_args()
    lines = COMMANDS.strip().splitlines()
    if options.recordings:
        for path in sorted(options.recordings.resolve().iterdir()):
            each = OF_EACH.strip().format(path=shlex.quote(str(path)), name=f"of_{path.stem}")
            lines += [] if path.suffix == ".md" else each.splitlines()
    if options.only:
        lines = [line for line in lines if line.split()[0] in (*options.only, "simulate")]
    with tempfile.TemporaryDirectory() as folder:
        results = []
        for checkout in (options.old, options.new):
            print(checkout.resolve(), file=sys.stderr, flush=True)
            results.append(outputs_of(checkout.resolve(), lines, Path(folder) / "work"))
    old, new = results
    differ = compare(old, new)
    if options.keep:
        for side, files in (("old", old), ("new", new)):
            for name in differ:
                place = options.keep / side / name
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(files.get(name, b"not there"))
    for name in differ:
        print(f"differs: {name}")
    dated = sum(1 for name in old if not old[name])
    print(f"{len(lines)} commands, {len(old)} files ({dated} of them by name alone): "
          f"{len(differ)} differ")  # fmt: skip
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
