"""Results of an evaluation -> table, CSV, one page of HTML that needs nothing else.

Results are the dictionary that `evaluate` writes as results.json: settings, numbers of each
sequence, method and frame, means; a missing number is None, and its entry says why under
"gaps" (or, for all of a method's numbers, "gap"). The page holds its pictures, videos, curves and
style; it loads no script and nothing from elsewhere.
"""

import base64
import csv
import datetime
import io
import itertools
import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from PIL import Image

from firenet_jax.checkpoint import digest, load_weights
from firenet_jax.evaluation.results import METRICS
from firenet_jax.events import Events

# Easy to tell apart, also with most kinds of colour blindness (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
CURVES = ("mse", "ssim", "nlpd", "temporal_error")
QUALITY = 88  # of JPEG: grain of a reconstruction stays visible, at a third of the size of PNG


class Shown(NamedTuple):
    """What the page shows of a sequence besides numbers."""

    titles: list[str]  # of the pictures in a row: "events", "frame", then methods
    stills: list[tuple[str, list[np.ndarray]]]  # (time, [(H, W) or (H, W, 3) uint8 for each title])
    video: bytes | None  # mp4, the same pictures side by side


def event_picture(events: Events, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8, on white: blue where most of a pixel's events say brighter, red darker."""
    signs = np.where(events.p, 1.0, -1.0)
    votes = np.bincount(events.flat_index(width), signs, height * width)
    picture = np.full((height * width, 3), 255, np.uint8)
    picture[votes > 0], picture[votes < 0] = (0, 0, 255), (255, 0, 0)
    return picture.reshape(height, width, 3)


def in_colours(picture: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, 3) -> (H, W, 3)"""
    return picture if picture.ndim == 3 else np.stack([picture] * 3, -1)


# ---- Tables


def rows_of(results: dict) -> Iterator[tuple[str, str, str, dict]]:
    """Yields (sequence or kind of mean, method, frames or sequences it is of, entry)."""
    for sequence, facts in results["sequences"].items():
        for method, entry in facts["methods"].items():
            count = "" if "gap" in entry else f"{entry['frames']}/{entry['of']}"
            yield sequence, method, count, entry
    for kind, means in results["means"].items():
        for method, entry in means.items():
            if "gap" in entry:
                count = ""
            elif kind == "over frames":
                count = f"{entry['frames']}"
            else:
                count = f"{entry['sequences']}/{entry['of_sequences']} seq"
            yield f"mean {kind}", method, count, entry


def columns(results: dict) -> list[str]:
    """The metrics that have a number somewhere."""
    entries = [entry for *_, entry in rows_of(results) if "gap" not in entry]
    return [name for name in METRICS if any(e["means"][name] is not None for e in entries)]


def cell(entry: dict, name: str) -> str:
    """A number, or the words for why there is none."""
    value = entry["means"][name]
    return entry["gaps"][name] if value is None else f"{value:.{METRICS[name].digits}f}"


def notes(results: dict) -> list[str]:
    """What a reader of the numbers has to know, a sentence each."""
    said = list(results["protocol"])
    entries = [entry for *_, entry in rows_of(results) if "gap" not in entry]
    absent = {
        METRICS[name].title: entries[0]["gaps"][name]
        for name in METRICS
        if name not in columns(results)
    }
    if absent:
        said.append("no numbers: " + ", ".join(f"{name} ({why})" for name, why in absent.items()))
    for method, mean in results["means"]["over sequences"].items():
        for name, why in mean.get("gaps", {}).items():
            if mean["means"][name] is not None:
                said.append(f"{method}: mean {METRICS[name].title} of the others: {why}")
    for sequence, facts in results["sequences"].items():
        found = [entry for entry in facts["methods"].values() if "gap" not in entry]
        empty = max((entry["windows_without_events"] for entry in found), default=0)
        if empty:
            said.append(f"{sequence}: {empty} window{'s' * (empty > 1)} without events")
    return said


def table(results: dict) -> str:
    """For a terminal."""
    shown = columns(results)
    lines, last = [["", "", "frames", *(METRICS[name].title for name in shown)]], None
    single = len(results["sequences"]) == 1  # of which a mean says the same again
    for sequence, method, count, entry in rows_of(results):
        if single and sequence not in results["sequences"]:
            continue
        cells = [entry["gap"]] if "gap" in entry else [cell(entry, name) for name in shown]
        lines.append(["" if sequence == last else sequence, method, count, *cells])
        last = sequence
    whole = [line for line in lines if len(line) == len(lines[0])]
    widths = [max(map(len, column)) for column in zip(*whole, strict=True)]
    widths[0] = max(len(line[0]) for line in lines)
    widths[1] = max(len(line[1]) for line in lines)
    text = []
    for line in lines:
        words = [word.ljust(width) for word, width in zip(line[:2], widths, strict=False)]
        words += [word.rjust(width) for word, width in zip(line[2:], widths[2:], strict=False)]
        text.append("  ".join(words).rstrip())
    return "\n".join([*text, "", *notes(results)])


def spreadsheet(results: dict) -> str:
    """CSV: a line for each sequence and method, then the means; gaps are empty and named last."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["sequence", "method", "frames", *METRICS, "gaps"])
    for sequence, method, count, entry in rows_of(results):
        means = entry.get("means", dict.fromkeys(METRICS))
        why = "; ".join(f"{name}: {reason}" for name, reason in entry.get("gaps", {}).items())
        writer.writerow([sequence, method, count, *means.values(), entry.get("gap", why)])
    return file.getvalue()


# ---- Page

STYLE = """
:root { color-scheme: light; --line: #d9dde3; --soft: #f5f6f8; --text: #1c2430; --dim: #667080; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--text); background: #fff;
  max-width: 1320px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 24px; margin: 0 0 4px; }
h2 { font-size: 19px; margin: 44px 0 4px; padding-top: 14px; border-top: 1px solid var(--line);
  overflow-wrap: anywhere; }
p, ul { margin: 4px 0 14px; color: var(--dim); }
ul { padding-left: 20px; }
code { font-size: 13px; overflow-wrap: anywhere; }
nav { margin: 10px 0 0; columns: 5 150px; }
nav a { display: block; overflow-wrap: anywhere; }
a { color: #0b5cad; text-decoration: none; }
a:hover { text-decoration: underline; }
.wide { overflow-x: auto; margin: 12px 0 18px; }
table { border-collapse: collapse; width: 100%;
  font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 8px; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; background: var(--soft); }
th:first-child, td:first-child { text-align: left; }
td.best { font-weight: 700; background: #e8f3ec; }
td.gap { color: var(--dim); font-style: italic; }
td.gap[colspan] { text-align: left; }
.key { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 7px; }
.row { display: grid; gap: 6px; margin-bottom: 3px; }
.row div { text-align: center; font-size: 13px; color: var(--dim); overflow-wrap: anywhere; }
.row.tight { gap: 0; margin: 12px 0 2px; }
.row img, video { width: 100%; display: block; background: #000; }
.time { font-size: 13px; color: var(--dim); margin: 0 0 10px; }
.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(270px, 1fr)); gap: 10px;
  margin: 14px 0; }
svg { width: 100%; height: auto; display: block; }
svg text { font: 11px system-ui, sans-serif; fill: var(--dim); }
svg text.title { font-size: 13px; font-weight: 600; fill: var(--text); }
"""


def page(results: dict, shown: dict[str, Shown]) -> str:
    """The report as one HTML file; shown: by sequence."""
    colours = {m: COLOURS[k % len(COLOURS)] for k, m in enumerate(results["methods"])}
    sequences = results["sequences"]
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>firenet evaluate: {escape(', '.join(colours))}</title>",
        f"<style>{STYLE}</style></head><body>",
        "<h1>Reconstructions beside camera frames</h1>",
        f"<p>Sequences: {len(sequences)}. Methods: {escape(', '.join(colours))}. The best number "
        "of each column is marked. Pictures are shown as they were compared; events are of the "
        "window that ends there, blue brighter, red darker.</p>",
        f"<p>{escape(made(results))}</p>",
        f"<p><code>{escape(results.get('command', ''))}</code></p>",
    ]
    if len(sequences) != 1:  # the mean of one says the same again
        for kind, means in results["means"].items():
            table_of = _table(results, means, colours, f"Mean {kind}")
            parts.append(f"<div class=wide>{table_of}</div>")
    said = [f"{name}: {about(name, record)}" for name, record in results["methods"].items()]
    said += notes(results)
    parts.append("<ul>" + "".join(f"<li>{escape(note)}</li>" for note in said) + "</ul>")
    links = (f'<a href="#{_anchor(k)}">{escape(name)}</a>' for k, name in enumerate(sequences))
    parts.append(f"<nav>{''.join(links)}</nav>")
    for number, (name, facts) in enumerate(sequences.items()):
        parts += [
            f'<section><h2 id="{_anchor(number)}">{escape(name)}</h2>',
            f"<p>{escape(_described(facts))}</p>",
            f"<div class=wide>{_table(results, facts['methods'], colours, 'method')}</div>",
        ]
        if name in shown:
            parts.append(_pictures(shown[name]))
        parts += [_curves(facts["methods"], colours), "</section>"]
    parts.append("</body></html>\n")
    return "\n".join(part for part in parts if part)


