"""Live: how late is a picture, and what happens when more comes than a machine works off?

    python experiments/live.py RECORDING... [--seconds 60] [--long RECORDING --minutes 5]

Each recording is played again and again as `firenet live RECORDING --replay --repeat` does, with
its page served and another process that watches the video, as a browser would. Latency is from the
arrival of a window's last event to its picture, of all windows but those of the first two seconds;
the first and the last fifth of the time tell whether the picture falls behind more and more. Then
the same at 20 times the speed: windows are dropped, whole, and counted, latency stays bounded, and
memory does not grow. Writes results/live.json.
"""

import argparse
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import numpy as np
from harness import save

from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.live import Live, source_of
from firenet_jax.live.engine import Figures, Limits, pictures
from firenet_jax.live.page import Board, serve
from firenet_jax.windows import Windows

WARM = 2.0  # seconds that are left out, of short runs a quarter
FAST = 20.0
WATCH = """
import sys, urllib.request
with urllib.request.urlopen(sys.argv[1]) as video:
    while video.read(65536):
        pass
"""


def megabytes() -> float:
    """Of this process, resident."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def play(path: Path, seconds: float, speed: float) -> dict:
    settings = Live(str(path), replay=True, speed=speed, repeat=10**6, port=0)
    source, figures, board = source_of(settings), Figures(), Board()
    figures.latencies = deque()  # all of them
    server = serve(board, figures.summary, source.name, settings.port)
    address = f"http://127.0.0.1:{server.server_address[1]}/video"
    viewer = subprocess.Popen([sys.executable, "-c", WATCH, address])
    count = Windows(events_per_pixel=settings.events_per_pixel).count(source.height * source.width)
    limits = Limits(count, round(1000 * settings.longest), settings.behind)
    shown = pictures(source, load_weights(), limits, figures, settings.display)
    times, memory, begun = [], [], None
    try:
        for picture in shown:
            now = time.monotonic()
            begun = now if begun is None else begun
            board.hang(picture)
            times.append(now - begun)
            if not memory or now - begun > len(memory):
                memory.append(megabytes())  # once a second
            if now - begun > seconds:
                break
    finally:
        shown.close()
        board.end()
        server.shutdown()
        server.server_close()
        viewer.kill()
        viewer.wait()
    warm_up = min(WARM, seconds / 4)
    times, latencies = np.array(times), 1000 * np.array(figures.latencies)[: len(times)]
    warm, fifth = times > warm_up, (seconds - warm_up) / 5
    first = latencies[warm & (times <= warm_up + fifth)]
    last = latencies[times > seconds - fifth]

    def two(values):
        return [round(float(x), 1) for x in np.percentile(values, [50, 95])]

    found = {
        "sensor": f"{source.width}x{source.height}", "speed": speed, "seconds": seconds,
        "events_per_second": round(figures.events / seconds),
        "windows_shown": figures.shown, "windows_dropped": figures.dropped,
        "latency_ms_median_95": two(latencies[warm]),
        "longest_latency_ms": round(float(latencies[warm].max()), 1),
        "first_fifth": two(first), "last_fifth": two(last),
        "megabytes_after_2_s": round(memory[min(2, len(memory) - 1)]),
        "megabytes_at_the_end": round(memory[-1]),
    }  # fmt: skip
    print(f"{path.name:28} {found}", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--long", type=Path, help="is played for --minutes, too")
    parser.add_argument("--minutes", type=float, default=5)
    arguments = parser.parse_args()
    found = {
        path.stem: {
            "at its speed": play(path, arguments.seconds, 1.0),
            "at 20 times its speed": play(path, arguments.seconds / 2, FAST),
        }
        for path in arguments.recordings
    }
    if arguments.long:
        found["long"] = {arguments.long.stem: play(arguments.long, 60 * arguments.minutes, 1.0)}
    save("live", {"recordings": found})


if __name__ == "__main__":
    main()
