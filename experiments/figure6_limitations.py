"""Figure 6 of the paper: start-up from a zero state, and smearing under fast motion.

Questions: (a) after how many windows is an image from a zero state as good as one of a state that
has seen more, and how much of that does the warm-up of `firenet reconstruct` give? The same windows
(0.35 events per pixel) are reconstructed from their beginning, after the warm-up, which shows the
first 20 of them forwards and backwards, and with as many windows before them. (b) How much do 50 ms
windows smear a fast scene that 5 ms windows show sharply, and do they in a slow one, if each is one
step, and if dense ones are several, as in `firenet reconstruct`? Errors are
those at the ends of the long windows of the second half; the picture is that of the busiest of
these. MSE and SSIM after local histogram equalisation, means over 6 sequences. All data is
simulated, because errors need the truth at each window's end.

    python experiments/figure6_limitations.py            6 minutes

Writes docs/figure6_startup.jpg, docs/figure6_smearing.jpg and results/figure6_limitations.json.
"""

import numpy as np
from figures import (
    Sequence,
    about_data,
    about_weights,
    arguments,
    errors,
    event_picture,
    grid,
    images,
    load_methods,
    picture,
    plotted,
    save_figure,
    simulated,
    windows_of,
)
from harness import save
from matplotlib.figure import Figure

from firenet_jax.evaluation.methods import Method
from firenet_jax.instants import PART, Step, in_parts, warming
from firenet_jax.windows import Window, Windows

COLOURS = {
    "from zero": "tab:red",
    "after the warm-up": "tab:green",
    "with windows before": "tab:blue",
}
MOST = 40  # windows after the start
SHOWN = (1, 2, 4, 8, 16, 40)
LONG, SHORT = 50.0, 5.0  # milliseconds
WAYS = f"{LONG:.0f} ms in one step", f"{LONG:.0f} ms in steps", f"{SHORT:.0f} ms"
STARTING = 400.0  # pixels per second: some 80 windows in 1.5 s
SPEEDS = (50.0, 600.0, 1500.0)  # pixels per second


def start_up(method: Method, options) -> tuple[dict, list]:
    """Means of errors by windows since the start, and rows of pictures of the first sequence."""
    ways = {way: [] for way in COLOURS}
    rows = []
    for k in range(options.sequences):
        sequence = simulated("start-up", options.seed + k, speed=STARTING, seconds=options.seconds)
        windows = windows_of(sequence, Windows(), 2 * MOST)
        half = len(windows) // 2
        after = windows[half : 2 * half]
        first, _ = warming(after, sequence.recording.pixels)
        before = [Window(step.events, after[0].time) for step in first]
        truths = [sequence.truth(window.time) for window in after]
        recording = sequence.recording
        made = {
            "from zero": list(images(method, after, recording)),
            "after the warm-up": list(images(method, before + after, recording))[len(before) :],
            "with windows before": list(images(method, windows[: 2 * half], recording))[half:],
        }
        for way, found in made.items():
            ways[way].append([errors(*pair) for pair in zip(found, truths, strict=True)])
        if k == 0:
            places = [n - 1 for n in SHOWN if n <= half]
            rows = [
                (way, [picture(found[place], "none") for place in places])
                for way, found in (made | {"truth": truths}).items()
            ]
    # scenes with fewer events have fewer windows: means are over the count that all have
    count = min(len(run) for runs in ways.values() for run in runs)
    means = {
        way: {
            name: [float(np.mean([run[n][name] for run in runs])) for n in range(count)]
            for name in ("mse", "ssim")
        }
        for way, runs in ways.items()
    }
    return means, rows


def curves(means: dict) -> Figure:
    figure = Figure(figsize=(9, 2.8), dpi=100, layout="constrained")
    for axis, name in zip(figure.subplots(1, 2), ("mse", "ssim"), strict=True):
        for way, found in means.items():
            values = found[name]
            number = np.arange(1, len(values) + 1)
            axis.plot(number, values, ".-", color=COLOURS[way], label=way)
        axis.set(title=name.upper(), xlabel="windows since the start")
        axis.grid(alpha=0.3)
        axis.legend()
    return figure


