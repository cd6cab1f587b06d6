"""The same network, weights and inputs in JAX and in PyTorch: which is how much faster?

Three parts, each in one run with the methods in turn:

    step      one window at the paper's four resolutions, batch 1, 4 and 16, alone and in a scan
    pipeline  events on the host -> 8-bit picture on the host, 0.35 events per pixel and window
    training  ten windows forward, loss, gradient, Adam; batch 2 and 4, 96x96 and 128x128; and what
              part of our step, which simulates its data, the simulation takes

"JAX in scan" is what `reconstruct` does: on a CPU, where it can, with the step as machine code
(`firenet_jax/native`); "XLA in scan" is the same scan over the step that XLA compiles.
PyTorch runs as the field's programs do (eager, NCHW, separate gates) and as it runs best: our fused
gates, channels_last, torch.compile, frozen TorchScript, bfloat16, and CUDA graphs on a GPU. A
step outside of a scan is PyTorch's only kind. Before anything is timed the float32 results are
asserted to be equal: images to 1e-4, pictures to a level, loss and gradient to 1e-4 of them.
float32 is float32 on a GPU too: TF32 is off on both sides. On Linux both sides get what `firenet`
gives its own commands: huge pages, and in training malloc keeps what is freed.

    python experiments/xla_vs_pytorch.py            an hour on two cores; needs torch
    python experiments/xla_vs_pytorch.py --parts training               measures one part again
    python experiments/xla_vs_pytorch.py --only 240x180x1,640x480x1      some cases again
    python experiments/xla_vs_pytorch.py --avx2       both sides as on processors without AVX-512
    taskset -c 0 python experiments/xla_vs_pytorch.py --one-thread      on a busy machine, see below
    python experiments/xla_vs_pytorch.py --memory     adds peak MB to what was measured, batch 1
    python experiments/xla_vs_pytorch.py --quick                        5 minutes; saves nothing

A step is held against what direct convolutions cannot beat: their products at the rate of two large
matrices' product ("its products alone"). Machine code has fewer products (Winograd).

"first s" is the first call: compilation, if there is any, and one run. "peak MB" is by how much
a fresh process grows while the method runs warm (on a GPU: what its framework holds at most).
Cases that are not measured again stay in the results, if they are of the same machine. With --avx2
XLA's own convolutions ("XLA in scan", bfloat16) are left out: no switch restricts all of them.
With --one-thread both sides have one thread, and what is measured is the time that it has had a
processor: whoever else uses the machine, ratios hold to some percent.
Writes results/xla_vs_pytorch.json and .png (and _gpu, _avx2, _one_thread after the name).
"""

import argparse
import copy
import ctypes
import gc
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import torch
from harness import RESULTS, interleaved, machine, on_this_device, save, table
from pytorch_firenet import (
    FireNet,
    Trainer,
    normalise,
    to_picture,
    voxelise_lean,
    voxelise_original,
)

from firenet_jax.cli import HUGE_PAGES, KEEP_FREED_MEMORY
from firenet_jax.events import Events
from firenet_jax.native import by_xla_alone
from firenet_jax.network import (
    Weights,
    initial_params,
    initial_state,
    multiply_adds,
    step,
)
from firenet_jax.pictures import Display
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session, reconstruct
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import SensorSettings
from firenet_jax.simulation.textures import load_textures
from firenet_jax.tensors import pack
from firenet_jax.training.losses import Loss, sequence_loss
from firenet_jax.training.run import first_state
from firenet_jax.training.settings import Train
from firenet_jax.training.step import TEXTURE, simulated, train_step

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

RESOLUTIONS = {"240x180": 1, "346x260": 1, "640x480": 1, "1280x720": 4}  # greatest batch: 16 / this
BATCHES = (1, 4, 16)
IN_SCAN = 4  # windows
IN_CHUNK = 8  # windows of the pipeline
EVENTS_PER_PIXEL = 0.35
FIXED = Display(range="fixed")  # what the other side has
REST = 0.02  # seconds: the threads of PyTorch's OpenMP spin for a few milliseconds after their work
# The losses and the optimiser that the other side has too.
LOSS = Loss(l1=1.0, nlpd=0.5, ssim=0.5, haarpsi=0.0, l0=5)
TRAIN = Train(output=Path("unused"), windows=10, batch=2, crop=96, loss=LOSS, optimiser="adam")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
COMPILER = shutil.which(os.environ.get("CXX", "g++"))

