/** Runs the model beside the page, which stays alive meanwhile. Behind ONNX Runtime's own script and the shared module. */

import {Model} from "../javascript/model.mjs";

let open, loaded, last = Promise.resolve();

// One after the other: a session runs once at a time.
onmessage = ({data}) => { last = last.then(() => answer(data)); };

async function answer(data) {
  try {
    if (data.wasm) {
      // One thread: others need headers that only a server can send.
      const glue = URL.createObjectURL(new Blob([data.glue], {type: "text/javascript"}));
      Object.assign(ort.env.wasm, {wasmBinary: data.wasm, wasmPaths: {mjs: glue}, numThreads: 1, proxy: false});
      open = () => Model.open(ort, data.model, data.statistics, {executionProviders: ["wasm"]});
      return;
    }
    const {turn, width, height, tile} = data, start = performance.now();
    loaded ??= await open();
    const begun = performance.now();
    const image = await loaded.run(data.layers, width, height, tile, (done, all) => postMessage({turn, done, all}));
    postMessage({turn, image, loading: begun - start, milliseconds: performance.now() - begun});
  } catch (error) {
    postMessage({turn: data.turn, error: String(error?.message ?? error)});
  }
}