def smearing(method: Method, options) -> tuple[list[dict], list]:
    """Numbers for each speed and kind of window, and a row of pictures for each speed."""
    numbers, rows = [], []
    for speed in SPEEDS:
        found = {way: [] for way in WAYS}
        for k in range(options.sequences):
            sequence = simulated("smearing", options.seed + k, speed=speed, seconds=options.seconds)
            windows, made = each_way(method, sequence)
            half = len(windows) // 2
            windows = windows[half:]
            made = {way: shown[half:] for way, shown in made.items()}
            truths = [sequence.truth(window.time) for window in windows]
            for way, shown in made.items():
                found[way] += [errors(*pair) for pair in zip(shown, truths, strict=True)]
            if k == 0:
                busiest = max(range(len(windows)), key=lambda n: len(windows[n].events))
                shown = [*(made[way][busiest] for way in WAYS), truths[busiest]]
                cells = [event_picture(windows[busiest], sequence.recording)]
                cells += [picture(image, "none") for image in shown]
                rows.append((f"at most {speed:,.0f} pixels per second", cells))
        for way, each in found.items():
            means = {key: float(np.mean([row[key] for row in each])) for key in each[0]}
            numbers.append({"speed": speed, "windows": way, **means})
            print(f"{speed:5.0f} pixels/s, windows of {way}: MSE {means['mse']:.3f} "
                  f"SSIM {means['ssim']:.3f}")  # fmt: skip
    return numbers, rows


def each_way(method: Method, sequence: Sequence) -> tuple[list[Window], dict]:
    """The long windows, and the images at their ends that each of `WAYS` gives."""
    ratio = round(LONG / SHORT)
    long = windows_of(sequence, Windows(duration=LONG))
    # grids of both begin at the first event, so every tenth short window ends a long one
    short = windows_of(sequence, Windows(duration=SHORT))[: ratio * len(long)]
    recording = sequence.recording
    steps = [
        step for each in long for step in in_parts(Step(each.events, each.time, 1.0),
                                                   recording.pixels)
    ]  # fmt: skip
    parts = images(method, [Window(step.events, step.time or 0) for step in steps], recording)
    ends = [image for step, image in zip(steps, parts, strict=True) if not step.later]
    whole = list(images(method, long, recording))
    brief = list(images(method, short, recording))[ratio - 1 :: ratio]
    return long, dict(zip(WAYS, (whole, ends, brief), strict=True))


def main():
    parser = arguments(__doc__, seconds=1.5)
    parser.add_argument("--sequences", type=int, default=6)
    options = parser.parse_args()
    method = load_methods(["firenet"], options)["FireNet"]
    if not isinstance(method, Method):
        raise SystemExit(f"FireNet: {method.reason}: name a file with --weights")
    data = f"{about_data([])} FireNet: {about_weights(options)}."

    means, pictures = start_up(method, options)
    titles = [f"window {n}" for n in SHOWN[: len(pictures[0][1])]]
    save_figure(
        options.out / "figure6_startup.jpg",
        [grid(titles, pictures, cell=150), plotted(curves(means))],
        f"{data} Windows of 0.35 events per pixel; the same windows from a zero state, after "
        "the warm-up of firenet reconstruct, and with as many windows before. Pictures as they "
        "are; errors after local histogram equalisation, "
        f"means over {options.sequences} sequences.",
    )
    numbers, pictures = smearing(method, options)
    titles = [f"events of {LONG:.0f} ms", *(f"windows of {way}" for way in WAYS)]
    save_figure(
        options.out / "figure6_smearing.jpg",
        [grid([*titles, "truth"], pictures)],
        f"{data} All end at the same time; pictures as they are, those of the busiest long window. "
        f"In steps: of about {PART} events per pixel, as in firenet reconstruct.",
    )
    save(
        "figure6_limitations",
        {
            "data": about_data([]),
            "weights": about_weights(options),
            "sequences": options.sequences,
            "start_up": means,
            "smearing": numbers,
        },
    )


if __name__ == "__main__":
    main()