# By the environment, as libraries imported above start threads, each with a heap of its own.
TUNABLES = {-8: "arena_max", -4: "mmap_max", -1: "trim_threshold"}  # mallopt's numbers
KEPT = [f"glibc.malloc.{TUNABLES[number]}={value}" for number, value in KEEP_FREED_MEMORY]
MALLOC = {"training": ":".join([HUGE_PAGES, *KEPT])}

NCHW, NHWC = torch.contiguous_format, torch.channels_last
# Read when JAX and PyTorch are imported: what keeps each from instructions of AVX-512.
AVX2 = {
    "FIRENET_NATIVE": "avx2",
    "XLA_FLAGS": "--xla_cpu_max_isa=AVX2",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
}
ONE_THREAD = "--one-thread" in sys.argv
IS_AVX2 = AVX2.items() <= os.environ.items()

# A method is made when it is asked for: a function without arguments that returns its result when
# the work is done.
Makers = dict[str, Callable[[], Callable[[], object]]]


def wait() -> None:
    if DEVICE == "cuda":
        torch.cuda.synchronize()


def to_torch(array, memory_format=NCHW) -> torch.Tensor:
    """(..., H, W, channels) -> (..., channels, H, W)"""
    tensor = torch.from_numpy(np.array(array)).to(DEVICE).movedim(-1, -3)
    # A sequence has no such format: its tensors are brought into it one by one.
    return tensor.contiguous(memory_format=memory_format) if tensor.ndim == 4 else tensor


