"""Functions -> times, side by side: what the benchmark scripts share.

Machines are noisy, so methods are timed in rounds of one run each, and compared by the ratio of
their medians within one run. Each round has an order of its own, because what a method leaves in
the caches and what threads it leaves spinning costs the one after it: always the same one, it would
be a difference between the methods.
"""

import json
import os
import platform
import random
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import jax

RESULTS = Path(__file__).parent / "results"


def interleaved(
    methods: dict[str, Callable[[], object]],
    runs: int,
    rest: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds of each run of each method, which must return when the work is done.

    rest: seconds to wait before each run, where the threads of the method before may spin on.
    clock: time.process_time where others use the processors too, for what runs in one thread.
    """
    for method in methods.values():  # compilation, caches
        method()
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    order = random.Random(0)
    for _ in range(runs):
        for name in order.sample(list(methods), len(methods)):
            time.sleep(rest)
            start = clock()
            methods[name]()
            seconds[name].append(clock() - start)
    return seconds


def table(seconds: dict[str, list[float]], base: str) -> list[dict]:
    """Prints and returns the median, spread and ratio to `base` of each method."""
    rows = []
    reference = statistics.median(seconds[base])
    print(f"{'method':34} {'median ms':>10} {'min':>9} {'max':>9} {'times ' + base:>14}")
    for name, runs in seconds.items():
        median = statistics.median(runs)
        row = {"method": name, "median_ms": 1e3 * median, "min_ms": 1e3 * min(runs),
               "max_ms": 1e3 * max(runs), "ratio": median / reference}  # fmt: skip
        rows.append(row)
        print(f"{name:34} {row['median_ms']:10.2f} {row['min_ms']:9.2f} {row['max_ms']:9.2f} "
              f"{row['ratio']:14.2f}")  # fmt: skip
    return rows


def on_this_device(name: str) -> str:
    """The name of a result, which elsewhere than on a CPU tells the kind of device."""
    backend = jax.default_backend()
    return name if backend == "cpu" else f"{name}_{backend}"


def _processor() -> str:
    """Its model, which Python does not know on Linux."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()


def machine() -> dict:
    """What all numbers depend on."""
    return {
        "platform": platform.platform(terse=True),
        "processors": os.cpu_count(),
        "processor": _processor(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def save(name: str, results: dict) -> None:
    """Writes results/<name>.json with what the numbers depend on."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **results}, indent=1) + "\n")
    print(f"written: {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")
