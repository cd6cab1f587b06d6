"""Figure 4 of the paper: fast things at 640x480, 50,000 events for each image.

Question: does FireNet show what is too fast for a camera? Local histogram equalisation, as in the
paper, whose recordings (a bullet's impact, balloons) are not at hand here: name a recording, or see
a simulated scene whose fastest point reaches 3,000 pixels per second. MSE and SSIM are those of the
pictures shown.

    python experiments/figure4_high_speed.py [RECORDING]            2 minutes

Writes docs/figure4_high_speed.jpg and results/figure4_high_speed.json.
"""

import numpy as np
from figures import (
    about_data,
    about_weights,
    arguments,
    errors,
    event_picture,
    gaps,
    grid,
    images,
    load_methods,
    picture,
    recorded,
    save_figure,
    simulated,
    windows_of,
    with_recordings,
)
from harness import save

from firenet_jax.evaluation.methods import Missing
from firenet_jax.windows import Windows

EVENTS, SPEED, MOMENTS = 50_000, 3000.0, 4
LONGEST = 0.04  # seconds of a simulated scene: 120 pixels of motion at most
ZOOM = (1.2, 1.5)  # pictures that fill the sensor, at the price of a little sharpness


def main():
    parser = with_recordings(arguments(__doc__, seconds=10.0))
    parser.add_argument("--windows", type=int, default=60, help="at most; the second half is shown")
    options = parser.parse_args()
    if len(options.recordings) > 1:
        parser.error("one recording at a time")
    methods = load_methods(["e2vid", "firenet"] if options.e2vid_weights else ["firenet"], options)
    if options.recordings:
        sequence = recorded(options.recordings[0], options.start, options.seconds)
    else:
        seconds = min(options.seconds, LONGEST)
        size = {"height": 480, "width": 640, "zoom": ZOOM}
        sequence = simulated("simulated", options.seed, speed=SPEED, seconds=seconds, **size)
    recording = sequence.recording
    windows = windows_of(sequence, Windows(events=EVENTS), options.windows)
    places = np.linspace(len(windows) // 2, len(windows) - 1, MOMENTS).round().astype(int)
    start = int(windows[0].events.t[0])
    per_second = 1e6 * len(windows) / max(windows[-1].time - start, 1)

    rows = [("events (blue: brighter, red: darker)",
             [event_picture(windows[k], recording) for k in places])]  # fmt: skip
    truths = [sequence.truth(windows[k].time) for k in places]
    numbers = []
    for title, method in methods.items():
        if isinstance(method, Missing):
            rows.append((title, [method.reason] * MOMENTS))
            continue
        made = list(images(method, windows, recording))
        rows.append((title, [picture(made[k], "local") for k in places]))
        for k, truth in zip(places, truths, strict=True):
            if truth is not None:
                moment = {"method": title, "milliseconds": 1e-3 * (windows[k].time - start)}
                numbers.append({**moment, **errors(made[k], truth)})
    if any(truth is not None for truth in truths):
        rows.append(("truth" if not options.recordings else "nearest frame",
                     [picture(truth, "local") for truth in truths]))  # fmt: skip

    rows = [row for row in rows if any(not isinstance(cell, str) for cell in row[1])]
    titles = [f"{1e-3 * (windows[k].time - start):.2f} ms" for k in places]
    sheet = grid(titles, rows)
    motion = "" if options.recordings else f" at most {SPEED:,.0f} pixels per second;"
    caption = [
        about_data(options.recordings),
        f"{recording.width}x{recording.height};{motion} {EVENTS:,} events per tensor, "
        f"{per_second:,.0f} images per second of the scene; local histogram equalisation; "
        f"FireNet: {about_weights(options)}.",
        *gaps(methods),
        "The paper's own high-speed recordings were not at hand." * (not options.recordings),
    ]
    save("figure4_high_speed", {"notes": caption, "rows": numbers})
    save_figure(options.out / "figure4_high_speed.jpg", [sheet], " ".join(caption))


if __name__ == "__main__":
    main()