def about(name: str, record: dict | None) -> str:
    """What a method is, for people who read its name in a table. Names of weights may be any."""
    kind = name if record is None else record["method"]
    if record is not None and kind == "firenet":
        ours = record["weights"] == digest(load_weights())
        whose = "the weights of this package" if ours else "with the weights of this name"
        return f"FireNet (Scheerlinck et al. 2020), {whose}"
    known = {
        "hf": "high-pass filter (Scheerlinck et al. 2018), not learned",
        "mr": "manifold regularisation (Reinbacher et al. 2016), not learned",
        "e2vid": "E2VID (Rebecq et al. 2019), from its checkpoint",
        "e2vid-random": "E2VID with random weights: its images mean nothing",
    }
    return known[name if name == "e2vid-random" else kind]


def made(results: dict) -> str:
    """When, by which version, with which settings."""
    settings = results.get("settings", {})
    chosen = [f"{k} {v}" for k, v in settings.items() if v is not None and k != "version"]
    today = datetime.date.today().isoformat()
    return f"{today}, firenet_jax {settings.get('version', '')}; settings: {', '.join(chosen)}."


def _anchor(number: int) -> str:
    return f"sequence-{number + 1}"


def _described(facts: dict) -> str:
    """A sequence's format, size, what of it counts and what its images are."""
    if facts["sensor"] is None:
        return "not opened"
    width, height = facts["sensor"]
    start, stop = facts["counted_seconds"]
    counted = f"frames from {start:g} s on" if start else "all frames"
    if stop is not None:
        counted = f"frames from {start:g} to {stop:g} s"
    images = facts["images"] or "no images"
    return f"{facts['format']}, {width}x{height}; counted: {counted}; {images}"


