/**
 * Light that gradients hold nothing of: taken out of what a network with gradients is given, and spread over its
 * neighbourhood to be added to what it gives, as ngpt/denoisers/caustic.py does. See export/CONTRACT.md.
 */

// Distances in pixels, one after the other, and the neighbours of one half plane with their weights.
const DISTANCES = [1, 2, 4, 8, 16, 32, 1, 2];
const NEIGHBOURS = [[0, 1, 1 / 8], [1, 0, 1 / 8], [1, 1, 1 / 16], [1, -1, 1 / 16]];
const SIGNIFICANT = 9, FARTHEST = 1e-6;

/**
 * {layers, added}: `layers` for a network that reads `inputs`, and an image to be added to its result, or null. A
 * network that reads no gradients sees all light, and its noise is that of both parts.
 */
export function withoutCaustic(layers, inputs, width, height) {
  const {primal, caustic, primal_var: noise, caustic_var: further} = layers;
  if (!caustic || !caustic.some(value => value !== 0)) return {layers, added: null};
  if (!inputs.includes("dx")) {
    const whole = noise?.map((value, i) => value + (further ? further[i] : caustic[i] === 0 ? 0 : NaN));
    return {layers: {...layers, primal_var: whole}, added: null};
  }
  const rest = primal.map((value, i) => value - caustic[i]);
  return {layers: {...layers, primal: rest}, added: spread(layers, width, height)};
}

/** `image` and what was to be added, channel by channel. */
export const withAdded = (image, added) => added ? image.map((value, i) => value + added[i]) : image;

function spread(layers, width, height) {
  const {caustic, caustic_var: given} = layers, n = width * height;
  let scale = 0;
  for (const value of caustic) if (Number.isFinite(value)) scale = Math.max(scale, Math.abs(value));
  scale ||= 1;
  let light = caustic.map(value => Number.isFinite(value) ? value / scale : 0);
  let variance = new Float32Array(n), floor = 1e-37;
  for (let i = 0; i < 3 * n; i++) {
    const own = light[i] ** 2, known = given && Number.isFinite(given[i]);
    // What is not known of a variance is that of an estimate that is all noise.
    variance[i % n] += (known ? Math.max(given[i] / scale / scale, 0) : own) / 3;
    floor += 1e-12 * own / (3 * n);
  }
  const surface = surfaces(layers, n);
  for (const distance of DISTANCES) {
    const next = light.slice(), kept = new Float32Array(n).fill(1), taken = new Float32Array(n);
    for (const [down, right, weight] of NEIGHBOURS) {
      const dy = distance * down, dx = distance * right;
      for (let y = 0; y + dy < height; y++)
        for (let x = Math.max(0, -dx), end = Math.min(width, width - dx); x < end; x++) {
          const here = y * width + x, there = here + dy * width + dx, noise = variance[here] + variance[there];
          let squares = 0, apart = 0;
          for (let at = 0; at < 3 * n; at += n) squares += (light[at + there] - light[at + here]) ** 2;
          for (let at = 0; at < surface.length; at += n) apart += (surface[at + there] - surface[at + here]) ** 2;
          apart += Math.max(squares / 3 - noise, 0) / (SIGNIFICANT * noise + floor);
          const share = weight * Math.exp(-apart);
          for (let at = 0; at < 3 * n; at += n) {
            const step = share * (light[at + there] - light[at + here]);
            next[at + here] += step;
            next[at + there] -= step;
          }
          kept[here] -= share;
          kept[there] -= share;
          taken[here] += share ** 2 * variance[there];
          taken[there] += share ** 2 * variance[here];
        }
    }
    light = next;
    variance = variance.map((value, i) => kept[i] ** 2 * value + taken[i]);
  }
  return light.map(value => value * scale);
}

/** Albedo, normals and the logarithm of the depth: two pixels that differ by 1 in them exchange 1/e of their light. */
function surfaces({albedo = [], normal = [], depth = []}, n) {
  const finite = value => Number.isFinite(value) ? value : 0, all = new Float32Array(7 * n);
  const farthest = depth.reduce((most, value) => Math.max(most, finite(value)), 0);
  all.set(albedo.map(finite));
  all.set(normal.map(finite), 3 * n);
  if (farthest) all.set(depth.map(value => Math.log(Math.max(finite(value), FARTHEST * farthest))), 6 * n);
  return all;
}
