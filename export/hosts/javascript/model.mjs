/**
 * An ngpt model in ONNX Runtime's JavaScript, whole or in tiles: what the hosts in Node and in browsers share.
 *
 * Layers are {name: Float32Array}, channel by channel, row by row, all of one size. See export/CONTRACT.md.
 */

export class Model {
  /**
   * `ort` is the module of ONNX Runtime; `model` and `statistics` are the files' contents, Uint8Array. Without
   * `statistics` there are no tiles.
   */
  static async open(ort, model, statistics, options = {}) {
    const made = new Model();
    made.ort = ort;
    made.metadata = metadata(model);
    const value = key => {
      if (!(key in made.metadata)) throw new Error(`the model lacks the metadata ${key}: it is no ngpt network`);
      return made.metadata[key];
    };
    made.inputs = value("ngpt.inputs").split(", ");
    made.optional = value("ngpt.optional").split(", ");
    made.alignment = Number(value("ngpt.alignment"));
    made.overlap = Number(value("ngpt.overlap"));
    const create = bytes => ort.InferenceSession.create(bytes, {logSeverityLevel: 3, ...options});
    made.image = await create(demanding(model, "statistics"));
    made.statistics = statistics && await create(statistics);
    return made;
  }

  /**
   * The image (3 channels) of `layers`; those that the model can do without may be missing. `tile` is the side of the
   * tiles, 0 for none; `progress(done, all)` is told.
   */
  async run(layers, width, height, tile = 0, progress = () => {}) {
    layers = {...layers};
    for (const name of this.inputs) {
      const expected = width * height * (name === "depth" ? 1 : 3);
      // A variance of -1 is not known.
      if (!layers[name] && this.optional.includes(name))
        layers[name] = new Float32Array(expected).fill(name.endsWith("_var") ? -1 : 0);
      const length = layers[name]?.length;
      if (length === undefined) throw new Error(`the model needs the layer ${name}`);
      if (length !== expected) throw new Error(`${name} has ${length} numbers; ${width}x${height} needs ${expected}`);
    }
    if (!tile) return this.#session(this.image, layers, width, height, new Float32Array(5));
    if (!this.statistics) throw new Error("tiles need the network's .statistics.onnx, which `ngpt export` writes");
    const size = Math.max(this.alignment, tile - tile % this.alignment);
    // All tiles share the statistics of the whole image, so that no seam shows.
    const statistics = await this.#session(this.statistics, layers, width, height);
    const result = new Float32Array(3 * width * height), all = Math.ceil(width / size) * Math.ceil(height / size);
    let done = 0;
    for (let y = 0; y < height; y += size)
      for (let x = 0; x < width; x += size) {
        const top = Math.max(0, y - this.overlap), bottom = Math.min(height, y + size + this.overlap);
        const left = Math.max(0, x - this.overlap), right = Math.min(width, x + size + this.overlap);
        const part = {}, w = right - left, h = bottom - top;
        for (const name of this.inputs) {
          part[name] = new Float32Array(layers[name].length / (width * height) * w * h);
          copy(layers[name], width, height, left, top, part[name], w, h, 0, 0, w, h);
        }
        const made = await this.#session(this.image, part, w, h, statistics);
        const columns = Math.min(size, width - x), rows = Math.min(size, height - y);
        copy(made, w, h, x - left, y - top, result, width, height, x, y, columns, rows);
        progress(++done, all);
      }
    return result;
  }

  async #session(session, layers, width, height, statistics) {
    const feeds = {};
    for (const name of session.inputNames)
      feeds[name] = name === "statistics"
        ? new this.ort.Tensor("float32", statistics, [5])
        : new this.ort.Tensor("float32", layers[name], [1, layers[name].length / (width * height), height, width]);
    const results = await session.run(feeds);
    return results[session.outputNames[0]].data;
  }
}

/** Copies a rectangle of `columns` x `rows` pixels, in all channels. */
function copy(from, fromWidth, fromHeight, x0, y0, to, toWidth, toHeight, x1, y1, columns, rows) {
  for (let c = 0; c < from.length / (fromWidth * fromHeight); c++)
    for (let y = 0; y < rows; y++) {
      const start = (c * fromHeight + y0 + y) * fromWidth + x0;
      to.set(from.subarray(start, start + columns), (c * toHeight + y1 + y) * toWidth + x1);
    }
}

// --- the file: ONNX Runtime's JavaScript shows neither the metadata nor inputs that have defaults -------------------

// Numbers of fields in onnx.proto.
const GRAPH = 7, METADATA = 14, INITIALIZER = 5, INITIALIZER_NAME = 8, KEY = 1, VALUE = 2;
const text = bytes => new TextDecoder().decode(bytes);

/** The fields of a protobuf message: number, the bytes of the whole field, and of what it holds if it has a length. */
function* fields(bytes) {
  for (let at = 0; at < bytes.length;) {
    const start = at;
    const varint = () => {
      for (let value = 0, scale = 1; ; scale *= 128) {
        if (at >= bytes.length) throw new Error("the model's file is not ONNX, or is cut short");
        value += (bytes[at] & 127) * scale;
        if (bytes[at++] < 128) return value;
      }
    };
    const tag = varint(), number = Math.floor(tag / 8), kind = tag % 8;
    const length = [0, 8, undefined, NaN, NaN, 4, NaN, NaN][kind];
    if (kind === 0) varint();
    const size = length ?? varint(), begin = at;
    at += size;
    if (!(at <= bytes.length)) throw new Error("the model's file is not ONNX, or is cut short");
    yield {number, whole: bytes.subarray(start, at), content: bytes.subarray(begin, at)};
  }
}

const field = (message, wanted) => {
  for (const {number, content} of fields(message)) if (number === wanted) return content;
};

function metadata(model) {
  const found = {};
  for (const {number, content} of fields(model))
    if (number === METADATA) found[text(field(content, KEY))] = text(field(content, VALUE) ?? new Uint8Array());
  return found;
}

/** The model without the default of `input`: it must be given then, and only so can it be given. */
function demanding(model, input) {
  const without = [...fields(model)].map(({number, whole, content}) => {
    if (number !== GRAPH) return whole;
    const isDefault = item => item.number === INITIALIZER && text(field(item.content, INITIALIZER_NAME)) === input;
    const graph = joined([...fields(content)].filter(item => !isDefault(item)).map(item => item.whole));
    const head = [GRAPH << 3 | 2];
    for (let size = graph.length; ; size = Math.floor(size / 128)) {
      head.push(size < 128 ? size : size % 128 + 128);
      if (size < 128) break;
    }
    return joined([Uint8Array.from(head), graph]);
  });
  return joined(without);
}

function joined(parts) {
  const all = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) all.set(part, at), at += part.length;
  return all;
}