def _table(results: dict, entries: dict[str, dict], colours: dict[str, str], title: str) -> str:
    shown = columns(results)
    arrows = {"lower": "&darr;", "higher": "&uarr;"}
    heads = "".join(f"<th>{METRICS[n].title} {arrows[METRICS[n].better]}</th>" for n in shown)
    best = {name: _best(entries, name) for name in shown}
    rows = []
    for method, entry in entries.items():
        key = f'<span class=key style="background:{colours[method]}"></span>{escape(method)}'
        if "gap" in entry:
            rows.append(
                f"<tr><td>{key}</td><td class=gap colspan={len(shown) + 1}>"
                f"{escape(entry['gap'])}</td></tr>"
            )
            continue
        count = f"{entry['frames']}/{entry['of']}" if "of" in entry else str(entry["frames"])
        if entry.get("of_sequences", 0) != entry.get("sequences", 0):
            count += f" of {entry['sequences']}/{entry['of_sequences']} sequences"
        cells = []
        for name in shown:
            missing = entry["means"][name] is None
            text = escape(cell(entry, name))
            kind = "gap" if missing else "best" if text == best[name] else ""
            cells.append(f'<td class="{kind}">{text}</td>' if kind else f"<td>{text}</td>")
        rows.append(f"<tr><td>{key}</td><td>{count}</td>{''.join(cells)}</tr>")
    head = f"<tr><th>{title}</th><th>frames</th>{heads}</tr>"
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _best(entries: dict[str, dict], name: str) -> str | None:
    """As it is printed; None where there is nothing to compare."""
    found = [e for e in entries.values() if "gap" not in e and e["means"][name] is not None]
    if len(found) < 2:
        return None
    pick = min if METRICS[name].better == "lower" else max
    return cell(pick(found, key=lambda entry: entry["means"][name]), name)