@torch.inference_mode()
def in_graph(model, inputs):
    """The model on these inputs as one CUDA graph, captured after warming up on another stream."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            model(*inputs)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = model(*inputs)

    def replay(*new, kept=model):  # a graph knows where its weights are, it does not own them
        for own, given in zip(inputs, new, strict=True):
            if own is not given:
                own.copy_(given)
        graph.replay()
        return results

    return replay


def models(params, shape: tuple[int, int, int]) -> dict[str, tuple[Callable, torch.memory_format]]:
    """Name -> (a function that makes the model for (B, H, W), its memory format)."""
    batch, height, width = shape

    def example():
        sizes = (16, 16, 5)
        zeros = [torch.zeros(batch, size, height, width, device=DEVICE) for size in sizes]
        return [tensor.contiguous(memory_format=NHWC) for tensor in zeros]

    def eager(memory_format, separate_gates=False):
        model = FireNet(params, separate_gates).to(DEVICE, memory_format=memory_format)
        return model.eval()

    def compiled():
        torch.compiler.reset()  # else it would look for one program for all sizes
        return torch.compile(eager(NHWC), dynamic=False)

    def scripted():
        return torch.jit.freeze(torch.jit.trace(eager(NHWC), example()))

    made = {
        "PyTorch NCHW, as peers": (partial(eager, NCHW, True), NCHW),
        "PyTorch NCHW": (partial(eager, NCHW), NCHW),
        "PyTorch channels_last": (partial(eager, NHWC), NHWC),
        "PyTorch TorchScript": (scripted, NHWC),
    }
    if COMPILER:
        made["PyTorch compile"] = compiled, NHWC
    if DEVICE == "cuda":
        made["PyTorch CUDA graph"] = (lambda: in_graph(eager(NHWC), example())), NHWC
    return made


# ---- One step


def step_makers(width: int, height: int, batch: int) -> Makers:
    keys = jax.random.split(jax.random.key(0), 3)
    params = initial_params(keys[0])
    tensors = jax.random.normal(keys[1], (IN_SCAN, batch, height, width, 5))
    state = initial_state(batch, height, width)
    state = jax.tree.map(lambda h: h + 0.3 * jax.random.normal(keys[2], h.shape), state)

    def jax_step(dtype):
        run = jax.jit(partial(step, dtype=dtype))
        return lambda: jax.block_until_ready(run(params, state, tensors[0]))[1]

    def jax_scan(dtype):
        weights = Weights(params, normalise=False)
        run = partial(reconstruct, weights, state, tensors, dtype=dtype)
        return lambda: jax.block_until_ready(run())[1][0]

    def xla_scan():
        @jax.jit
        def run(state, tensors):
            with by_xla_alone():
                return jax.lax.scan(partial(step, params), state, tensors)

        return lambda: jax.block_until_ready(run(state, tensors))[1][0]

    def torch_step(make, memory_format, dtype=torch.float32):
        model = make()
        inputs = [to_torch(x, memory_format).to(dtype) for x in (*state, tensors[0])]

        @torch.inference_mode()
        def run():
            image = model(*inputs)[2]
            wait()
            return image.float()

        return run

    def torch_bfloat16():
        """All of it in bfloat16, the state too, as programs do it who do it."""
        model = FireNet(params).to(DEVICE, torch.bfloat16, memory_format=NHWC)
        return torch_step(lambda: model, NHWC, torch.bfloat16)

    makers = {
        "JAX step": partial(jax_step, jnp.float32),
        "JAX in scan": partial(jax_scan, jnp.float32),
        "XLA in scan": xla_scan,
        "JAX step, bfloat16": partial(jax_step, jnp.bfloat16),
        "JAX in scan, bfloat16": partial(jax_scan, jnp.bfloat16),
    }
    if IS_AVX2 or ONE_THREAD:
        names = ["JAX in scan"] if IS_AVX2 else ["JAX in scan", "XLA in scan"]
        makers = {name: makers[name] for name in names}
    for name, (make, memory_format) in models(params, (batch, height, width)).items():
        makers[name] = partial(torch_step, make, memory_format)
    if IS_AVX2 or ONE_THREAD:
        return makers
    return makers | {"PyTorch channels_last, bfloat16": torch_bfloat16}


# ---- Events -> pictures


def random_windows(width: int, height: int) -> list[Events]:
    rng, count = np.random.default_rng(0), int(EVENTS_PER_PIXEL * width * height)
    return [
        Events.of(
            10**15 + 50_000 * window + np.sort(rng.integers(0, 50_000, count)),
            rng.integers(0, width, count),
            rng.integers(0, height, count),
            rng.random(count) < 0.5,
        )
        for window in range(IN_CHUNK)
    ]


def pipeline_makers(width: int, height: int) -> Makers:
    """Each returns the pictures (T, H, W) of a run from a zero state."""
    windows, params = random_windows(width, height), initial_params(jax.random.key(0))
    size = {"height": height, "width": width}

    def ours(chunk):
        weights = Weights(params, normalise=True)
        valid = np.ones((chunk, 1), bool)

        def run():
            session, pictures = initial_session(1, **size, network=Network()), []
            for first in range(0, IN_CHUNK, chunk):
                packed = pack([[window] for window in windows[first : first + chunk]])
                session, part = events_to_pictures(
                    weights, session, packed, valid, settings=FIXED, **size
                )
                pictures.append(np.asarray(part[:, 0]))
            return np.concatenate(pictures)

        return run

    def theirs(make, memory_format, voxelise):
        model = make()
        zeros = torch.zeros(1, 16, height, width, device=DEVICE)
        zeros = zeros.contiguous(memory_format=memory_format)

        @torch.inference_mode()
        def run():
            g1 = g2 = zeros
            pictures = []
            for window in windows:
                tensor = normalise(voxelise(window, **size))[None].to(DEVICE)
                tensor = tensor.contiguous(memory_format=memory_format)
                g1, g2, image = model(g1, g2, tensor)
                pictures.append(to_picture(image).cpu().numpy()[0])
            return np.stack(pictures)

        return run

    makers = {"JAX, chunk of 8": partial(ours, IN_CHUNK), "JAX, one by one": partial(ours, 1)}
    lean = partial(voxelise_lean, device=DEVICE)
    for name, (make, memory_format) in models(params, (1, height, width)).items():
        voxelise = voxelise_original if "peers" in name else lean
        makers[name] = partial(theirs, make, memory_format, voxelise)
    return makers


# ---- Training


def training_makers(crop: int, batch: int) -> Makers:
    """Each takes a training step on the same data and returns its loss and gradient's norm."""
    settings = replace(TRAIN, crop=crop, batch=batch)
    textures = load_textures(None, 16, TEXTURE)
    data = simulated(jax.random.key(0), jnp.asarray(textures), settings.step_settings)
    params = initial_params(jax.random.key(settings.seed))

    def ours(bfloat16):
        asked = replace(settings, bfloat16=bfloat16)
        state = first_state(asked)

        def run():
            nonlocal state
            state, terms = train_step(state, data, asked.step_settings)
            return {name: float(terms[name]) for name in ("loss", "gradient")}

        return run

    def theirs(memory_format, separate_gates=False, compiled=False, dtype=None):
        model = FireNet(params, separate_gates).to(DEVICE, memory_format=memory_format)
        if compiled:
            torch.compiler.reset()
        run = torch.compile(model, dynamic=False) if compiled else model
        trainer = Trainer(model, run, memory_format, settings, dtype)
        truth = [torch.from_numpy(np.array(part)).to(DEVICE) for part in data[1:]]
        return partial(trainer.step, to_torch(data.tensors), *truth)

    makers = {
        "JAX": partial(ours, False),
        "JAX, bfloat16": partial(ours, True),
        "PyTorch NCHW, as peers": partial(theirs, NCHW, True),
        "PyTorch NCHW": partial(theirs, NCHW),
        "PyTorch channels_last": partial(theirs, NHWC),
    }
    if COMPILER:
        makers["PyTorch compile"] = partial(theirs, NHWC, compiled=True)
    if IS_AVX2 or ONE_THREAD:
        return {name: make for name, make in makers.items() if "bfloat16" not in name}
    bfloat16 = partial(theirs, NHWC, dtype=torch.bfloat16)
    return makers | {"PyTorch channels_last, bfloat16": bfloat16}


