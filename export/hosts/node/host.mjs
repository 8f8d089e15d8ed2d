/**
 * Runs an ngpt model on the layers of one image, whole or in tiles: a host in Node.
 *
 *     node host.mjs MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]
 *
 * FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. TILE is the side of the tiles, 0 for the whole image at once.
 */

import {readFileSync, writeFileSync} from "node:fs";
import {createRequire} from "node:module";
import {join} from "node:path";
import {withAdded, withoutCaustic} from "../javascript/caustic.mjs";
import {Model} from "../javascript/model.mjs";

const SUFFIX = /\.onnx$/;

async function main([path, folder, output, tile = "0", runs = "1"]) {
  if (output === undefined || !/^\d+$/.test(tile) || !/^\d+$/.test(runs)) {
    console.error("usage: node host.mjs MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]");
    return 2;
  }
  // Official builds send telemetry by themselves, unless this is set before they are loaded.
  process.env.ORT_DISABLE_TELEMETRY ??= "1";
  // In node_modules beside this file, or where NODE_PATH says.
  const ort = createRequire(import.meta.url)("onnxruntime-node");
  // Only tiles need the statistics of the whole image.
  const statistics = Number(tile) ? readFileSync(path.replace(SUFFIX, ".statistics.onnx")) : undefined;
  const model = await Model.open(ort, readFileSync(path), statistics);
  const shapes = JSON.parse(readFileSync(join(folder, "layers.json"), "utf8"));
  const held = {};
  for (const name of Object.keys(shapes)) {
    const bytes = readFileSync(join(folder, `${name}.f32`));
    held[name] = new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
  }
  const [, , height, width] = shapes.primal.shape;
  const {layers, added} = withoutCaustic(held, model.inputs, width, height);
  let image;
  for (let i = 0; i < Math.max(1, Number(runs)); i++) {
    const start = performance.now();
    image = await model.run(layers, width, height, Number(tile));
    console.log(`${(performance.now() - start).toFixed(1)} ms`);
  }
  writeFileSync(output, pfm(withAdded(image, added), width, height));
  return 0;
}

/** A portable float map: pixel by pixel, the last row first, little-endian. */
function pfm(image, width, height) {
  const head = Buffer.from(`PF\n${width} ${height}\n-1.0\n`), body = Buffer.alloc(image.byteLength);
  for (let y = 0, at = 0; y < height; y++)
    for (let x = 0; x < width; x++)
      for (let c = 0; c < 3; c++) at = body.writeFloatLE(image[(c * height + height - 1 - y) * width + x], at);
  return Buffer.concat([head, body]);
}

try {
  process.exitCode = await main(process.argv.slice(2));
} catch (error) {
  console.error(`host.mjs: ${error.message.split("\n")[0]}`);
  process.exitCode = 1;
}
