"""The tables of docs/model_card.md, written anew from results/*.json; the words stay.

    python experiments/model_card.py

A table is known by the first two cells of its header. Of the recordings' table only the numbers are
written, in the order of results/shipped_weights.json: verdicts are somebody's. Prints what the
words must say: every figure in which other weights are ahead, and by how much.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from harness import RESULTS

CARD = Path(__file__).parents[1] / "docs" / "model_card.md"
NAMES = {"published": "published", "firenet_plus": "FireNet+", "cista": "others'", "ours": "ours"}
TWICE = ("e2vid_slider_depth.zip", "ros2_event_camera_msgs")  # another format of the one before
BETTER = {"ssim": 1, "ssim_equalised": 1, "mse": -1, "mse_equalised": -1, "temporal": -1}
LABELS = {  # of the rows that are compared
    "long": ("sensor", "windows"),
    "density": ("sensor", "speed", "density", "steps"),
    "light": ("camera", "light"),
    "clip": ("recording",),
    "frames": ("recording", "warm_up"),
}
RESTED = (5, 20, 50, 100)
BRIGHTNESS = (0, 50, 100, 400, 1000)


def accuracy(shipped: dict, endurance: dict) -> list[list[str]]:
    keys = {"ssim": 3, "mse": 4, "ssim_equalised": 3, "mse_equalised": 4, "temporal": 4}
    return [
        [row["sensor"], row["speed"], row["weights"]]
        + [f"{row[key]:.{digits}f}" for key, digits in keys.items()]
        for row in shipped["rows"]
    ]


def recordings(shipped: dict, endurance: dict) -> list[list[str]]:
    """The last two cells of each row."""
    return [
        [f"{row[name]['next']:.2f} ({row[name]['turned']:.2f})" for name in ("published", "ours")]
        for row in shipped["recordings"]
        if row["recording"] not in TWICE
    ]


def long(shipped: dict, endurance: dict) -> list[list[str]]:
    found = {(r["sensor"], r["windows"], r["weights"]): r for r in endurance["long"]}
    return [
        [sensor, age]
        + [f"{found[sensor, age, name]['ssim']:.3f}" for name in NAMES]
        + [f"{found[sensor, age, name]['mse']:.4f}" for name in ("published", "ours")]
        for sensor, age in dict.fromkeys(key[:2] for key in found)
    ]


def density(shipped: dict, endurance: dict) -> list[list[str]]:
    """As `firenet reconstruct` takes windows; then dense ones in one step."""
    rows = [row for row in endurance["density"] if row["speed"] == "slow"]
    most = {row["density"]: max(r["steps"] for r in rows if r["density"] == row["density"])
            for row in rows}  # fmt: skip
    return [
        [sensor, NAMES[name]]
        + [
            f"{row['ssim']:.3f}, {row['ssim_equalised']:.3f}"
            for row in sorted(rows, key=lambda r: (r["steps"] < most[r["density"]], r["density"]))
            if (row["sensor"], row["weights"]) == (sensor, name)
        ]
        for sensor in ("clean", "faulty")
        for name in NAMES
    ]


def light(shipped: dict, endurance: dict) -> list[list[str]]:
    found = {(row["camera"], row["light"], row["weights"]): row for row in endurance["light"]}
    keys = {"ssim": 3, "mse": 4, "ssim_equalised": 3, "mse_equalised": 4}
    return [
        [*kind, NAMES[name]] + [f"{found[*kind, name][k]:.{n}f}" for k, n in keys.items()]
        for kind in dict.fromkeys(key[:2] for key in found)
        for name in NAMES
    ]


def rest(shipped: dict, endurance: dict) -> list[list[str]]:
    found = {(row["noise"], row["weights"]): row for row in endurance["rest"]}
    return [
        [str(noise) if noise else "none", NAMES[name]]
        + [f"{found[noise, name][f'correlation {age}']:.2f}" for age in RESTED]
        + [", ".join(f"{found[noise, name][f'brightness {age}']:.2f}" for age in BRIGHTNESS)]
        for noise in sorted({noise for noise, _ in found})
        for name in NAMES
    ]


def clip(shipped: dict, endurance: dict) -> list[list[str]]:
    found = {(row["recording"], row["weights"]): row for row in endurance["clip"]}
    return [
        [of, NAMES[name]]
        + [f"{found[of, name][key]:.{n}f}" for key, n in (("mse", 4), ("ssim", 3))]
        + [f"{found[of, name]['deviation']:.0f} ({found[of, name]['deviation of truth']:.0f})"]
        for of in dict.fromkeys(key[0] for key in found)
        for name in NAMES
    ]


def frames(shipped: dict, endurance: dict) -> list[list[str]]:
    found = {(r["recording"], r["warm_up"], r["weights"]): r for r in endurance["frames"]}
    keys = {"mse": 3, "ssim": 3, "mse_equalised": 3, "ssim_equalised": 3}
    return [
        [*map(str, key[:2]), NAMES[key[2]]] + [f"{found[key][k]:.{n}f}" for k, n in keys.items()]
        for key in sorted(found, key=lambda key: (*key[:2], list(NAMES).index(key[2])))
    ]


TABLES = {
    ("sensor", "speed"): accuracy,
    ("recording", "ours against the published weights"): recordings,
    ("sensor", "windows"): long,
    ("sensor", "weights"): density,
    ("camera", "light"): light,
    ("noise", "weights"): rest,
    ("photograph", "weights"): clip,
    ("recording", "warm-up"): frames,
}


def filled(text: str, shipped: dict, endurance: dict) -> str:
    """The card with its tables' numbers from these results."""
    lines, rows = [], []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line[:1] == "|" else []
        if tuple(cells[:2]) in TABLES:
            rows = TABLES[tuple(cells[:2])](shipped, endurance)
        elif cells and "---" not in line:
            new = rows.pop(0)
            line = f"| {' | '.join(cells[: len(cells) - len(new)] + new)} |"
        elif not cells and rows:
            raise SystemExit(f"{CARD.name}: a table lacks {len(rows)} rows; add them by hand")
        lines.append(line)
    return "\n".join(lines) + "\n"


