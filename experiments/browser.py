"""The exported page in a browser: how many windows a second, and are its pictures ours?

    python experiments/browser.py RECORDING --runtime node_modules/onnxruntime-web      2 minutes

Needs Chromium, which runs without a window and without a GPU: WebAssembly, then WebGPU by
SwiftShader, which computes on the processor what a GPU would. That shows that the way over WebGPU
works, not how fast it is: it takes seconds for a window, so it sees a few windows of the sensor's
middle. Where the browser has no such adapter, the row says so. A window's time is that of voxels,
network and picture, without reading the file and without drawing; the first windows, which compile,
are left out.
Writes results/browser.json, with the largest difference of pictures from those of
`firenet reconstruct`, in grey levels.
"""

import argparse
import contextlib
import http.server
import io
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from functools import partial
from pathlib import Path

import numpy as np
from harness import RESULTS, save
from PIL import Image

from firenet_jax import cli
from firenet_jax.commands.export import Export, run
from firenet_jax.events import concatenate
from firenet_jax.readers import open_recording

BROWSERS = "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"
QUIET = (
    "--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
WITHOUT_GPU = ("--disable-gpu",)
BY_SOFTWARE = (
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan",
)  # fmt: skip
WARM = 2  # windows before the clock
FEW, MIDDLE = 8, (32, 24)  # windows by SwiftShader, of so many pixels in width and height

TEST_PAGE = """<!doctype html><script type="module">
import { readRecording, windowsOf } from "./events.js";
import { load, reconstruct } from "./network.js";
const send = (name, body) => fetch(`/${name}`, { method: "POST", body });
try {
  const bytes = new Uint8Array(await (await fetch("NAME")).arrayBuffer());
  const events = await readRecording(bytes, "NAME");
  const network = await load(GPU);
  const windows = windowsOf(events).slice(0, COUNT), pictures = [];
  let began = 0;
  for await (const { picture } of reconstruct(network, events, windows))
    if (pictures.push(picture) === WARM) began = performance.now();
  const seconds = (performance.now() - began) / 1000;
  await send("pictures", new Blob(pictures));
  const { provider } = network;
  await send("found", JSON.stringify({ provider, windows: windows.length, seconds }));
} catch (error) { await send("failed", String(error.stack)); }
await send("done", "");
</script>"""


def find_browser() -> str | None:
    return next(filter(None, map(shutil.which, BROWSERS)), None)


class Server(http.server.SimpleHTTPRequestHandler):
    """Files of a folder; keeps what is posted."""

    def __init__(self, *arguments, posted, done, **options):
        self.posted, self.done = posted, done
        super().__init__(*arguments, **options)

    def do_POST(self):
        self.posted[self.path[1:]] = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()
        if self.path == "/done":
            self.done.set()

    def log_message(self, *_):
        pass


def in_browser(folder: Path, browser: str, options: tuple[str, ...] = WITHOUT_GPU):
    """Shows test.html of the folder -> what it posts by name, once it has posted "done"."""
    posted: dict[str, bytes] = {}
    done = threading.Event()
    handler = partial(Server, directory=folder, posted=posted, done=done)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        http.server.ThreadingHTTPServer(("localhost", 0), handler) as server,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://localhost:{server.server_port}/test.html"
        # A port for debugging keeps the headless shell open after the page has loaded.
        more = ["--remote-debugging-port=0", f"--user-data-dir={profile}"]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        command = [browser, *QUIET, *options, *more, url]
        process = subprocess.Popen(command, start_new_session=True, **silent)
        try:
            assert done.wait(600), f"the page sent {list(posted)} and no more"
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # it has children
            process.wait()
            server.shutdown()
    return posted


def pictures_of_python(recording: Path, folder: Path) -> np.ndarray:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        line = ["reconstruct", str(recording), "-o", str(folder), "--range", "fixed"]
        assert cli.main([*line, "--warm-up", "0"]) == 0
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))])


def as_npz(recording: Path, folder: Path, size: tuple[int, int] | None = None) -> Path:
    """A recording -> one that the page reads; size: of its middle."""
    source = open_recording(recording)
    width, height = size or (source.width, source.height)
    left, top = (source.width - width) // 2, (source.height - height) // 2
    events = concatenate(list(source.events()))
    x, y = events.x - left, events.y - top
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    path = folder / f"{width}x{height}.npz"
    columns = {"t": events.t, "x": x, "y": y, "p": events.p}
    columns = {name: column[inside] for name, column in columns.items()}
    np.savez_compressed(path, **columns, width=width, height=height)
    return path


def measure(browser: str, page: Path, recording: Path, gpu: bool, windows: int) -> dict | str:
    """The page shows the recording -> speed, and pictures against Python's."""
    expected = pictures_of_python(recording, recording.with_suffix(""))
    shutil.copyfile(recording, page / recording.name)
    changes = {"NAME": recording.name, "WARM": str(WARM), "COUNT": str(windows)}
    script = TEST_PAGE.replace("GPU", str(gpu).lower())
    for old, new in changes.items():
        script = script.replace(old, new)
    (page / "test.html").write_text(script)
    posted = in_browser(page, browser, BY_SOFTWARE if gpu else WITHOUT_GPU)
    assert "failed" not in posted, posted["failed"].decode()
    found = json.loads(posted["found"])
    if gpu and found["provider"] == "wasm":
        return "the browser has no adapter"
    pictures = np.frombuffer(posted["pictures"], np.uint8).reshape(-1, *expected.shape[1:])
    levels = np.abs(pictures.astype(int) - expected[: len(pictures)])
    return {
        "size": recording.stem,
        "windows": found["windows"],
        "windows_per_second": (found["windows"] - WARM) / found["seconds"],
        "most_grey_levels_apart": int(levels.max()),
        "share_of_pixels_apart": float((levels > 0).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--runtime", type=Path, required=True)
    parser.add_argument("--windows", type=int, default=40)
    parser.add_argument("--only", choices=["wasm", "webgpu"])
    arguments = parser.parse_args()
    browser = find_browser()
    if browser is None:
        parser.exit(message=f"needs one of {', '.join(BROWSERS)}\n")
    kept = RESULTS / "browser.json"
    rows = json.loads(kept.read_text())["rows"] if arguments.only and kept.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder, "page")
        recordings = {
            "wasm": (as_npz(arguments.recording, Path(folder)), arguments.windows),
            "webgpu": (as_npz(arguments.recording, Path(folder), MIDDLE), FEW),
        }
        sample = recordings["webgpu"][0]
        run(Export(web=page, runtime=arguments.runtime, sample=sample))
        for provider, (recording, windows) in recordings.items():
            if arguments.only in (None, provider):
                rows[provider] = measure(browser, page, recording, provider == "webgpu", windows)
                print(f"{provider}: {rows[provider]}", flush=True)
    version = subprocess.run([browser, "--version"], capture_output=True, text=True).stdout.strip()
    package = json.loads((arguments.runtime / "package.json").read_text())
    save("browser", {"recording": arguments.recording.name, "browser": version,
                     "onnxruntime-web": package["version"], "rows": rows})  # fmt: skip


if __name__ == "__main__":
    main()
