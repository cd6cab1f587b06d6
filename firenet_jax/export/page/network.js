// Event tensors -> pictures: firenet.onnx in onnxruntime-web, on the GPU (WebGPU) or in wasm.

import { BINS, voxels } from "./events.js";

const CHANNELS = 16;

/**
 * Loads runtime and network once. gpu true: any GPU, also one that the processor stands in for,
 * which is slower than wasm; false: none.
 */
export async function load(gpu) {
  const adapter = gpu !== false && (await navigator.gpu?.requestAdapter().catch(() => null));
  if (adapter && (gpu || !(adapter.info ?? adapter).isFallbackAdapter)) {
    try {
      return await open("ort.webgpu.min.mjs", "webgpu");
    } catch (error) {
      console.warn("WebGPU does not take the network, wasm does:", error);
    }
  }
  return open("ort.wasm.min.mjs", "wasm");
}

async function open(file, provider) {
  const ort = await import(`./ort/${file}`);
  ort.env.wasm.wasmPaths = new URL("./ort/", import.meta.url).href;
  const session = await ort.InferenceSession.create(new URL("./firenet.onnx", import.meta.url).href, {
    executionProviders: [provider],
  });
  const zeros = (channels) => tensor(ort, new Float32Array(channels * 64), channels, 8, 8);
  // What a GPU cannot compute shows only when it runs.
  await session.run({ events: zeros(BINS), g1: zeros(CHANNELS), g2: zeros(CHANNELS) });
  // One after the other: the runtime cannot be entered while it waits for the GPU.
  let last = Promise.resolve();
  const run = (inputs, outputs) =>
    (last = last.catch(() => {}).then(() => session.run(inputs, outputs)));
  return { ort, run, provider };
}

const tensor = (ort, data, channels, height, width) =>
  new ort.Tensor("float32", data, [1, channels, height, width]);

/** Events and windows -> {picture Uint8Array (height, width), tensor, time} one after the other. */
export async function* reconstruct({ ort, run }, events, windows) {
  const { width, height, t } = events;
  const zeros = () =>
    tensor(ort, new Float32Array(CHANNELS * height * width), CHANNELS, height, width);
  let [g1, g2] = [zeros(), zeros()];
  for (const window of windows) {
    const votes = voxels(events, window);
    const input = tensor(ort, votes, BINS, height, width);
    const found = await run({ events: input, g1, g2 }, ["picture", "g1_next", "g2_next"]);
    [g1, g2] = [found.g1_next, found.g2_next];
    yield { picture: found.picture.data, tensor: votes, time: t[window[1] - 1] };
  }
}
