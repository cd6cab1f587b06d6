"""Pictures -> a window on the screen, as they come; by Tk, which most Pythons bring along.

The window belongs to the thread that opened it: all calls must come from there. Pictures that come
faster than a screen shows them are passed over, and nothing waits for the window.
"""

import contextlib
import time

import numpy as np

from firenet_jax.errors import OutputError

MIN_INTERVAL = 1 / 60  # seconds between two pictures at least
MIN_WIDTH = 480  # pixels of the window's width: smaller pictures are enlarged


class Screen:
    """A window. The work goes on when the user closes it.

    Raises OutputError where there is no display, or a Python without Tk.
    """

    def __init__(self):
        try:
            import tkinter
        except ImportError as error:
            raise OutputError(
                "--show: this Python has no Tk (tkinter) for a window: leave it out, or install "
                "python3-tk"
            ) from error
        try:
            self.window = tkinter.Tk()
        except tkinter.TclError as error:
            raise OutputError(
                f"--show: there is no display for a window ({error}): leave --show out and look at "
                "the output"
            ) from error
        self.label, self.image, self.tk = tkinter.Label(self.window), None, tkinter
        self.label.pack()
        self.last = -MIN_INTERVAL
        self.window.protocol("WM_DELETE_WINDOW", self.close)

    def show(self, picture: np.ndarray, title: str) -> None:
        """A picture (H, W) or (H, W, 3) uint8, or an image (H, W) float32, black at 0 and white at
        1. Returns at once, also where the window is closed."""
        if self.window is None or time.monotonic() - self.last < MIN_INTERVAL:
            return
        if picture.dtype != np.uint8:  # of an .h5, which holds images and no pictures
            picture = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
        height, width = picture.shape[:2]
        header = f"P{5 if picture.ndim == 2 else 6} {width} {height} 255\n".encode()
        with contextlib.suppress(self.tk.TclError):  # closed meanwhile
            image = self.tk.PhotoImage(master=self.window, data=header + picture.tobytes())
            self.image = image.zoom(-(-MIN_WIDTH // width)) if width < MIN_WIDTH else image
            self.label.configure(image=self.image)
            self.window.title(title)
            self.window.update()
        self.last = time.monotonic()

    def close(self) -> None:
        if self.window is not None:
            window, self.window = self.window, None
            with contextlib.suppress(self.tk.TclError):
                window.destroy()


def check_screen() -> None:
    """Raises OutputError where no window can be opened."""
    Screen().close()
