// A dropped file, or the sample -> two canvases: its events, and the video.

import { readRecording, windowsOf, BINS } from "./events.js";
import { load, reconstruct } from "./network.js";

const element = (id) => document.getElementById(id);
const say = (text) => (element("status").textContent = text);
const network = load();
let playing = 0; // the number of the recording that plays; others end

function draw(canvas, width, height, colour) {
  Object.assign(canvas, { width, height });
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer); // 0xAABBGGRR
  for (let n = 0; n < pixels.length; n++) pixels[n] = colour(n);
  canvas.getContext("2d").putImageData(image, 0, 0);
}

async function play(name, bytes) {
  const mine = ++playing;
  element("error").textContent = "";
  try {
    say(`Reading ${name}.`);
    const events = await readRecording(await bytes(), name);
    const windows = windowsOf(events);
    const runtime = await network;
    const { width, height, t } = events;
    const [plane, began] = [width * height, performance.now()];
    let done = 0;
    for await (const { picture, tensor, time } of reconstruct(runtime, events, windows)) {
      if (mine !== playing) return;
      draw(element("picture"), width, height, (n) => 0xff000000 | (picture[n] * 0x010101));
      draw(element("events"), width, height, (n) => {
        let sum = 0;
        for (let bin = 0; bin < BINS; bin++) sum += tensor[bin * plane + n];
        return sum > 0.5 ? 0xffff0000 : sum < -0.5 ? 0xff0000ff : 0xffffffff;
      });
      const rate = (1000 * ++done) / (performance.now() - began);
      say(`${name}: ${width}x${height}, ${t.length} events, picture ${done} of ${windows.length}, ` +
        `${rate.toFixed(1)} a second (${runtime.provider})`);
      // In real time where this machine keeps up; a picture is shown before the next is computed.
      const wait = (time - t[0]) / 1000 - (performance.now() - began);
      await new Promise((go) => setTimeout(go, Math.max(wait, 0)));
    }
  } catch (error) {
    if (mine === playing) element("error").textContent = String(error.message ?? error);
  }
}

const playFile = (file) =>
  play(file.name, async () => new Uint8Array(await file.arrayBuffer()));
const playSample = () =>
  play("sample.npz", async () => new Uint8Array(await (await fetch("sample.npz")).arrayBuffer()));

element("file").addEventListener("change", (event) => event.target.files[0] && playFile(event.target.files[0]));
element("sample").addEventListener("click", playSample);
element("stop").addEventListener("click", () => (playing++, say("Stopped.")));
for (const [name, over] of [["dragover", true], ["dragleave", false], ["drop", false]])
  document.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.toggle("over", over);
    if (name === "drop" && event.dataTransfer.files[0]) playFile(event.dataTransfer.files[0]);
  });
playSample();
