"""Pictures -> textures (N, S, S) float32 in [0, 1]: cut from photographs at random, or drawn.

On the host, in numpy and Pillow. Nothing is downloaded: without pictures of your own, textures are
cut from those that come inside scikit-image's wheel.
"""

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from firenet_jax.errors import PictureError, logger
from firenet_jax.storage.files import files_in

PHOTOGRAPHS = {  # that come inside the wheels of these packages
    "skimage/data": (
        "brick.png", "camera.png", "coins.png", "grass.png", "gravel.png", "hubble_deep_field.jpg",
        "ihc.png", "moon.png", "motorcycle_left.png", "motorcycle_right.png", "page.png",
        "retina.jpg", "rocket.jpg",
    ),
}  # fmt: skip
HELD_OUT = {  # frozen before any training: to judge networks by, in no pool that they train on
    "skimage/data": ("astronaut.png", "chelsea.png", "coffee.png"),
    "sklearn/datasets/images": ("china.jpg", "flower.jpg"),
}
SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


def load_textures(
    pictures: str | Path | list[Path] | None = None,
    count: int = 64,
    size: int = 256,
    seed: int = 0,
    procedural: float | None = None,
) -> np.ndarray:
    """Pictures -> textures (count, size, size) float32 in [0, 1], grey, cut at random.

    pictures: a folder of them (searched with its subfolders; .jpg, .png and others), without
    those of `HELD_OUT`, known by their names; or a list of files; only as many as are asked for
    are opened. None: the photographs that come with scikit-image.
    procedural: part of the textures that is drawn instead (`PROCEDURAL`); None: none of them
    where pictures are named, else a quarter.
    Raises PictureError where no picture can be used.
    """
    rng = np.random.default_rng(seed)
    if procedural is None:
        procedural = 0.25 if pictures is None else 0.0
    if pictures is None:
        paths = photographs()
    else:
        paths = pictures if isinstance(pictures, list) else pictures_in(Path(pictures))
    drawn = round(procedural * count) if paths else count
    textures = _cuttings(rng, paths, count - drawn, size, pictures) if count > drawn else []
    kinds = list(PROCEDURAL.values())
    textures += [kinds[k % len(kinds)](rng, size) for k in range(drawn)]
    return np.stack(textures).astype(np.float32)


def photographs(packages: dict[str, tuple[str, ...]] = PHOTOGRAPHS) -> list[Path]:
    """The pictures inside the wheels of these packages; none of a package not installed."""
    found = []
    for folder, names in packages.items():
        package, _, inside = folder.partition("/")
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.submodule_search_locations:
            place = Path(spec.submodule_search_locations[0]) / inside
            found += [place / name for name in names if (place / name).exists()]
    return found


def pictures_in(folder: Path) -> list[Path]:
    """The pictures in a folder and in folders below it, without those of `HELD_OUT`, sorted.

    Raises PictureError where there are none."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "no such folder"
        raise PictureError(f"{folder}: {found}: name a folder with pictures in it")
    held_out = {name for names in HELD_OUT.values() for name in names}
    found = [path for path in files_in(folder) if path.name.lower().endswith(SUFFIXES)]
    kept = [path for path in found if path.name.lower() not in held_out]
    if not kept:
        but = f" but {found[0].name}, which is held out for testing" if found else ""
        raise PictureError(
            f"{folder}: holds no pictures ({', '.join(SUFFIXES)}){but}: name a folder that does"
        )
    return sorted(kept)


def _cuttings(rng, paths: list[Path], count: int, size: int, source) -> list[np.ndarray]:
    """Random squares of random pictures, each picture once before any comes again."""
    cuttings, usable = [], list(paths)
    problem = ""
    while len(cuttings) < count:
        if not usable:
            raise PictureError(
                f"{source or 'scikit-image'}: none of {len(paths)} pictures can be used for "
                f"textures of {size} pixels; the last: {problem}"
            )
        chosen = rng.permutation(len(usable))[: count - len(cuttings)]
        bad = set()
        for k in chosen:
            try:
                cuttings.append(_cutting(rng, usable[k], size))
            except Exception as error:  # Pillow raises every kind for damaged files
                problem = f"{usable[k]}: {error}"
                logger.warning("not used: %s", problem)
                bad.add(k)
        usable = [path for k, path in enumerate(usable) if k not in bad]
    return cuttings


def _cutting(rng, path: Path, size: int) -> np.ndarray:
    """A square of 40 to 100 % of the picture's shorter side, perhaps mirrored, as (size, size).

    Of a small picture at least 70 %: what is enlarged looks unsharp.
    """
    with Image.open(path) as picture:
        if min(picture.size) < size // 2:
            width, height = picture.size
            raise ValueError(f"{width}x{height} is too small, {size // 2} pixels are needed")
        least = min(max(size / min(picture.size), 0.4), 0.7)
        # lets JPEG decode at half or a quarter of its size
        picture.draft("L", (round(size / least), round(size / least)))
        grey = _grey(picture)
    side = rng.uniform(least, 1.0) * min(grey.size)
    left, top = (rng.uniform(0, length - side) for length in grey.size)
    box = (left, top, left + side, top + side)
    grey = grey.resize((size, size), Image.Resampling.LANCZOS, box, reducing_gap=3.0)
    values = np.asarray(grey, np.float32) / 255
    return values[:, ::-1] if rng.random() < 0.5 else values


def _grey(picture: Image.Image) -> Image.Image:
    """The picture in 8 bits of grey; Pillow's own conversion clips more than 8 bits to white."""
    if picture.mode == "F":
        raise ValueError("it holds fractions, whose range is not known: save it as 8 or 16 bits")
    if picture.mode.startswith("I"):
        values = np.asarray(picture)
        if values.min() < 0 or values.max() >= 2**16:
            raise ValueError("its values are not those of 8 or 16 bits")
        unused = max(int(values.max()).bit_length() - 8, 0)  # cameras keep 10 or 12 bits in 16
        return Image.fromarray((values >> unused).astype(np.uint8))
    return picture.convert("L")


