/** Runs the model beside the page, which stays alive meanwhile. Behind ONNX Runtime's own script and model.mjs. */

import {Model} from "../javascript/model.mjs";

// Pixels in one run at most: each takes 1.6 kB, and WebAssembly has no more than 4 GiB.
const MOST = 2 ** 20, TILE = 512;
let model;

onmessage = async ({data}) => {
  try {
    if (data.wasm) {
      // One thread: others need headers that only a server can send.
      const glue = URL.createObjectURL(new Blob([data.glue], {type: "text/javascript"}));
      Object.assign(ort.env.wasm, {wasmBinary: data.wasm, wasmPaths: {mjs: glue}, numThreads: 1, proxy: false});
      model = Model.open(ort, data.model, data.statistics, {executionProviders: ["wasm"]});
      return;
    }
    const {turn, layers, width, height} = data, start = performance.now();
    const loaded = await model, tile = width * height > MOST ? TILE : 0, begun = performance.now();
    const image = await loaded.run(layers, width, height, tile, (done, all) => postMessage({turn, done, all}));
    postMessage({turn, image, loading: begun - start, milliseconds: performance.now() - begun});
  } catch (error) {
    postMessage({turn: data.turn, error: String(error?.message ?? error)});
  }
};
