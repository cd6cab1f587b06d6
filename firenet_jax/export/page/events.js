// A dropped file -> events -> windows -> event tensors; as the Python package does it.
//
// Events are columns {t, x, y, p, width, height}: t Float64Array of whole microseconds, x and y
// Uint16Array, p Uint8Array (1 is ON). Event tensors are Float32Array (5, height, width).

export const BINS = 5;
const NAMES = {
  t: ["t", "ts", "time", "times", "timestamp", "timestamps"], x: ["x", "xs"], y: ["y", "ys"],
  p: ["p", "ps", "pol", "polarity", "on"],
};
const UNITS = { // microseconds in a unit: its names
  1e6: ["s", "sec", "secs", "second", "seconds"], 1e3: ["ms", "msec", "millisecond", "milliseconds"],
  1: ["us", "usec", "µs", "μs", "microsecond", "microseconds"],
  1e-3: ["ns", "nsec", "nanosecond", "nanoseconds"],
};
const TEXT = 500e6; // bytes: a page's string has at most 2^29 characters
const keyOf = (names, name) => Object.keys(names).find((key) => names[key].includes(name)) ?? "";
const column = (name) => keyOf(NAMES, name);

// ---- files

/** Uint8Array and its file's name -> events. Throws an Error of one sentence. */
export async function readRecording(bytes, name) {
  try {
    return await read(bytes, name);
  } catch (error) {
    if (error instanceof RangeError) throw new Error(`${name}: is damaged, cut short or too large`);
    throw error;
  }
}

async function read(bytes, name) {
  const lower = name.toLowerCase();
  if (lower.endsWith(".gz"))
    return read(await inflated(bytes, "gzip", name), name.slice(0, -3));
  if (lower.endsWith(".npz")) return npz(bytes, name);
  if (lower.endsWith(".npy")) return fromArray(npy(bytes, name), name);
  if (lower.endsWith(".zip")) {
    const members = zipMembers(bytes, name).filter((m) => !m.name.startsWith("__MACOSX/"));
    const texts = members.filter((m) => /\.(txt|csv)$/i.test(m.name));
    const chosen = texts.find((m) => m.name.endsWith("events.txt")) ?? texts[0];
    if (!chosen) throw new Error(`${name}: no .txt or .csv is in this zip`);
    if (texts.length > 1 && !chosen.name.endsWith("events.txt")) {
      const some = texts.slice(0, 4).map((m) => m.name).join(", ");
      throw new Error(`${name}: holds ${texts.length} text files (${some}) where one is expected`);
    }
    return fromText(await unzipped(bytes, chosen, name), `${name}, ${chosen.name}`);
  }
  if (/\.(txt|csv)$/.test(lower)) return fromText(bytes, name);
  throw new Error(`${name}: expected .txt, .csv, .zip, .gz, .npz or .npy`);
}

async function inflated(bytes, format, name) {
  try {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch (error) {
    throw new Error(`${name}: is damaged, cut short or too large (${error.message})`);
  }
}

/** Zip -> [{name, method, start, size}], from the list at its end (APPNOTE.TXT 4.3). */
function zipMembers(bytes, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let end = bytes.length - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw new Error(`${name}: is damaged or cut short, its list of files is missing`);
  const members = [];
  // What precedes the first file, as in archives that unpack themselves, is in none of the places.
  const ahead = end - view.getUint32(end + 12, true) - view.getUint32(end + 16, true);
  let at = ahead + view.getUint32(end + 16, true);
  for (let n = view.getUint16(end + 10, true); n > 0; n--) {
    const [named, extra, comment] = [28, 30, 32].map((k) => view.getUint16(at + k, true));
    const local = ahead + view.getUint32(at + 42, true);
    members.push({
      name: new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + named)),
      method: view.getUint16(at + 10, true),
      size: view.getUint32(at + 20, true),
      start: local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true),
    });
    at += 46 + named + extra + comment;
  }
  return members;
}

