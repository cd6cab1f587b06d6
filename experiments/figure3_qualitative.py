"""Figure 3 of the paper: what each method makes of the same events, beside the camera's frame.

Question: how do HF, MR, E2VID and FireNet look? A row for each sequence; windows lie between
frames, and the picture is the last after `--seconds` of events. Without recordings the sequences
are simulated. E2VID is a named gap unless its checkpoint is given. MSE and SSIM are those of the
pictures as shown.

    python experiments/figure3_qualitative.py [RECORDING...] [--e2vid-weights FILE]     2 minutes

Writes docs/figure3_qualitative.jpg and results/figure3_qualitative.json.
"""

from figures import (
    about_data,
    about_weights,
    arguments,
    conditions,
    errors,
    event_picture,
    gaps,
    grid,
    last_image,
    load_methods,
    picture,
    save_figure,
    windows_of,
    with_recordings,
)
from harness import save

from firenet_jax.windows import Windows


def main():
    parser = with_recordings(arguments(__doc__, seconds=2.0))
    parser.add_argument("--equalise", choices=("none", "global", "local", "clahe"), default="none")
    options = parser.parse_args()
    methods = load_methods(["hf", "mr", "e2vid", "firenet"], options)
    rows, numbers = [], []
    for sequence in conditions(options):
        recording = sequence.recording
        windows = windows_of(sequence, Windows(frame_to_frame=True))
        made = [last_image(method, windows, recording) for method in methods.values()]
        truth = sequence.truth(windows[-1].time)
        for title, image in zip(methods, made, strict=True):
            if truth is not None and not isinstance(image, str):
                found = errors(image, truth, options.equalise)
                numbers.append({"sequence": sequence.name, "method": title, **found})
        shown = [picture(image, options.equalise) for image in (*made, truth)]
        rows.append((sequence.name, [event_picture(windows[-1], recording), *shown]))
    sheet = grid(["events", *methods, "frame"], rows, cell=200)
    caption = [
        about_data(options.recordings),
        f"Windows between frames; equalisation: {options.equalise}; HF after a bilateral filter, "
        f"sigma 25; FireNet: {about_weights(options)}.",
        *gaps(methods),
    ]
    save("figure3_qualitative", {"notes": caption, "rows": numbers})
    save_figure(options.out / "figure3_qualitative.jpg", [sheet], " ".join(caption))


if __name__ == "__main__":
    main()
