/** Reads gradient stacks: OpenEXR files of scan lines, of one part or several, uncompressed or ZIP, half or float. */

const COMPRESSIONS = ["none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB", "HTJ2K"];
const LINES = {none: 1, ZIPS: 1, ZIP: 16};
const BYTES = [4, 2, 4];  // of unsigned integers, halves, floats
const TILED = 0x200, DEEP = 0x800, PARTS = 0x1000;

const RGB = ["R", "G", "B"];
const LAYERS = {
  primal: RGB, direct: RGB, dx: RGB, dy: RGB, albedo: RGB, normal: ["X", "Y", "Z"], depth: ["Z"],
  primal_var: RGB, dx_var: RGB, dy_var: RGB, caustic: RGB, caustic_var: RGB,
};

/** {width, height, layers: {name: Float32Array, channel by channel}}, named as in docs/use/gradient-stack.md. */
export async function readStack(buffer) {
  const {width, height, channels} = await readChannels(buffer);
  const layers = {};
  for (const [name, letters] of Object.entries(LAYERS)) {
    let planes = letters.map(letter => channels.get(`${name}.${letter}`));
    // The root is the noisy image, unless the file is a result, which keeps that as a layer of its own.
    if (name === "primal" && planes.includes(undefined)) planes = letters.map(letter => channels.get(letter));
    if (planes.includes(undefined)) continue;
    layers[name] = new Float32Array(letters.length * width * height);
    planes.forEach((plane, i) => layers[name].set(plane, i * width * height));
  }
  return {width, height, layers};
}

async function readChannels(buffer) {
  const file = new Reader(buffer);
  if (buffer.byteLength < 8 || file.int() !== 20000630) throw new Error("it is not an OpenEXR file");
  const flags = file.int();
  if (flags & DEEP) throw new Error("it holds deep images, which this page does not read");
  if (flags & TILED) throw new Error("it is tiled; this page reads scan lines only");
  const parts = [];
  do parts.push(readHeader(file)); while (flags & PARTS && file.peek());
  if (flags & PARTS) file.byte();
  const {width, height} = parts[0], channels = new Map();
  // Where all chunks begin comes before all of them.
  for (const part of parts) part.offsets = Array.from({length: Math.ceil(part.height / part.lines)}, () => file.long());
  for (const part of parts) {
    if (part !== parts[0] && part.name === "fine") continue;  // subpixels, which no network here reads
    if (part.width !== width || part.height !== height) throw new Error("its parts differ in size");
    for (const channel of part.channels) {
      // A part that is called as a layer needs no prefix in its channels.
      const name = part !== parts[0] && part.name && !channel.name.includes(".")
        ? `${part.name}.${channel.name}` : channel.name;
      channel.plane = channels.has(name) ? null : new Float32Array(width * height);
      if (channel.plane) channels.set(name, channel.plane);
    }
    for (const offset of part.offsets) await readChunk(new Reader(buffer, offset), part, flags & PARTS);
  }
  return {width, height, channels};
}

function readHeader(file) {
  const attributes = {};
  for (let name; (name = file.string());) {
    file.string();  // its type, which the name implies
    const size = file.int();
    attributes[name] = new Reader(file.view.buffer, file.at);
    attributes[name].size = size;
    file.take(size);
  }
  for (const name of ["channels", "compression", "dataWindow"])
    if (!attributes[name]) throw new Error(`its header lacks '${name}'`);
  const kind = attributes.type?.text() ?? "scanlineimage";
  if (kind !== "scanlineimage") throw new Error(`it has a part of type '${kind}'; this page reads scan lines only`);
  const number = attributes.compression.byte(), compression = COMPRESSIONS[number] ?? `number ${number}`;
  if (!(compression in LINES))
    throw new Error(`its compression is ${compression}; this page reads none, ZIP and ZIPS. "ngpt" reads them all`);
  const [left, top, right, bottom] = Array.from({length: 4}, () => attributes.dataWindow.int());
  const channels = [];
  for (let name; (name = attributes.channels.string());) {
    const type = attributes.channels.int();
    attributes.channels.int();  // "perceptually linear", and nothing
    const across = attributes.channels.int(), down = attributes.channels.int();
    if (!(type in BYTES)) throw new Error(`its channel '${name}' has the unknown type ${type}`);
    if (across !== 1 || down !== 1) throw new Error(`its channel '${name}' is subsampled`);
    channels.push({name, type});
  }
  const width = right - left + 1, height = bottom - top + 1;
  if (!(width > 0 && height > 0 && width * height < 2 ** 28)) throw new Error(`its size, ${width}x${height}, is wrong`);
  return {name: attributes.name?.text() ?? "", compression, lines: LINES[compression], channels, width, height, top};
}

async function readChunk(file, part, hasParts) {
  if (hasParts) file.int();
  const first = file.int() - part.top, size = file.int(), rows = Math.min(part.lines, part.height - first);
  const expected = part.channels.reduce((sum, {type}) => sum + BYTES[type], 0) * part.width * rows;
  let data = file.bytes(size);
  if (first < 0 || rows < 1) throw new Error("one of its scan lines is outside its window");
  // What does not become smaller is stored as it is.
  if (part.compression !== "none" && size < expected) data = unfiltered(await inflated(data));
  if (data.length !== expected) throw new Error("it is damaged: a block has the wrong size");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  for (let row = first, at = 0; row < first + rows; row++)
    for (const {type, plane} of part.channels) {
      for (let x = 0, to = row * part.width; plane && x < part.width; x++) {
        const place = at + x * BYTES[type];
        plane[to + x] = type === 1 ? halfToNumber(view.getUint16(place, true))
          : type === 2 ? view.getFloat32(place, true) : view.getUint32(place, true);
      }
      at += part.width * BYTES[type];
    }
}

export async function inflated(bytes, format = "deflate") {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format));
  try {
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch {
    throw new Error("it is damaged: a block cannot be decompressed");
  }
}

/** OpenEXR compresses differences of bytes, all even ones before all odd ones. */
function unfiltered(bytes) {
  for (let i = 1; i < bytes.length; i++) bytes[i] = bytes[i - 1] + bytes[i] - 128;
  const result = new Uint8Array(bytes.length), half = Math.ceil(bytes.length / 2);
  for (let i = 0; i < bytes.length; i++) result[i] = bytes[i % 2 ? half + (i - 1) / 2 : i / 2];
  return result;
}

function halfToNumber(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = bits >> 10 & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1024 + fraction) * 2 ** (exponent - 25) : fraction * 2 ** -24);
}

/** Little-endian values one after the other. */
class Reader {
  constructor(buffer, at = 0) { this.view = new DataView(buffer); this.at = at; }
  take(size) {
    if (!(size >= 0 && this.at + size <= this.view.byteLength)) throw new Error("it is damaged, or cut short");
    this.at += size;
    return this.at - size;
  }
  byte() { return this.view.getUint8(this.take(1)); }
  peek() { return this.view.getUint8(this.take(1) && --this.at); }
  int() { return this.view.getInt32(this.take(4), true); }
  long() { return Number(this.view.getBigUint64(this.take(8), true)); }
  bytes(size) { return new Uint8Array(this.view.buffer, this.take(size), size); }
  text() { return new TextDecoder().decode(this.bytes(this.size)); }
  string() {
    const start = this.at;
    while (this.byte());
    return new TextDecoder().decode(new Uint8Array(this.view.buffer, start, this.at - 1 - start));
  }
}