async function unzipped(bytes, member, name) {
  if (member.method !== 0 && member.method !== 8)
    throw new Error(`${name}: ${member.name} is packed by method ${member.method}: pack it anew`);
  const packed = bytes.subarray(member.start, member.start + member.size);
  return member.method === 0 ? packed : inflated(packed, "deflate-raw", name);
}

/** A .npz -> events: of columns, the first of the names that one may have, or of one array. */
async function npz(bytes, name) {
  const members = zipMembers(bytes, name);
  const array = async (member) => npy(await unzipped(bytes, member, name), `${name}, ${member.name}`);
  const columns = {};
  for (const [key, names] of Object.entries({ ...NAMES, width: ["width"], height: ["height"] })) {
    const found = names.map((n) => members.find((m) => m.name === `${n}.npy`)).find((m) => m);
    if (found) columns[key] = await array(found);
  }
  if (!columns.t && !columns.x && members.length === 1) return fromArray(await array(members[0]), name);
  return fromColumns(columns, name);
}

const KINDS = {
  f4: Float32Array, f8: Float64Array, i1: Int8Array, i2: Int16Array, i4: Int32Array,
  i8: BigInt64Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, u8: BigUint64Array,
  b1: Uint8Array,
};

/** A .npy of numbers -> {data, shape, whole, fortran}; of a structured array, such by name. */
function npy(bytes, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const long = bytes[6] > 1;
  const start = (long ? 12 : 10) + (long ? view.getUint32(8, true) : view.getUint16(8, true));
  const head = new TextDecoder().decode(bytes.subarray(0, start));
  const type = /'descr': '[<|]([fiub][1248])'/.exec(head)?.[1];
  const fields = [...head.matchAll(/\('([^']*)', '[<|]([fiubV])(\d+)'\)/g)];
  const strange = [...head.matchAll(/\('([^']*)', [^)]*/g)].length !== fields.length;
  if (/'descr': \[/.test(head) && strange)
    throw new Error(`${name}: has a field that this page does not read, the package does`);
  const shape = /'shape': \(([^)]*)\)/.exec(head)?.[1].split(",").filter((s) => s.trim()).map(Number);
  const row = fields.reduce((sum, [, , , size]) => sum + Number(size), 0) || Number(type?.[1]);
  if (shape && bytes.length < start + row * shape.reduce((a, b) => a * b, 1))
    throw new Error(`${name}: is cut short`);
  if (shape?.length === 1 && fields.length) return structured(bytes.slice(start), fields, row, shape[0]);
  if (!KINDS[type] || !shape) throw new Error(`${name}: expected an array of numbers`);
  const data = numbers(bytes.slice(start), type);
  return { data, shape, whole: type[0] !== "f", fortran: /'fortran_order': True/.test(head) };
}

function numbers(bytes, type) {
  const size = Number(type[1]);
  const data = new KINDS[type](bytes.buffer, 0, Math.floor(bytes.length / size));
  return size === 8 && type !== "f8" ? Float64Array.from(data, Number) : data;
}

/** Rows of fields -> {name: {data, whole}}, of fields of other kinds none. */
function structured(bytes, fields, row, rows) {
  const found = {};
  let offset = 0;
  for (const [, name, kind, size] of fields) {
    if (KINDS[kind + size]) {
      const own = new Uint8Array(rows * size);
      for (let n = 0; n < rows; n++)
        for (let k = 0; k < size; k++) own[n * size + k] = bytes[n * row + offset + k];
      found[name] = { data: numbers(own, kind + size), whole: kind !== "f" };
    }
    offset += Number(size);
  }
  return found;
}

function fromArray(array, name) {
  if (!array.data) { // structured
    const of = (key) => array[NAMES[key].find((n) => array[n])];
    return fromColumns({ t: of("t"), x: of("x"), y: of("y"), p: of("p") }, name);
  }
  const { data, shape, whole, fortran } = array;
  if (shape.length !== 2 || shape[1] !== 4) throw new Error(`${name}: expected rows of t, x, y, p`);
  const [step, next] = fortran ? [1, shape[0]] : [4, 1];
  const of = (k) => ({ data: Float64Array.from({ length: shape[0] }, (_, n) => data[step * n + next * k]), whole });
  return fromColumns({ t: of(0), x: of(1), y: of(2), p: of(3) }, name);
}

function fromColumns(columns, name) {
  for (const key of "txyp")
    if (!columns[key]) throw new Error(`${name}: expected arrays t, x, y and p; ${key} is missing`);
  const scale = columns.t.whole ? 1 : 1e6; // microseconds, or seconds
  const [width, height] = ["width", "height"].map((side) => columns[side] && Number(columns[side].data[0]));
  const t = Float64Array.from(columns.t.data, (time) => Math.round(time * scale));
  return checked({ t, x: columns.x.data, y: columns.y.data, p: columns.p.data, width, height }, name);
}

const words = (line) => line.trim().split(/\s*,\s*|\s+/);

/** A line of names -> [places of t, x, y and p, number of columns, microseconds in the unit of the
 * times or 0]; the unit as in `time [ns]` or `t_us`, of several such the finest. */
function namesOf(line) {
  const bare = line.slice(0, 1000).toLowerCase().replace(/^[#%\s]+|"/g, "");
  const named = words(bare.replace(/\s*[\[(]\s*([^\s,\[\]()]*)[^\[\]()]*[\])]/g, "|$1"));
  const keys = named.map((word) => column(word.split("|")[0]));
  const unit = (word) => Number(keyOf(UNITS, word.split(/[|_]/)[1]));
  if (!keys.includes("t")) {
    const times = named.filter((word) => column(word.split("_")[0]) === "t" && unit(word));
    const finest = times.sort((a, b) => unit(a) - unit(b))[0];
    if (finest) keys[named.indexOf(finest)] = "t";
  }
  const order = [..."txyp"].map((key) => keys.indexOf(key));
  return [order, named.length, unit(named[order[0]] ?? "")];
}

/** Lines `t x y p`, perhaps after a line `width height` or one of names. Times with a decimal point
 * or an exponent are seconds, where no name tells a unit. */
function fromText(bytes, name) {
  if (bytes.length > TEXT)
    throw new Error(`${name}: holds more than ${TEXT / 1e6} MB of text, which a browser cannot: cut it`);
  const lines = new TextDecoder().decode(bytes).split("\n");
  const number = (word) => { // False and True are 0 and 1
    const value = /^[+-]?0[box]/i.test(word) ? NaN : Number(word || NaN);
    return Number.isNaN(value) && /^(false|true)$/i.test(word) ? Number(word.length === 4) : value;
  };
  let [first, width, height, order, columns, unit, geometry] = [0, undefined, undefined, [0, 1, 2, 3], 4, 0];
  for (; first < lines.length; first++) {
    const found = words(lines[first]);
    const named = namesOf(lines[first]);
    if (found.length === 2 && found.every((word) => /^\d+$/.test(word))) [width, height] = found.map(Number);
    else if ((geometry = /^%geometry:(\d+),(\d+)/.exec(lines[first].trim()))) { // Metavision's own order
      [width, height, order] = [Number(geometry[1]), Number(geometry[2]), [3, 0, 1, 2]];
    } else if (!named[0].includes(-1)) [order, columns, unit] = named;
    else if (/^[#%]|^$/.test(found[0])) continue;
    else if (found.length >= 4 && !Number.isNaN(number(found[0]))) break;
    else throw new Error(`${name}, line ${first + 1}: expected t x y p, found ${found.slice(0, 6)}`);
  }
  const seconds = lines.slice(first, first + 1000).some((line) => /[.e]/i.test(words(line)[order[0]] ?? ""));
  unit ||= seconds ? 1e6 : 1;
  const rows = lines.length - first;
  const made = { t: new Float64Array(rows), x: new Float64Array(rows), y: new Float64Array(rows), p: new Float64Array(rows) };
  let count = 0;
  for (let n = first; n < lines.length; n++) {
    const found = words(lines[n]);
    if (!found[0]) continue;
    const [t, x, y, p] = order.map((k) => number(found[k]));
    if (found.length !== columns || Number.isNaN(t + x + y + p))
      throw new Error(`${name}, line ${n + 1}: expected t x y p, found ${found.slice(0, 6)}`);
    made.t[count] = unit < 1 ? Math.floor(t / 1000) : Math.round(t * unit);
    [made.x[count], made.y[count], made.p[count++]] = [x, y, p];
  }
  for (const key of "txyp") made[key] = made[key].subarray(0, count);
  return checked({ ...made, width, height }, name);
}

function checked({ t, x, y, p, width, height }, name) {
  const count = t.length;
  if (!count || [x, y, p].some((c) => c.length !== count))
    throw new Error(`${name}: holds no events, or columns of different lengths`);
  for (const side of [width, height])
    if (side !== undefined && !(side >= 1 && side <= 32768 && side % 1 === 0))
      throw new Error(`${name}: a side of its sensor is ${side}, expected whole pixels`);
  let [right, bottom] = [0, 0];
  for (let n = 0; n < count; n++) {
    if (!(Math.abs(t[n]) < 2 ** 53))
      throw new Error(`${name}, event ${n}: its time is ${t[n]}, expected seconds or whole microseconds`);
    if (n && t[n] < t[n - 1]) throw new Error(`${name}, event ${n}: its time goes back`);
    if (!(x[n] >= 0 && y[n] >= 0 && x[n] < 32768 && y[n] < 32768))
      throw new Error(`${name}, event ${n}: outside of any sensor`);
    if (x[n] % 1 || y[n] % 1 || ![-1, 0, 1].includes(Number(p[n])))
      throw new Error(`${name}, event ${n}: expected t x y p, found ${[t[n], x[n], y[n], p[n]]}`);
    right = Math.max(right, x[n]);
    bottom = Math.max(bottom, y[n]);
  }
  [width, height] = [width ?? right + 1, height ?? bottom + 1];
  if (right >= width || bottom >= height)
    throw new Error(`${name}: an event lies outside of the sensor of ${width}x${height}`);
  return {
    t, x: Uint16Array.from(x), y: Uint16Array.from(y), p: Uint8Array.from(p, (v) => (v > 0 ? 1 : 0)),
    width, height,
  };
}

// ---- windows

/** As Python rounds. */
function halfToEven(value) {
  const near = Math.round(value);
  return near - value === 0.5 && near % 2 ? near - 1 : near;
}

/** Events -> [start, stop) of each window: 0.35 events per pixel, at most 40 ms or, of a short
 * recording, a twentieth of it. `count` and `longest` (microseconds) set others. */
export function windowsOf({ t, width, height }, count, longest) {
  const span = t[t.length - 1] - t[0];
  count ??= Math.max(1, halfToEven(0.35 * width * height));
  longest ??= span >= 800_000 ? 40_000 : Math.max(Math.floor(span / 20), 1);
  const windows = [];
  for (let start = 0, stop = 0; start < t.length; start = stop) {
    const most = Math.min(start + count, t.length);
    while (stop < most && t[stop] < t[start] + longest) stop++;
    windows.push([start, stop]);
  }
  return windows;
}

/** Eq. 1 of the paper: each event votes into the two bins near its time. */
export function voxels({ t, x, y, p, width, height }, [start, stop]) {
  const plane = width * height;
  const tensor = new Float32Array(BINS * plane);
  const scale = (BINS - 1) / Math.max(t[stop - 1] - t[start], 1);
  for (let n = start; n < stop; n++) {
    const time = (t[n] - t[start]) * scale;
    const bin = Math.floor(time);
    const place = bin * plane + y[n] * width + x[n];
    const sign = p[n] ? 1 : -1;
    tensor[place] += sign * (bin + 1 - time);
    if (bin + 1 < BINS) tensor[place + plane] += sign * (time - bin);
  }
  return tensor;
}
