/** The page: takes a stack, has it reconstructed, and shows it before and after. Behind exr.mjs in one script. */

import {inflated, readStack} from "./exr.mjs";

const $ = id => document.getElementById(id);
const root = document.documentElement;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

function complain(message) {
  root.dataset.error = message;
  $("problem").textContent = message;
  $("problem").hidden = false;
  $("status").textContent = "";
}
addEventListener("error", event => complain("Something went wrong on this page: " + event.message));
addEventListener("unhandledrejection", event => complain("Something went wrong on this page: " + event.reason));
addEventListener("securitypolicyviolation", event => complain("The page's policy blocked: " + event.blockedURI));

/** What build.py put into the page under a name: deflated, in base64. */
function unpacked(name) {
  return inflated(Uint8Array.from(atob($(name).textContent), letter => letter.charCodeAt(0)));
}

async function startWorker() {
  const [code, glue, wasm, model, statistics] =
    await Promise.all(["worker", "glue", "wasm", "model", "statistics"].map(unpacked));
  const worker = new Worker(URL.createObjectURL(new Blob([code], {type: "text/javascript"})));
  worker.onmessage = ({data}) => answered(data);
  worker.onerror = event => complain("The model could not be started: " + event.message);
  worker.postMessage({glue, wasm, model, statistics}, [wasm.buffer]);
  return worker;
}

// --- from a file to a clean image ------------------------------------------------------------------------------------

const NEEDED = ["primal", "dx", "dy", "albedo", "normal", "depth", "primal_var", "dx_var", "dy_var"];
// Pixels in one run at most: each takes 1.6 kB, and WebAssembly has no more than 4 GiB.
const MOST = 2 ** 20, TILE = 512;
let worker, turn = 0, stack = null, clean = null, exposure = 0;

async function open(name, contents) {
  const mine = ++turn;
  root.dataset.ready = "false";
  delete root.dataset.error;
  $("problem").hidden = true;
  $("status").textContent = `Reading ${name}…`;
  try {
    const read = await readStack(await contents);
    const missing = NEEDED.filter(layer => !(layer in read.layers));
    if (missing.length) throw new Error(`the network needs the layers ${missing.join(", ")}, which it has not`);
    if (mine !== turn) return;
    [stack, clean] = [{turn: mine, name, ...read}, null];
    show();
    $("status").textContent = `Reconstructing ${name}, ${read.width}x${read.height}…`;
    worker ??= startWorker();
    const {width, height, layers} = read, tile = width * height > MOST ? TILE : 0;
    (await worker).postMessage({turn: mine, layers, width, height, tile});
  } catch (error) {
    if (mine === turn) complain(`${name}: ${error.message}`);
  }
}

function answered(data) {
  if (data.turn !== stack.turn) return;
  const {name, width, height} = stack;
  if (data.error) return complain(`${name}: ${data.error}`);
  if (data.all) return void ($("status").textContent = `Reconstructing ${name}: ${data.done} of ${data.all} tiles`);
  clean = data.image;
  const loading = data.loading > 1 ? `, after ${(data.loading / 1000).toFixed(1)} s of loading` : "";
  $("status").textContent = `${name}: ${width}x${height} in ${(data.milliseconds / 1000).toFixed(2)} s${loading}`;
  show();
  root.dataset.ready = "true";
}

// --- showing ---------------------------------------------------------------------------------------------------------

/** Stops that bring the log-average luminance of the lit pixels to middle grey, as ngpt.image.display does. */
function automaticExposure({layers: {primal}}) {
  const n = primal.length / 3, lit = [];
  for (let i = 0; i < n; i++) {
    const luminance = 0.2126 * primal[i] + 0.7152 * primal[n + i] + 0.0722 * primal[2 * n + i];
    if (luminance > 0 && luminance < Infinity) lit.push(luminance);
  }
  if (!lit.length) return 0;
  lit.sort((a, b) => a - b);
  const bright = lit[Math.floor(0.99 * (lit.length - 1))], subject = lit.filter(value => value > bright / 8192);
  return Math.log2(0.18) - subject.reduce((sum, value) => sum + Math.log2(Math.min(value, bright)), 0) / subject.length;
}