def _stretched(values: np.ndarray, rng) -> np.ndarray:
    """Any values -> [0, 1], the darkest and the lightest percent clipped, contrast at random."""
    low, high = np.percentile(values, [1, 99])
    values = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
    contrast = rng.uniform(0.5, 1.0)
    return rng.uniform(0, 1 - contrast) + contrast * values


def clouds(rng, size: int) -> np.ndarray:
    """Noise whose amplitude falls with frequency, as that of natural pictures does."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * frequency ** -rng.uniform(1.0, 2.0)
    return _stretched(np.fft.irfft2(spectrum, (size, size)), rng)


def gratings(rng, size: int) -> np.ndarray:
    """Sums of one to three sinusoidal or square waves of any direction."""
    y, x = np.mgrid[:size, :size]
    values = np.zeros((size, size))
    for _ in range(rng.integers(1, 4)):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / np.exp(rng.uniform(np.log(6), np.log(max(size / 4, 6))))
        values += np.sin(wave * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    if rng.random() < 0.5:  # edges two pixels wide
        values = np.tanh(values * size / 64)
    return _stretched(values, rng)


def _drawing(rng, size: int, draw: Callable) -> np.ndarray:
    """What `draw(ImageDraw, side)` draws, at three times the size and then averaged."""
    canvas = Image.new("L", (3 * size, 3 * size), int(rng.integers(0, 256)))
    draw(ImageDraw.Draw(canvas), 3 * size)
    return np.asarray(canvas.resize((size, size), Image.Resampling.BOX), np.float32) / 255


def dead_leaves(rng, size: int) -> np.ndarray:
    """Discs that hide each other, many small and few large: the occlusions of natural pictures."""

    def draw(canvas, side):
        # radii with density r^-3 between 1/100 and 1/4 of the side
        low, high = (0.01 * side) ** -2, (0.25 * side) ** -2
        for _ in range(1500):
            r = (high + rng.random() * (low - high)) ** -0.5
            x, y = rng.uniform(-r, side + r, 2)
            canvas.ellipse([x - r, y - r, x + r, y + r], fill=int(rng.integers(0, 256)))

    return _drawing(rng, size, draw)


def polygons(rng, size: int) -> np.ndarray:
    """Random polygons and lines, flat and sharp."""

    def draw(canvas, side):
        for _ in range(rng.integers(10, 60)):
            centre = rng.uniform(0, side, 2)
            reach = side * np.exp(rng.uniform(np.log(0.03), np.log(0.3)))
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
            corners = centre + reach * np.stack([np.cos(angles), np.sin(angles)], -1)
            grey = int(rng.integers(0, 256))
            if rng.random() < 0.3:
                canvas.line([tuple(c) for c in corners[:2]], fill=grey, width=side // 60)
            else:
                canvas.polygon([tuple(c) for c in corners], fill=grey)

    return _drawing(rng, size, draw)


def marks(rng, size: int) -> np.ndarray:
    """Rows of small strokes, like a printed page."""

    def draw(canvas, side):
        paper, ink = (rng.uniform(170, 255), rng.uniform(0, 90))
        if rng.random() < 0.3:
            paper, ink = ink, paper
        canvas.rectangle([0, 0, side, side], fill=int(paper))
        letter = side * rng.uniform(0.02, 0.06)
        for top in np.arange(letter / 2, side, 1.7 * letter):
            x = letter / 2
            while x < side:
                if rng.random() < 0.15:  # between words
                    x += letter
                    continue
                for _ in range(rng.integers(2, 5)):
                    ends = rng.uniform(0, 1, (2, 2)) * [0.7 * letter, letter] + [x, top]
                    width = max(1, round(0.14 * letter))
                    canvas.line([tuple(end) for end in ends], fill=int(ink), width=width)
                x += 0.9 * letter

    return _drawing(rng, size, draw)


PROCEDURAL = {draw.__name__: draw for draw in (dead_leaves, clouds, gratings, polygons, marks)}