def simulation_share(runs: int) -> list[dict]:
    """How much of a step that simulates its data is simulation, for planar scenes and ours.

    Twice: the simulation alone, and what a step takes longer than on data that are there.
    """
    textures = jnp.asarray(load_textures(None, 16, TEXTURE))
    planar = SceneSettings(objects=0)
    cases = {
        "planar, no faults": replace(TRAIN, scene=planar, sensor=SensorSettings()),
        "planar, our sensor": replace(TRAIN, scene=planar),
        "objects, our sensor": TRAIN,
    }
    return [share(name, settings, textures, runs) for name, settings in cases.items()]


def share(name: str, settings: Train, textures: jax.Array, runs: int) -> dict:
    key, of_step = jax.random.key(1), settings.step_settings
    data = simulated(key, textures, of_step)

    def stepping(source):
        state = first_state(settings)

        def run():
            nonlocal state
            state, terms = train_step(state, source, of_step)
            return jax.block_until_ready(terms)

        return run

    methods = {
        "whole step": stepping((key, textures)),
        "step on data that are there": stepping(data),
        "simulation alone": lambda: jax.block_until_ready(
            simulated(key, textures, settings.step_settings)
        ),
    }
    print(f"\n{name}")
    rows = table(interleaved(methods, runs), "whole step")
    alone, longer = rows[2]["ratio"], 1 - rows[1]["ratio"]
    print(f"simulation: {alone:.1%} of a step by itself, {longer:.1%} as the difference "
          "(bar: under 20 % when planar)")  # fmt: skip
    return {"case": name, "share_alone": alone, "share_by_difference": longer, "rows": rows}


# ---- Measuring


MAKERS = {"step": step_makers, "pipeline": pipeline_makers, "training": training_makers}


def difference(result, expected) -> float:
    """The largest, relative where results are losses and gradients."""
    if isinstance(result, dict):
        return max(abs(result[name] / expected[name] - 1) for name in expected)
    result, expected = (
        (r.cpu().numpy() if torch.is_tensor(r) else np.asarray(r)).astype(np.float64)
        for r in (result, expected)
    )
    return float(np.abs(result - expected).max())


