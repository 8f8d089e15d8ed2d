/**
 * Runs an ngpt model on the layers of one image, whole or in tiles: a host in Node.
 *
 *     node host.mjs MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]
 *
 * FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. TILE is the side of the tiles, 0 for the whole image at once.
 */

import {readFileSync, writeFileSync} from "node:fs";
import {createRequire} from "node:module";
import {Model} from "../javascript/model.mjs";

// Official builds send telemetry by themselves, unless this is set before they are loaded.
process.env.ORT_DISABLE_TELEMETRY ??= "1";
const [path, folder, output, tile = "0", runs = "1"] = process.argv.slice(2);

async function main() {
  // In node_modules beside this file, or where NODE_PATH says.
  const ort = createRequire(import.meta.url)("onnxruntime-node");
  // Only tiles need the statistics of the whole image.
  const statistics = Number(tile) ? readFileSync(path.replace(/\.onnx$/, ".statistics.onnx")) : undefined;
  const model = await Model.open(ort, readFileSync(path), statistics);
  const shapes = JSON.parse(readFileSync(`${folder}/layers.json`, "utf8")), [, , height, width] = shapes.primal.shape;
  const layers = {};
  for (const name in shapes) layers[name] = new Float32Array(Uint8Array.from(readFileSync(`${folder}/${name}.f32`)).buffer);
  let image;
  for (let i = 0; i < Math.max(1, Number(runs)); i++) {
    const start = performance.now();
    image = await model.run(layers, width, height, Number(tile));
    console.log(`${(performance.now() - start).toFixed(1)} ms`);
  }
  // A portable float map: pixel by pixel, the last row first, little-endian.
  const pixels = new Float32Array(image.length);
  for (let i = 0; i < image.length; i++) {
    const y = Math.floor(i / width) % height, c = Math.floor(i / width / height);
    pixels[3 * ((height - 1 - y) * width + i % width) + c] = image[i];
  }
  writeFileSync(output, Buffer.concat([Buffer.from(`PF\n${width} ${height}\n-1.0\n`), Buffer.from(pixels.buffer)]));
}

const understood = output !== undefined && /^\d+$/.test(tile) && /^\d+$/.test(runs);
await (understood ? main() : Promise.reject(new Error("usage: MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]"))).catch(error => {
  console.error(`host.mjs: ${error.message.split("\n")[0]}`);
  process.exitCode = understood ? 1 : 2;
});
