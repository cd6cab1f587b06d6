"""Figure 5 of the paper: what the networks see when they forget everything between windows.

Question: how much of an image comes from the state? 10,000 events per tensor, local histogram
equalisation; without recurrence each window starts from a zero state. Expected: without
it FireNet shows edges where events are, and nothing true elsewhere. Where the sequences are
simulated the truth at every window's end is known, and MSE and SSIM (equalised) are means over the
last 20 windows of each.

    python experiments/figure5_recurrence.py [RECORDING...] [--e2vid-weights FILE]      2 minutes

Writes docs/figure5_recurrence.jpg and results/figure5_recurrence.json.
"""

import numpy as np
from figures import (
    about_data,
    about_weights,
    arguments,
    conditions,
    errors,
    event_picture,
    gaps,
    grid,
    images,
    load_methods,
    picture,
    save_figure,
    windows_of,
    with_recordings,
)
from harness import save

from firenet_jax.evaluation.methods import Missing
from firenet_jax.windows import Windows

EVENTS, JUDGED = 10_000, 20


def main():
    options = with_recordings(arguments(__doc__, seconds=1.0)).parse_args()
    methods = load_methods(["e2vid", "firenet"], options)
    ways = [(title, recurrent) for title in methods for recurrent in (False, True)]
    names = [f"{title}, {'with' if recurrent else 'no'} recurrence" for title, recurrent in ways]
    rows, numbers = [], []
    for sequence in conditions(options):
        recording, cells = sequence.recording, []
        windows = windows_of(sequence, Windows(events=EVENTS))
        truths = [sequence.truth(window.time) for window in windows[-JUDGED:]]
        for name, (title, recurrent) in zip(names, ways, strict=True):
            method = methods[title]
            if isinstance(method, Missing):
                cells.append(method.reason)
                continue
            # what forgets needs no windows before those that are judged
            used = windows if recurrent else windows[-JUDGED:]
            made = list(images(method, used, recording, recurrent))[-JUDGED:]
            cells.append(picture(made[-1], "local"))
            if not options.recordings:
                each = [errors(*pair) for pair in zip(made, truths, strict=True)]
                means = {key: float(np.mean([row[key] for row in each])) for key in each[0]}
                numbers.append({"sequence": sequence.name, "method": name, **means})
                print(f"{sequence.name:22} {name:28} MSE {means['mse']:.3f} "
                      f"SSIM {means['ssim']:.3f}")  # fmt: skip
        truth = picture(truths[-1], "local")
        rows.append((sequence.name, [event_picture(windows[-1], recording), *cells, truth]))
    said = [about_data(options.recordings), *gaps(methods)]
    if options.recordings:
        said.append("No numbers: recordings have no truth at the windows' ends.")
    save("figure5_recurrence", {"weights": about_weights(options), "notes": said, "rows": numbers})
    caption = [
        *said,
        f"{EVENTS:,} events per tensor; local histogram equalisation; FireNet: "
        f"{about_weights(options)}.",
    ]
    sheet = grid(["events", *names, "frame"], rows, cell=200)
    save_figure(options.out / "figure5_recurrence.jpg", [sheet], " ".join(caption))


if __name__ == "__main__":
    main()
