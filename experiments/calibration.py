"""Can a camera be calibrated by images at given times? A simulated checkerboard, against the truth.

A checkerboard of 8x6 inner corners moves before a camera of known intrinsics (240x180, no
distortion); its events become images at 8 per second; OpenCV finds the corners and calibrates.
Should find the focal length within 0.5 % and the principal point within 1 pixel, of images; of the
renderings themselves, what the corners and the views allow at best.

    python experiments/calibration.py            about 2 minutes; pip install opencv-python-headless
"""

import argparse

import cv2
import jax
import numpy as np
from harness import save

import firenet_jax as fj
from firenet_jax.events import Recording, concatenate
from firenet_jax.instants import grid
from firenet_jax.reconstruction import images_at
from firenet_jax.simulation.sensor import SensorSettings, event_list, random_sensor

HEIGHT, WIDTH = 180, 240
FOCAL, CENTRE = 210.0, (118.3, 92.1)  # pixels
CORNERS, SQUARE = (8, 6), 0.04  # inner ones, across and down; metres
EVERY = 8000  # microseconds between renderings
RATE = 8.0  # images per second
FINER = 2  # rays a pixel, down and across


def pose(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """(rotation (3, 3), translation (3,)) from board to camera: it swings about all axes.

    Close and tilted by up to 38 degrees, as calibration guides advise. Views that are nearly
    parallel hardly tell focal length from distance: of a board a fifth farther away and tilted by
    up to 27 degrees, the renderings themselves gave an error of half a percent."""
    turn = 2 * np.pi * seconds
    angles = np.array([
        0.6 * np.sin(0.31 * turn), 0.66 * np.sin(0.23 * turn + 1.0), 0.25 * np.sin(0.17 * turn),
    ])  # fmt: skip
    rotation = cv2.Rodrigues(angles)[0]
    middle = np.array([(CORNERS[0] - 1) / 2, (CORNERS[1] - 1) / 2, 0.0]) * SQUARE
    place = np.array([
        0.05 * np.sin(0.37 * turn + 0.5),
        0.03 * np.sin(0.29 * turn),
        0.46 + 0.05 * np.sin(0.19 * turn),
    ])  # fmt: skip
    return rotation, place - rotation @ middle


def rendering(seconds: float) -> np.ndarray:
    """(H, W) float32: the mean of several rays a pixel, pixel centres at whole numbers."""
    rotation, translation = pose(seconds)
    inside = (np.arange(FINER) + 0.5) / FINER - 0.5
    x = (np.arange(WIDTH)[:, None] + inside).ravel()
    y = (np.arange(HEIGHT)[:, None] + inside).ravel()
    rays = np.stack(np.meshgrid((x - CENTRE[0]) / FOCAL, (y - CENTRE[1]) / FOCAL), -1)
    to_board = np.linalg.inv(np.stack([rotation[:, 0], rotation[:, 1], translation], 1))
    points = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ to_board.T
    u, v = (points[..., i] / points[..., 2] / SQUARE for i in (0, 1))
    board = (u > -1) & (u < CORNERS[0]) & (v > -1) & (v < CORNERS[1])
    sheet = (u > -1.6) & (u < CORNERS[0] + 0.6) & (v > -1.6) & (v < CORNERS[1] + 0.6)
    black = (np.floor(u) + np.floor(v)) % 2 == 0
    image = np.where(board & black, 0.12, np.where(sheet, 0.8, 0.4))
    image = image.reshape(HEIGHT, FINER, WIDTH, FINER).mean((1, 3))
    return cv2.GaussianBlur(image, (0, 0), 0.6).astype(np.float32)


def recording(seconds: float) -> Recording:
    times = range(0, round(1e6 * seconds), EVERY)
    sensor = random_sensor(
        jax.random.key(1), height=HEIGHT, width=WIDTH, settings=SensorSettings(mismatch=0.02)
    )
    events = concatenate(list(event_list(sensor, ((t, rendering(t / 1e6)) for t in times))))
    return Recording("checkerboard", "memory", HEIGHT, WIDTH, lambda: iter([events]), len(events))


def corners(image: np.ndarray) -> np.ndarray | None:
    """(N, 1, 2) float32, to parts of a pixel, or None where not all are found."""
    low, high = np.percentile(image, (1, 99))
    picture = np.rint(255 * np.clip((image - low) / max(high - low, 1e-3), 0, 1)).astype(np.uint8)
    large = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    found, places = cv2.findChessboardCornersSB(large, CORNERS, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    places = (places.reshape(-1, 1, 2) - 0.5) / 2  # centres of pixels of twice the size
    return places.astype(np.float32)


def in_order(places: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """(points of the board, places, farthest from the truth in pixels): a board may be found upside
    down, which its pattern allows; that is told apart by the truth, and nothing else of it used."""
    board = np.zeros((CORNERS[0] * CORNERS[1], 3), np.float32)
    board[:, :2] = SQUARE * np.mgrid[: CORNERS[0], : CORNERS[1]].T.reshape(-1, 2)
    rotation, translation = pose(seconds)
    seen = board @ rotation.T + translation
    truth = FOCAL * seen[:, :2] / seen[:, 2:] + np.array(CENTRE)
    turned = [places, places[::-1]]
    distances = [np.linalg.norm(p[:, 0] - truth, axis=1) for p in turned]
    best = int(np.argmin([d.mean() for d in distances]))
    return board, np.ascontiguousarray(turned[best]), distances[best]


def calibrated(views: list[tuple[float, np.ndarray]]) -> dict:
    """(seconds, image) of each view -> what is found of them."""
    boards, seen, errors = [], [], []
    for seconds, image in views:
        places = corners(image)
        if places is not None:
            board, places, error = in_order(places, seconds)
            boards.append(board)
            seen.append(places)
            errors.append(error)
    if len(seen) < 5:
        return {"views": len(views), "with_corners": len(seen)}
    none = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    rms, matrix, *_ = cv2.calibrateCamera(boards, seen, (WIDTH, HEIGHT), None, None, flags=none)
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    return {
        "views": len(views),
        "with_corners": len(seen),
        "corner_error_px": float(np.median(np.concatenate(errors))),
        "reprojection_px": float(rms),
        "focal": focal.tolist(),
        "focal_error_percent": float(100 * np.abs(focal / FOCAL - 1).max()),
        "centre": [float(matrix[0, 2]), float(matrix[1, 2])],
        "centre_error_px": float(np.hypot(matrix[0, 2] - CENTRE[0], matrix[1, 2] - CENTRE[1])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--weights", help="FireNet's, instead of the built-in ones")
    options = parser.parse_args()
    board = recording(options.seconds)
    first = int(next(board.events()).t[0])
    found = images_at(fj.load_weights(options.weights), board, grid(first, RATE))
    views = [(t / 1e6, image) for times, images in found for t, image in zip(times, images)]  # noqa: B905
    views = [(seconds, image) for seconds, image in views if seconds > 0.3]  # not the beginning
    results = {
        "truth": {"focal": FOCAL, "centre": CENTRE},
        "events": board.count,
        "images": calibrated(views),
        "renderings": calibrated([(seconds, rendering(seconds)) for seconds, _ in views]),
    }
    for name in ("images", "renderings"):
        print(name, *(f"{key} {value}" for key, value in results[name].items()), sep="\n  ")
    save("calibration", results)


if __name__ == "__main__":
    main()