def _pictures(shown: Shown) -> str:
    style = f'style="grid-template-columns:repeat({len(shown.titles)},1fr)"'
    titles = "".join(f"<div>{escape(title)}</div>" for title in shown.titles)
    parts = []
    if shown.stills:
        parts.append(f"<div class=row {style}>{titles}</div>")
    for time, images in shown.stills:
        row = "".join(
            f'<img alt="{escape(title)} at {time}" src="{_jpeg(image)}">'
            for title, image in zip(shown.titles, images, strict=True)
        )
        parts.append(f"<div class=row {style}>{row}</div><div class=time>{time}</div>")
    if shown.video is not None:
        source = "data:video/mp4;base64," + base64.b64encode(shown.video).decode()
        parts.append(
            f'<div class="row tight" {style}>{titles}</div>'
            f'<video controls autoplay loop muted playsinline src="{source}"></video>'
        )
    return "\n".join(parts)


def _jpeg(image: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def _curves(entries: dict[str, dict], colours: dict[str, str]) -> str:
    """A chart for each metric of CURVES that has two numbers or more."""
    charts = []
    for name in CURVES:
        series = {
            method: (entry["times"], entry["values"][name])
            for method, entry in entries.items()
            if "gap" not in entry and sum(v is not None for v in entry["values"][name]) > 1
        }
        if series:
            charts.append(chart(METRICS[name].title, series, colours))
    return f"<div class=curves>{''.join(charts)}</div>" if charts else ""


def chart(title: str, series: dict[str, tuple[Sequence, Sequence]], colours: dict[str, str]) -> str:
    """{name: (times in seconds, values or None)} -> SVG; a None interrupts its line."""
    width, height, left, right, top, bottom = 320, 200, 40, 8, 26, 26
    times = [t for ts, _ in series.values() for t in ts]
    values = [v for _, vs in series.values() for v in vs if v is not None]
    t_low, t_high = min(times), max(times)
    ticks = steps(min(values), max(values))
    low, high = min(ticks[0], min(values)), max(ticks[-1], max(values))

    def x(t):
        return left + (width - left - right) * (t - t_low) / ((t_high - t_low) or 1)

    def y(v):
        return height - bottom - (height - top - bottom) * (v - low) / ((high - low) or 1)

    parts = [
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)} over time">',
        f'<text class="title" x="{left}" y="15">{escape(title)}</text>',
    ]
    for tick in ticks:
        parts.append(
            f'<line x1="{left}" x2="{width - right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" '
            f'stroke="#e3e6eb"/><text x="{left - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">'
            f"{tick:g}</text>"
        )
    for tick in steps(t_low, t_high):
        if t_low <= tick <= t_high:
            parts.append(
                f'<text x="{x(tick):.1f}" y="{height - 9}" text-anchor="middle">{tick:g} s</text>'
            )
    for name, (ts, vs) in series.items():
        for run in _runs(ts, vs):
            points = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v in run)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colours[name]}" '
                'stroke-width="1.8" stroke-linejoin="round" stroke-linecap="round"/>'
            )
    return "".join([*parts, "</svg>"])


def _runs(times: Sequence, values: Sequence) -> Iterator[list[tuple[float, float]]]:
    """Stretches without None."""
    points = zip(times, values, strict=True)
    for there, run in itertools.groupby(points, lambda point: point[1] is not None):
        if there:
            yield list(run)


def steps(low: float, high: float) -> list[float]:
    """Three to seven round numbers from just below `low` to just above `high`."""
    span = (high - low) or abs(high) or 1.0
    size = 10.0 ** math.floor(math.log10(span / 4))
    step = next(size * k for k in (1, 2, 5, 10) if span / (size * k) <= 5)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 10) for k in range(first, max(last, first + 1) + 1)]
