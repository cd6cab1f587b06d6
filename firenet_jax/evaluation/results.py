"""Numbers of each frame -> means over sequences and frames; a gap says why a number is missing."""

from typing import NamedTuple

import numpy as np


class Metric(NamedTuple):
    title: str
    better: str  # "lower" or "higher"
    digits: int


METRICS = {
    "mse": Metric("MSE", "lower", 4),
    "psnr": Metric("PSNR", "higher", 2),
    "ssim": Metric("SSIM", "higher", 3),
    "ms_ssim": Metric("MS-SSIM", "higher", 3),
    "haarpsi": Metric("HaarPSI", "higher", 3),
    "cw_ssim": Metric("CW-SSIM", "higher", 3),
    "nlpd": Metric("NLPD", "lower", 3),
    "gmsd": Metric("GMSD", "lower", 3),
    "random_features": Metric("Features", "lower", 3),
    "lpips": Metric("LPIPS", "lower", 3),
    "temporal_error": Metric("Temporal", "lower", 4),
}


class Measured(NamedTuple):
    """The numbers of one method's images of one sequence, n frames of it; ready for JSON."""

    frames: int  # n, those that had an image
    of: int  # frames that count
    windows_without_events: int
    seconds: float  # that it took
    gaps: dict[str, str]  # metric: why it has no mean
    frame_numbers: list[int]  # n, in the recording
    times: list[float]  # n, seconds from the sequence's beginning
    values: dict[str, list[float | None]]  # metric: n numbers, None where one cannot be


def summary(found: Measured) -> dict:
    """With their means, ready for JSON; null where there is a gap."""
    means = {}
    for name in METRICS:
        values = [value for value in found.values.get(name, []) if value is not None]
        means[name] = None if name in found.gaps else sum(values) / len(values)
    return {"means": means, **found._asdict()}


def mean(sequences: dict, method: str, weigh: bool) -> dict:
    """Means of a method over sequences, or, weighed, over all of their frames."""
    entries = [entry["methods"][method] for entry in sequences.values()]
    there = [entry for entry in entries if "gap" not in entry]
    if not there:
        return {"gap": entries[0]["gap"]}
    means, gaps = {}, {}
    for name in METRICS:
        with_it = [entry for entry in there if entry["means"][name] is not None]
        weights = [
            sum(v is not None for v in entry["values"][name]) if weigh else 1 for entry in with_it
        ]
        values = [entry["means"][name] for entry in with_it]
        means[name] = float(np.average(values, weights=weights)) if values else None
        if len(with_it) < len(there):  # a mean of fewer sequences is no match for one of all
            why = next(entry["gaps"][name] for entry in there if name in entry["gaps"])
            count = len(there) - len(with_it)
            gaps[name] = f"{why} in {count} of {len(there)} sequences" if values else why
    return {
        "means": means,
        "gaps": gaps,
        "sequences": len(there),
        "of_sequences": len(entries),
        "frames": sum(entry["frames"] for entry in there),
    }