def compare(part: str, case: tuple, units: dict[str, int], options) -> dict:
    """Makes, checks and times all methods of a case. units: windows in a run, where not 1."""
    print(f"\n{part} {' '.join(map(str, case))}")
    methods, firsts, differences, base, expected = {}, {}, {}, None, None
    for name, make in MAKERS[part](*case).items():
        start = time.perf_counter()
        methods[name] = make()
        result = methods[name]()
        firsts[name] = time.perf_counter() - start
        if base is None:
            # A copy: on a CPU the result may share memory that later runs write to.
            base, expected = name, copy.deepcopy(result)
        differences[name] = difference(result, expected)
        bound = 1 if part == "pipeline" else 1e-4
        assert "bfloat16" in name or differences[name] <= bound, (name, differences[name])
    clock = time.process_time if ONE_THREAD else time.perf_counter
    seconds = interleaved(methods, options.runs, REST, clock)
    seconds = {name: [s / units.get(name, 1) for s in runs] for name, runs in seconds.items()}
    rows = table(seconds, base)
    print(f"{'':34} {'first s':>10} {'differs by':>12}")
    for row in rows:
        name = row["method"]
        row |= {"first_s": firsts[name], "differs": differences[name]}
        print(f"{name:34} {row['first_s']:10.2f} {row['differs']:12.1e}")
    return {"case": list(case), "rows": rows}


def add_memory(part: str, cases: list[dict]) -> None:
    """`peak_mb` to each method of what was measured; batch 1 will do. The machine may be busy."""
    for case in cases:
        if case["case"][2:] not in ([], [1]):
            continue
        print(f"\n{part} {' '.join(map(str, case['case']))}")
        for row in case["rows"]:
            row["peak_mb"] = peak(part, row["method"], case["case"])
            print(f"{row['method']:34} {row['peak_mb']:9.0f} MB", flush=True)


def peak(part: str, name: str, case: list) -> float:
    """Megabytes that a method needs at most, measured in a process of its own."""
    command = [sys.executable, __file__, "--peak", json.dumps([part, name, *case])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout.split()[-1])


