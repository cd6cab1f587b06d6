"""Recording -> facts about it: what a person wants to know before reconstructing.

The events are read once.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from firenet_jax.errors import RecordingError
from firenet_jax.events import counted, rate_in_words, until_damage
from firenet_jax.filters import hot_pixels_of
from firenet_jax.readers import open_recording
from firenet_jax.settings import parse_size
from firenet_jax.storage.progress import Bytes, bar
from firenet_jax.windows import USUAL_DENSITY, cut, usual


@dataclass(frozen=True)
class Info:
    """Say what a recording holds: format, sensor, events, rate, frames, triggers, hot pixels.

    Examples:
      firenet info recording.zip
      firenet info recording.raw --json
    """

    recording: tyro.conf.Positional[Path]
    """Text, zip, HDF5, ECD or EVREAL folder, .bin, .dat, .raw, .aedat, .aedat4, .es, ROS bag."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT of the sensor, where the recording does not state it."""
    columns: str | None = None
    """Order of the columns of a text that has no line of names, such as x,y,p,t."""
    strict: bool = False
    """Refuse a recording with a bad row or damage."""
    json: bool = False
    """Print JSON instead of lines."""


def describe(
    path: Path,
    sensor_size: tuple[int, int] | None = None,
    strict: bool = False,
    columns: str | None = None,
) -> dict:
    """Facts of a recording, in the order in which a person wants them."""
    recording = open_recording(path, sensor_size, strict, columns)
    windows = usual(until_damage(recording.events()))
    counts = np.zeros(recording.pixels, np.int64)
    on, first, last = 0, None, 0
    read = Bytes([path] if recording.count is None else [])
    progress = bar(recording.count or read.total, "B" if read.total else "ev", unit_scale=True)

    def events():
        nonlocal counts, on, first, last
        for chunk in recording.events():
            counts += np.bincount(chunk.flat_index(recording.width), minlength=counts.size)
            on += int(chunk.p.sum())
            first = int(chunk.t[0]) if first is None else first
            last = int(chunk.t[-1])
            progress.update(read.read() - progress.n if read.total else len(chunk))
            yield chunk

    with progress:
        pictures = sum(1 for _ in cut(recording, windows, events()))
    total = int(counts.sum())
    if first is None:
        raise RecordingError(
            f"{path}: holds no events: check that it was recorded and copied whole"
        )
    triggers = recording.triggers()
    hot = np.argwhere(hot_pixels_of(counts.reshape(recording.height, recording.width)))
    seconds = (last - first) / 1e6
    return {
        "recording": str(path),
        "format": recording.format,
        "width": recording.width,
        "height": recording.height,
        "sensor_size_inferred": recording.inferred,
        "events": total,
        "first_event_us": first,
        "last_event_us": last,
        "duration_s": seconds,
        "events_per_second": total / seconds if seconds else None,
        "on_share": on / total,
        "frames": 0 if recording.frames is None else len(recording.frames.times),
        "triggers": 0 if triggers is None else len(triggers.times),
        "trigger_inputs": [] if triggers is None else np.unique(triggers.ids).tolist(),
        "hot_pixels": [[int(x), int(y)] for y, x in hot],
        "events_per_window": windows.count(recording.pixels),
        "longest_window_ms": windows.longest,
        "windows": pictures,
    }


def run(settings: Info) -> None:
    facts = describe(
        settings.recording, parse_size(settings.sensor_size), settings.strict, settings.columns
    )
    if settings.json:
        print(json.dumps(facts, indent=2))
        return
    rate = facts["events_per_second"]
    hot, inputs = facts["hot_pixels"], facts["trigger_inputs"]
    shown = " ".join(f"({x},{y})" for x, y in hot[:8]) + (" ..." if len(hot) > 8 else "")
    lines = {
        "format": facts["format"],
        "sensor": f"{facts['width']}x{facts['height']} pixels"
        + (" (inferred from the events)" if facts["sensor_size_inferred"] else ""),
        "events": f"{facts['events']:,}",
        "duration": f"{facts['duration_s']:.6f} s, from {facts['first_event_us']} us",
        "rate": "all at one time" if rate is None else rate_in_words(rate),
        "polarity": f"{facts['on_share']:.1%} ON",
        "frames": f"{facts['frames']}" if facts["frames"] else "none",
        "triggers": f"{facts['triggers']:,} at "
        + (f"input{'s' * (len(inputs) != 1)} " + ", ".join(map(str, inputs)))
        if inputs
        else "none",
        "hot pixels": f"{len(hot)}" + (f", (x,y): {shown}" if hot else ""),
        "window": f"{facts['events_per_window']:,} events ({USUAL_DENSITY} per pixel), at most "
        f"{facts['longest_window_ms']:g} ms: {counted(facts['windows'], 'image')}",
    }
    print(facts["recording"])
    for name, value in lines.items():
        print(f"  {name:10}  {value}")
