"""Simulator and recordings -> event rates, polarities, inter-event times: how alike are they?

    python experiments/simulator_statistics.py FOLDER [--sequences 16]        three minutes

FOLDER holds recordings of any format that `firenet info` reads. Simulated are 240x180 pixels for
one second by random scenes of the default settings, once with the paper's sensor and once with
all faults on. Of each recording the first two million events count. Compared are

    rate       events per pixel and second
    ON share   part of the events that say brighter
    same sign  part of the events with the polarity of their pixel's last one: low where noise or
               fine textures rule, high where large changes of brightness do
    interval   time since the pixel's last event, as a density over its logarithm

To expect: rates of the simulator spread over the recordings' (it moves between 3 and 1,000 pixels
per second); its ON share with a median near one half, spread as far as that of real sensors (0.36
to 0.67); no interval of the simulator's is below the refractory period of 1 ms (but for hot pixels
and noise), while up to a tenth of a DAVIS' and nearly all of a Prophesee sensor's before sparklers
are. A recording shows no interval longer than itself: those of 10 to 100 ms seem faster than they
are. Faults change fast scenes little, and still ones much.

Writes results/simulator_statistics.json and .png.
"""

import argparse
from pathlib import Path

import jax
import matplotlib
import numpy as np
from harness import RESULTS, save

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

from firenet_jax.commands.simulate import Simulate, sequence  # noqa: E402
from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, concatenate  # noqa: E402
from firenet_jax.readers import open_recording  # noqa: E402
from firenet_jax.simulation.sensor import FAULTY, SensorSettings  # noqa: E402
from firenet_jax.simulation.textures import load_textures  # noqa: E402

MOST = 2_000_000  # events of a recording
EDGES = np.logspace(0, 7, 71)  # microseconds
SECONDS = 1.0
HEIGHT, WIDTH = 180, 240


def statistics(events: Events, pixels: int, width: int) -> dict:
    """Facts of one stream of events, without the histogram's normalisation."""
    seconds = max(1e-6 * int(events.t[-1] - events.t[0]), 1e-6)
    place = events.y.astype(np.int64) * width + events.x
    order = np.argsort(place, kind="stable")  # pixel by pixel, each in time order
    same_pixel = np.diff(place[order]) == 0
    intervals = np.diff(events.t[order])[same_pixel]
    same_sign = (np.diff(events.p[order].astype(np.int8)) == 0)[same_pixel]
    return {
        "events": len(events),
        "seconds": seconds,
        "rate": len(events) / pixels / seconds,
        "on_share": float(events.p.mean()),
        "same_sign": float(same_sign.mean()) if len(same_sign) else None,
        "median_interval_ms": float(np.median(intervals)) / 1e3 if len(intervals) else None,
        "below_1_ms": float((intervals < 1000).mean()) if len(intervals) else None,
        "histogram": np.histogram(np.maximum(intervals, 1), EDGES)[0],
    }


def of_recordings(folder: Path) -> dict[str, dict]:
    found = {}
    for path in sorted(folder.iterdir()):
        try:
            recording = open_recording(path)
        except RecordingError as error:
            print(f"left out: {error}")
            continue
        chunks, count = [], 0
        for chunk in recording.events():
            chunks.append(chunk)
            count += len(chunk)
            if count >= MOST:
                break
        events = concatenate(chunks).select(slice(MOST))
        found[path.name] = statistics(events, recording.pixels, recording.width)
    return found


def of_simulator(sensor: SensorSettings, count: int) -> list[dict]:
    textures = load_textures(count=64, size=320)
    settings = Simulate(Path("unused"), seconds=SECONDS, fps=10.0)
    found = []
    for number in range(count):
        key = jax.random.fold_in(jax.random.key(0), number)
        events, pictures = sequence(key, textures, settings, sensor, HEIGHT, WIDTH)
        chunks = list(events)
        pictures.close()
        if chunks:
            found.append(statistics(concatenate(chunks), HEIGHT * WIDTH, WIDTH))
    return found