def resident(kind: str) -> int:
    """VmRSS, resident now, or VmHWM, the most since the mark was reset; kilobytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(kind))


def give_back() -> None:
    """Returns to the system what compiling left behind and nobody uses."""
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)


def print_peak(part: str, name: str, *case) -> None:
    make = MAKERS[part](*case)[name]
    give_back()
    before = resident("VmRSS")
    method = make()
    method()
    if DEVICE == "cuda":
        method()
        if name.startswith("JAX"):
            most = jax.devices()[0].memory_stats()["peak_bytes_in_use"]
        else:
            most = torch.cuda.max_memory_allocated()
        print(most / 2**20)
        return
    give_back()
    Path("/proc/self/clear_refs").write_text("5")  # sets the mark to now
    for _ in range(3):
        method()
    print((resident("VmHWM") - before) / 1024)


def chosen(cases: list[tuple], options) -> list[tuple]:
    """Those that are asked for."""
    if options.quick:
        return cases[:1]
    only = options.only.split(",") if options.only else []
    return [case for case in cases if not only or "x".join(map(str, case)) in only]


def measure_step(options) -> dict:
    cases = []
    for resolution, less in RESOLUTIONS.items():
        width, height = map(int, resolution.split("x"))
        cases += [(width, height, batch) for batch in BATCHES if batch <= 16 // less]
    cases = chosen(cases, options)
    units = dict.fromkeys(["JAX in scan", "XLA in scan", "JAX in scan, bfloat16"], IN_SCAN)
    rate = None if ONE_THREAD else products_per_second(options.runs)
    results = []
    for width, height, batch in cases:
        result = compare("step", (width, height, batch), units, options)
        if rate is None:
            results.append(result)
            continue
        limit = 1e3 * batch * multiply_adds(height, width) / rate
        print(f"{'its products alone, as in a matrix':34} {limit:10.2f}")
        results.append(result | {"limit_ms": limit})
    return {"cases": results, "products_per_second": rate}


def products_per_second(runs: int) -> float:
    """Multiply-adds in the product of two large float32 matrices, of the quicker framework.

    What the device can do: direct convolutions do not take less time than their products.
    """
    size = 4096
    matrix = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    ours, theirs = jax.device_put(matrix), torch.from_numpy(matrix).to(DEVICE)
    product = jax.jit(jnp.matmul)

    def torch_product():
        theirs @ theirs
        wait()

    methods = {
        "JAX": lambda: product(ours, ours).block_until_ready(),
        "PyTorch": torch_product,
    }
    seconds = interleaved(methods, runs, REST)
    return size**3 / min(statistics.median(each) for each in seconds.values())


def measure_pipeline(options) -> dict:
    cases = [tuple(map(int, resolution.split("x"))) for resolution in RESOLUTIONS]
    results = []
    for case in chosen(cases, options):
        units = dict.fromkeys(pipeline_makers(16, 16), IN_CHUNK)
        results.append(compare("pipeline", case, units, options))
    return {"cases": results}


def measure_training(options) -> dict:
    sizes = [(crop, batch) for crop in (96, 128) for batch in (2, 4)]
    cases = []
    for crop, batch in chosen(sizes, options):
        case = compare("training", (crop, batch), {}, options)
        rows = {row["method"]: row["median_ms"] for row in case["rows"]}
        theirs = {
            name: milliseconds
            for name, milliseconds in rows.items()
            if name.startswith("PyTorch") and "bfloat16" not in name
        }
        fastest = min(theirs, key=theirs.__getitem__)
        case |= {"fastest_pytorch": fastest, "jax_over_it": rows["JAX"] / theirs[fastest]}
        print(f"JAX takes {case['jax_over_it']:.2f} times as long as {fastest}")
        cases.append(case)
    if options.only or IS_AVX2 or ONE_THREAD:
        return {"cases": cases}
    return {
        "cases": cases,
        "losses": losses_share(options.runs),
        "simulation": simulation_share(options.runs),
    }


def losses_share(runs: int) -> dict:
    """How much of a step are the losses and their gradients with respect to the images."""
    of_step = TRAIN.step_settings
    data = simulated(jax.random.key(0), jnp.asarray(load_textures(None, 16, TEXTURE)), of_step)
    images = jnp.flip(data.images, -1)

    @jax.jit
    def losses(images, data):
        truth = data.images, data.displacement, data.visible
        return jax.grad(lambda images: sequence_loss(images, *truth, of_step.loss)[0])(images)

    state = first_state(TRAIN)

    def step():
        nonlocal state
        state, terms = train_step(state, data, of_step)
        return jax.block_until_ready(terms)

    methods = {
        "step on data that are there": step,
        "losses alone": lambda: jax.block_until_ready(losses(images, data)),
    }
    rows = table(interleaved(methods, runs), "step on data that are there")
    print(f"losses: {rows[1]['ratio']:.1%} of a step")
    return {"share": rows[1]["ratio"], "rows": rows}


def merged(before: dict, after: dict) -> dict:
    """A part's results, with what was measured before on the same machine and not again."""
    if before.get("machine") != after["machine"]:
        return after
    cases = {tuple(each["case"]): each for each in before["cases"] + after["cases"]}
    return before | after | {"cases": [cases[case] for case in sorted(cases)]}


MEASURE = {"step": measure_step, "pipeline": measure_pipeline, "training": measure_training}


# ---- Figure

COLOURS = {
    "JAX step": "tab:blue",
    "JAX, chunk of 8": "tab:blue",
    "JAX": "tab:blue",
    "JAX in scan": "navy",
    "XLA in scan": "cornflowerblue",
    "JAX, one by one": "lightskyblue",
    "JAX, bfloat16": "lightskyblue",
    "PyTorch NCHW, as peers": "tab:red",
    "PyTorch NCHW": "lightcoral",
    "PyTorch channels_last": "tab:orange",
    "PyTorch TorchScript": "gold",
    "PyTorch compile": "tab:brown",
    "PyTorch CUDA graph": "tab:purple",
    "PyTorch channels_last, bfloat16": "wheat",
}


