"""The newest picture and what is measured -> a page that a browser on this machine can open.

    /        the page
    /video   the pictures, as a motion JPEG: always the newest, so a slow browser skips some
    /figures what is measured, as JSON

Only for this machine: it listens on the loopback address, and answers no request that a page of
somebody else's sent here under another name, and shows no pictures in such a page.
"""

import contextlib
import io
import json
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
from PIL import Image

QUALITY = 85  # of the JPEGs
BOUNDARY = "picture"
AGAIN = 5  # seconds without a new picture

PAGE = """<!doctype html>
<meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>firenet live</title><link rel="icon" href="data:,">
<style>
 body { background: #111; color: #ccc; font: 16px system-ui; margin: 2em; }
 img { width: 100%; max-width: 80em; image-rendering: pixelated; background: #000; }
 dl { display: grid; grid-template-columns: repeat(auto-fit, minmax(11em, 1fr)); gap: 1em; }
 dt { color: #888; font-size: 80%; } dd { margin: 0; font-size: 140%; }
</style>
<h1>TITLE</h1>
<img src="/video" alt="events and reconstruction, side by side">
<dl id="figures"></dl>
<script>
const names = {events_per_second: "events a second", windows_per_second: "pictures a second",
  latency_ms: "latency, median, ms", latency_95_ms: "latency, 95 % below, ms",
  dropped_windows: "windows dropped", bad_events: "events left out"};
const title = document.title;
let before = null;
async function look() {
  try {
    const now = await (await fetch("/figures")).json(), at = performance.now();
    if (before) {
      const s = (at - before.at) / 1000;
      now.events_per_second = Math.round((now.events - before.events) / s);
      now.windows_per_second = ((now.windows - before.windows) / s).toFixed(1);
    }
    before = {...now, at};
    document.title = title;
    const list = document.getElementById("figures");
    list.replaceChildren(...Object.entries(names).map(([key, text]) => {
      const box = document.createElement("div"), dt = document.createElement("dt"),
        dd = document.createElement("dd");
      dt.textContent = text;
      dd.textContent = (now[key] ?? "-").toLocaleString();
      box.append(dt, dd);
      return box;
    }));
  } catch { document.title = "firenet live: ended"; }
  setTimeout(look, 500);
}
look();
</script>
"""


class Board:
    """Where the newest picture hangs; any thread may look at it."""

    def __init__(self):
        self.changed = threading.Condition()
        self.picture = np.zeros((1, 1, 3), np.uint8)  # until there is one
        self.number, self.jpeg, self.ended = 0, (-1, b""), False

    def hang(self, picture: np.ndarray) -> None:
        """(H, W, 3) uint8"""
        with self.changed:
            self.picture, self.number = picture, self.number + 1
            self.changed.notify_all()

    def end(self) -> None:
        with self.changed:
            self.ended = True
            self.changed.notify_all()

    def newest(self, seen: int) -> tuple[int, bytes] | None:
        """Waits for a picture after number `seen` -> (its number, it as JPEG); None: no more.

        After some seconds without one it is the same again: who has left is noticed by sending."""
        with self.changed:
            changed = self.changed.wait_for(lambda: self.number > seen or self.ended, AGAIN)
            if changed and self.number <= seen:
                return None
            number, picture, (kept, data) = self.number, self.picture, self.jpeg
        if kept != number:  # outside of the lock: whoever hangs up pictures does not wait for it
            buffer = io.BytesIO()
            Image.fromarray(picture).save(buffer, "jpeg", quality=QUALITY)
            data = buffer.getvalue()
            self.jpeg = number, data
        return number, data


def serve(board: Board, figures: Callable[[], dict], title: str, port: int) -> ThreadingHTTPServer:
    """Serves the page in threads of its own, until `shutdown()`; port 0: any that is free.

    Raises OSError where the port is taken.
    """

    class Handler(BaseHTTPRequestHandler):
        timeout = 30  # seconds, for a browser that says and takes nothing

        def do_GET(self):
            host = self.headers.get("Host", "").rsplit(":", 1)[0]  # no port: 80
            if host not in ("127.0.0.1", "localhost"):
                self.send_error(403)
            elif self.path == "/":
                self.answer("text/html; charset=utf-8", page)
            elif self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
                self.send_error(403)  # in a page of somebody else's
            elif self.path == "/figures":
                self.answer("application/json", json.dumps(figures()).encode())
            elif self.path == "/video":
                with contextlib.suppress(ConnectionError, TimeoutError):  # the browser went away
                    self.video()
            else:
                self.send_error(404)

        def answer(self, kind: str, data: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(data)

        def video(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            seen = 0
            while (found := board.newest(seen)) is not None:
                seen, data = found
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
                self.wfile.write(f"{head}\r\n\r\n".encode() + data + b"\r\n")

        def log_message(self, *_):
            pass

    escaped = title.replace("&", "&amp;").replace("<", "&lt;")
    page = PAGE.replace("TITLE", escaped).encode(errors="backslashreplace")

    class Server(ThreadingHTTPServer):
        def handle_error(self, request, client_address):
            if not isinstance(sys.exc_info()[1], ConnectionError):  # the browser went away
                super().handle_error(request, client_address)

    server = Server(("127.0.0.1", port), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
