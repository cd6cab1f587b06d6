"""Key -> training data: windows per second of the simulator, and seconds per file of event lists.

Question: does training wait for its data? Event tensors, true images and flow of 4 sequences of
20 windows at 128x128, five renderings a window, made on the device from nothing but a key:
planar scenes, scenes with three objects, and those before sensors with every fault. Expected on
two cores: at least 250 windows a second for planar scenes without faults. Beside it exact event
lists on the host, for a few sequences of 2 s at 240x180 with frames at 50 Hz, and what a
thousand of them would take (the paper's training set; under 3 hours).

    python experiments/simulator_speed.py            about two minutes
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from harness import interleaved, save, table

from firenet_jax.simulation.curricula import sequences
from firenet_jax.simulation.scenes import SceneSettings, random_scene, rendering_times, video
from firenet_jax.simulation.sensor import FAULTY, SensorSettings, event_list, random_sensor
from firenet_jax.simulation.textures import load_textures

BATCH, WINDOWS, SIZE, RENDERINGS = 4, 20, 128, 5
CASES = {
    "planar, no faults": (SceneSettings(objects=0), SensorSettings()),
    "objects, no faults": (SceneSettings(), SensorSettings()),
    "planar, all faults": (SceneSettings(objects=0), FAULTY),
    "objects, HDR, all faults": (SceneSettings(hdr=0.2), FAULTY),
}


def tensors(textures, runs: int) -> list[dict]:
    shape = {"batch": BATCH, "windows": WINDOWS, "height": SIZE, "width": SIZE}
    methods, compilations, events = {}, {}, {}
    for name, (scene, sensor) in CASES.items():
        keys = iter(range(10**6))

        def make(scene=scene, sensor=sensor, keys=keys):
            key = jax.random.key(next(keys))
            made = sequences(
                key, textures, renderings=RENDERINGS, scene=scene, sensor=sensor, **shape
            )
            return jax.block_until_ready(made)

        start = time.perf_counter()
        made = make()
        compilations[name] = time.perf_counter() - start
        events[name] = float(jnp.abs(made.tensors).sum() / (BATCH * WINDOWS * SIZE * SIZE))
        methods[name] = make
    rows = table(interleaved(methods, runs), base="planar, no faults")
    print(f"{'':34} {'windows/s':>10} {'at best':>9} {'compile s':>10} {'votes/pixel':>12}")
    for row in rows:
        name = row["method"]
        row["windows_per_s"] = 1e3 * BATCH * WINDOWS / row["median_ms"]
        row["windows_per_s_best"] = 1e3 * BATCH * WINDOWS / row["min_ms"]
        row["compile_s"] = compilations[name]
        row["votes_per_pixel"] = events[name]
        print(f"{name:34} {row['windows_per_s']:10.0f} {row['windows_per_s_best']:9.0f} "
              f"{row['compile_s']:10.1f} {row['votes_per_pixel']:12.2f}")  # fmt: skip
    return rows


def lists(textures, count: int, settings: SceneSettings) -> dict:
    """Seconds, renderings and events of sequences of 2 s, speeds evenly over their range."""
    size = {"height": 180, "width": 240}
    low, high = (np.log(speed) for speed in settings.speed)
    rows, frames = [], np.arange(0, 2_000_001, 20_000)

    def one(k, speed):
        start = time.perf_counter()
        scene = random_scene(jax.random.key(k), textures, speed=speed, settings=settings, **size)
        times = rendering_times(scene, frames, **size)
        sensor = random_sensor(jax.random.key(k), **size)
        events = sum(len(part) for part in event_list(sensor, video(scene, times, **size)))
        return {"speed": speed, "renderings": len(times), "events": events,
                "seconds": time.perf_counter() - start}  # fmt: skip

    one(0, float(np.exp(low)))  # compilation
    print(f"{'list, px/s':>34} {'renderings':>10} {'events':>10} {'seconds':>9}")
    for k in range(count):
        rows.append(one(k, float(np.exp(low + (k + 0.5) / count * (high - low)))))
        print(f"{rows[-1]['speed']:34.1f} {rows[-1]['renderings']:10d} {rows[-1]['events']:10d} "
              f"{rows[-1]['seconds']:9.2f}")  # fmt: skip
    hours = 1000 * float(np.mean([row["seconds"] for row in rows])) / 3600
    print(f"1,000 sequences of 2 s at 240x180, lists alone: {hours:.2f} hours")
    return {"sequences": rows, "hours_for_1000": hours}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--lists", type=int, default=5)
    options = parser.parse_args()
    textures = jnp.asarray(load_textures(None, 64, 256))
    made = tensors(textures, options.runs)
    save(
        "simulator_speed",
        {"tensors": made, "lists": lists(textures, options.lists, SceneSettings())},
    )


if __name__ == "__main__":
    main()