def plot(groups: dict[str, list[dict]], names: list[str], path: Path) -> None:
    """Three facts as points, one row a group, and the intervals as lines."""
    figure, axes = plt.subplots(1, 4, figsize=(15, 4), width_ratios=[1, 1, 1, 2])
    colours = dict(zip(groups, ("tab:blue", "tab:orange", "black"), strict=True))
    facts = {"rate": "events / pixel / s", "on_share": "ON share", "same_sign": "same sign"}
    for axis, (fact, label) in zip(axes, facts.items(), strict=False):
        for row, (group, entries) in enumerate(groups.items()):
            values = [entry[fact] for entry in entries if entry[fact] is not None]
            axis.plot(
                values, row + np.linspace(-0.25, 0.25, len(values)), ".", color=colours[group]
            )
        axis.set(xlabel=label, ylim=(len(groups) - 0.5, -0.5), yticks=range(len(groups)))
        axis.set_yticklabels(groups if axis is axes[0] else [])
        axis.grid(axis="x", alpha=0.3)
    axes[0].set_xscale("log")
    axes[1].set_xlim(0, 1)
    axes[2].set_xlim(0, 1)
    middle = 1e-3 * np.sqrt(EDGES[1:] * EDGES[:-1])
    decades = np.diff(np.log10(EDGES))
    for group, entries in groups.items():
        counts = np.array([entry["histogram"] for entry in entries if entry["histogram"].any()])
        lines = counts / counts.sum(1, keepdims=True) / decades
        if group == "recordings":
            for number, (name, line) in enumerate(zip(names, lines, strict=False)):
                axes[3].plot(middle, line, color=plt.cm.tab20(number % 20), lw=0.8, label=name)
        else:  # every sequence counts alike
            axes[3].plot(middle, lines.mean(0), color=colours[group], lw=2.5, label=group)
    axes[3].set(xscale="log", xlabel="ms since the pixel's last event", ylabel="density / decade")
    axes[3].set(xlim=(1e-3, 3e3), ylim=(0, 2.2))
    axes[3].legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def summary(entries: list[dict]) -> dict:
    """Least, median and greatest of each number."""
    facts = [name for name in entries[0] if name != "histogram"]
    columns = {name: [e[name] for e in entries if e[name] is not None] for name in facts}
    return {
        name: [float(q) for q in np.quantile(values, [0, 0.5, 1])]
        for name, values in columns.items()
        if values
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sequences", type=int, default=16)
    options = parser.parse_args()
    recordings = of_recordings(options.folder)
    groups = {
        "simulator": of_simulator(SensorSettings(), options.sequences),
        "with faults": of_simulator(FAULTY, options.sequences),
        "recordings": list(recordings.values()),
    }
    print(f"{'':34} {'rate':>8} {'ON':>6} {'same':>6} {'median ms':>10} {'< 1 ms':>7}")
    rows = {name: summary(groups[name]) for name in ("simulator", "with faults")}
    lines = {name: {k: v[1] for k, v in row.items()} for name, row in rows.items()} | recordings
    for name, row in lines.items():
        print(
            f"{name[:34]:34} {row['rate']:8.2f} {row['on_share']:6.2f} "
            f"{row['same_sign'] or np.nan:6.2f} {row['median_interval_ms'] or np.nan:10.2f} "
            f"{row['below_1_ms'] or 0:7.3f}"
        )
    RESULTS.mkdir(exist_ok=True)
    plot(groups, list(recordings), RESULTS / "simulator_statistics.png")
    plain = {
        name: {k: v for k, v in row.items() if k != "histogram"} for name, row in recordings.items()
    }
    save(
        "simulator_statistics",
        {
            "sequences": options.sequences,
            "simulated (least, median, greatest)": rows,
            "recordings": plain,
        },
    )


if __name__ == "__main__":
    main()