def plot(results: dict, path: Path) -> None:
    """Milliseconds as bars on a logarithmic axis, one panel a part, batch 1 for the step."""
    parts = [part for part in MEASURE if part in results]
    figure, axes = plt.subplots(
        1, len(parts), figsize=(5.5 * len(parts), 4.2), squeeze=False, layout="constrained"
    )
    titles = {
        "step": "one window, batch 1, float32",
        "pipeline": "events to picture, one window",
        "training": "training step: 10 windows",
    }
    for axis, part in zip(axes[0], parts, strict=True):
        cases = [case for case in results[part]["cases"] if case["case"][2:] in ([], [1])]
        names = [row["method"] for row in cases[0]["rows"] if row["method"] in COLOURS]
        if part == "step":
            names = [name for name in names if "bfloat16" not in name]
        for k, name in enumerate(names):
            rows = [next(r for r in case["rows"] if r["method"] == name) for case in cases]
            middle = np.array([row["median_ms"] for row in rows])
            spread = [middle - [r["min_ms"] for r in rows], [r["max_ms"] for r in rows] - middle]
            places = np.arange(len(cases)) + 0.8 * ((k + 0.5) / len(names) - 0.5)
            axis.bar(places, middle, 0.8 / len(names), color=COLOURS[name], label=name)
            axis.errorbar(places, middle, spread, fmt="none", ecolor="0.3", lw=0.8)
        if part == "step":
            limits = [case["limit_ms"] for case in cases]
            axis.hlines(limits, places - 0.8, places + 0.1, color="k", label="its products alone")
        labels = ["{}x{} px".format(*case["case"][:2]) for case in cases]
        if part == "training":
            labels = ["{} px, batch {}".format(*case["case"]) for case in cases]
        axis.set(yscale="log", title=titles[part], xticks=range(len(cases)), xticklabels=labels)
        axis.grid(axis="y", which="both", alpha=0.2)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.tick_params(axis="y", which="both", labelsize=7)
        axis.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.08))
    axes[0, 0].set_ylabel("ms (median; least to greatest)")
    figure.savefig(path, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=",".join(MEASURE), help="those to measure")
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="smallest sizes, save nothing")
    parser.add_argument("--only", default="", help="cases, such as 240x180x1 (step), 96x2")
    parser.add_argument("--avx2", action="store_true", help="both sides without AVX-512")
    parser.add_argument("--one-thread", action="store_true", help="processor time of one thread")
    parser.add_argument("--memory", action="store_true", help="add peak MB instead of timing")
    parser.add_argument("--peak", help=argparse.SUPPRESS)  # a process that `peak` starts
    options = parser.parse_args()
    if options.avx2 and not IS_AVX2:
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | AVX2)
    if ONE_THREAD and (threads := torch.get_num_threads()) > 1:
        parser.error(f"{threads} threads: start it as taskset -c 0 python ...")
    if "GLIBC_TUNABLES" not in os.environ:  # read as a program starts: a process for each part
        for part in options.parts.split(","):
            environment = os.environ | {"GLIBC_TUNABLES": MALLOC.get(part, HUGE_PAGES)}
            command = [sys.executable, *sys.argv, "--parts", part]
            subprocess.run(command, env=environment, check=True)
        return
    if DEVICE == "cuda":
        jax.config.update("jax_default_matmul_precision", "highest")
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    if options.peak:
        print_peak(*json.loads(options.peak))
        return
    torch.compiler.config.force_disable_caches = True  # "first s" is of a first time
    if COMPILER is None:
        print("no C++ compiler: torch.compile is left out")
    if options.quick:
        options.runs = 3
    how = {
        "machine": machine(),
        "torch": torch.__version__,
        "torch threads": torch.get_num_threads(),
        "torch instructions": torch.backends.cpu.get_cpu_capability(),
        "compiler": COMPILER,
        "malloc": os.environ.get("GLIBC_TUNABLES"),
        "runs": options.runs,
    }
    name = on_this_device("xla_vs_pytorch") + "_avx2" * IS_AVX2 + "_one_thread" * ONE_THREAD
    path = RESULTS / f"{name}.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for part in options.parts.split(","):
        if options.memory:
            add_memory(part, results[part]["cases"])
        else:  # parts may be of different runs: each says for itself how it was measured
            measured = how | MEASURE[part](options)
            results[part] = merged(results.get(part, {}), measured)
        if not options.quick:
            save(name, {part: results[part] for part in MEASURE if part in results})
            if not ONE_THREAD:
                plot(results, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