def behind(table: str, rows: list[dict], labels: tuple[str, ...]) -> Iterator[str]:
    """ "density, clean, slow, 1.0: ssim_equalised 0.6277, published 0.6467 (-2.9 %)" """
    rows = [row for row in rows if row["weights"] in NAMES]
    for kind in dict.fromkeys(tuple(row[label] for label in labels) for row in rows):
        found = {
            row["weights"]: row for row in rows if tuple(row[label] for label in labels) == kind
        }
        ours = found.pop("ours")
        for key, sign in BETTER.items():
            if key not in ours:
                continue
            name = max(found, key=lambda other: sign * found[other][key])  # noqa: B023
            best = found[name][key]
            if sign * (ours[key] - best) < 0:
                what = ", ".join(map(str, (table, *kind)))
                lead = 100 * (ours[key] / best - 1)
                yield f"{what}: {key} {ours[key]:.4f}, {name} {best:.4f} ({lead:+.1f} %)"


def words(shipped: dict, endurance: dict) -> Iterator[str]:
    """What the card says beside its tables."""
    yield from behind("simulated", shipped["rows"], ("sensor", "speed"))
    for table, labels in LABELS.items():
        yield from behind(table, endurance[table], labels)
    for row in shipped["recordings"]:
        before, after = row["published"]["next"], row["ours"]["next"]
        yield f"next events, {row['recording']}: {after:.3f}, published {before:.3f}"
    shown = {(row["recording"], row["weights"]): row for row in endurance["contrast"]}
    for recording in dict.fromkeys(key[0] for key in shown):
        before, after = (shown[recording, name] for name in ("published", "ours"))
        yield (
            f"contrast, {recording}: {after['deviation']:.2f}, published "
            f"{before['deviation']:.2f}; moves {after['moves']:.2f}"
        )
    for row in endurance["palindrome"]:
        if row["weights"] == "ours":
            change = row["brightness 40"] - row["brightness 2"]
            yield f"palindrome, {row['recording']}: {row['correlation']:.3f}, {change:+.4f}"
    for row in endurance["rest"]:
        if row["weights"] == "ours":
            levels = [row[f"brightness {age}"] for age in BRIGHTNESS]
            moved = max(abs(level - levels[0]) for level in levels)
            yield f"rest, {row['noise']}: brightness moves by {moved:.4f}"


def main():
    shipped, endurance = (
        json.loads((RESULTS / f"{name}.json").read_text())
        for name in ("shipped_weights", "endurance")
    )
    CARD.write_text(filled(CARD.read_text(), shipped, endurance))
    print(*words(shipped, endurance), sep="\n")


if __name__ == "__main__":
    main()