function draw(canvas, pixels) {
  const {width, height} = stack, n = width * height, gain = 2 ** (stack.stops + exposure);
  Object.assign(canvas, {width, height});
  const context = canvas.getContext("2d"), image = context.createImageData(width, height);
  image.data.fill(255);
  for (let i = 0; i < n; i++) {
    for (let c = 0; c < 3; c++) {
      const x = clamp(pixels[c * n + i] * gain, 0, 1);
      image.data[4 * i + c] = 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);  // rounds itself
    }
    // Not a number is magenta, as everywhere in ngpt.
    if (Number.isNaN(pixels[i] + pixels[n + i] + pixels[2 * n + i])) image.data.set([255, 0, 255], 4 * i);
  }
  context.putImageData(image, 0, 0);
}

function show() {
  if (!stack) return;
  stack.stops ??= automaticExposure(stack);
  $("frame").hidden = false;
  draw($("noisy"), stack.layers.primal);
  draw($("clean"), clean ?? stack.layers.primal);
  document.querySelector(".name.right").textContent = clean ? "clean" : "noisy, clean soon";
  fit();
  split(Number($("wipe").getAttribute("aria-valuenow") ?? 50));
}

/** As large as fits; enlarged by whole factors, but for the first. */
function fit() {
  if (!stack) return;
  const {width, height} = stack, style = $("frame").style;
  const factor = Math.min($("stage").clientWidth / width, $("stage").clientHeight / height);
  const scale = factor > 2 ? Math.floor(factor) : factor;
  $("frame").classList.toggle("enlarged", scale > 1);
  [style.width, style.height] = [`${width * scale}px`, `${height * scale}px`];
}

function split(percent) {
  percent = Math.round(10 * clamp(percent, 0, 100)) / 10;
  $("noisy").style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
  $("wipe").style.left = `${percent}%`;
  $("wipe").setAttribute("aria-valuenow", percent);
  $("wipe").setAttribute("aria-valuetext", `${percent} % noisy`);
}

function expose(stops) {
  exposure = stops;
  $("stops").textContent = `${stops > 0 ? "+" : ""}${stops.toFixed(2)}`;
  show();
}

// --- what the user does ----------------------------------------------------------------------------------------------

const openFile = file => file && open(file.name, file.arrayBuffer());
const openExample = () => open("example.exr", unpacked("stack").then(bytes => bytes.buffer));

$("open").onclick = () => $("file").click();
$("file").onchange = () => {
  openFile($("file").files[0]);
  $("file").value = "";  // so that the same file, rendered anew, can be picked again
};
$("example").onclick = openExample;
$("exposure").oninput = () => expose(Number($("exposure").value));
addEventListener("resize", fit);
addEventListener("dragover", event => { event.preventDefault(); document.body.classList.add("over"); });
addEventListener("dragleave", event => event.relatedTarget || document.body.classList.remove("over"));
addEventListener("drop", event => {
  event.preventDefault();
  document.body.classList.remove("over");
  openFile(event.dataTransfer.files[0]);
});

function drag(event) {
  if (!(event.buttons & 1)) return;
  const {left, width} = $("frame").getBoundingClientRect();
  split(100 * (event.clientX - left) / width);
}
$("frame").onpointerdown = event => { $("frame").setPointerCapture(event.pointerId); $("wipe").focus(); drag(event); };
$("frame").onpointermove = drag;
$("wipe").onkeydown = event => {
  const now = Number($("wipe").getAttribute("aria-valuenow")), step = event.shiftKey ? 10 : 1;
  const to = {ArrowLeft: now - step, ArrowDown: now - step, ArrowRight: now + step, ArrowUp: now + step, Home: 0, End: 100};
  if (!(event.key in to)) return;
  event.preventDefault();
  split(to[event.key]);
};

expose(0);
openExample();
