// Objects under a light that is dragged: the pad that chooses its direction, and the picture of an object.
// Frame: x right, y up, z to the camera; a light vector points from the surface to the light.

import { element } from "./jobs.js";

const SRGB = new Uint8ClampedArray(4096); // linear radiance, 1 = 4095, as sRGB's 8 bits
for (let i = 0; i < 4096; i++) {
  const v = i / 4095;
  SRGB[i] = Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
}
export const encode = (v) => SRGB[v >= 1 ? 4095 : v <= 0 ? 0 : (v * 4095 + 0.5) | 0];

// A disc of directions, with two sliders for the keyboard. `surface`: a picture on which dragging works too.
export class LightPad {
  constructor(box, surface, changed, marks = []) {
    this.changed = changed;
    this.limit = 85;
    this.dot = element("circle", { r: 0.09, fill: "#ffd54a", stroke: "#000", "stroke-width": 0.025 });
    const lights = marks.map(([x, y]) => element("circle", { cx: x, cy: -y, r: 0.022, fill: "#9aa3c7" }));
    this.svg = element("svg", { viewBox: "-1.1 -1.1 2.2 2.2", "aria-hidden": "true" },
      element("circle", { r: 1, fill: "#23263a", stroke: "#8c93b5", "stroke-width": 0.02 }),
      element("circle", { r: 0.5, fill: "none", stroke: "#8c93b5", "stroke-width": 0.01, "stroke-dasharray": "0.04 0.04" }), ...lights, this.dot);
    const slider = (min, max) => element("input", { type: "range", min, max, step: 1 });
    this.azimuth = slider(-180, 180);
    this.slant = slider(0, this.limit);
    const labels = [element("label", {}, "Around, degrees", this.azimuth), element("label", {}, "Away from the camera, degrees", this.slant)];
    box.replaceChildren(this.svg, element("div", {}, ...labels));
    for (const input of [this.azimuth, this.slant]) input.addEventListener("input", () => this.fromSliders());
    for (const target of [this.svg, surface].filter(Boolean)) this.listen(target);
    this.set(-0.45, 0.45);
  }

  listen(target) {
    const follow = (event) => {
      const box = target.getBoundingClientRect();
      const scale = target === this.svg ? 1.1 : 1;
      this.set(scale * (2 * (event.clientX - box.left) / box.width - 1), -scale * (2 * (event.clientY - box.top) / box.height - 1));
    };
    target.onpointerdown = (event) => { target.setPointerCapture(event.pointerId); follow(event); };
    target.onpointermove = (event) => { if (target.hasPointerCapture(event.pointerId)) follow(event); };
  }

  set(x, y) {
    const length = Math.hypot(x, y), most = Math.sin(this.limit * Math.PI / 180);
    if (length > most) [x, y] = [x / length * most, y / length * most];
    this.direction = [x, y, Math.sqrt(Math.max(0, 1 - x * x - y * y))];
    this.azimuth.value = Math.round(Math.atan2(y, x) * 180 / Math.PI);
    this.slant.value = Math.round(Math.asin(Math.min(1, Math.hypot(x, y))) * 180 / Math.PI);
    this.show();
  }

  fromSliders() {
    const around = this.azimuth.value * Math.PI / 180, away = this.slant.value * Math.PI / 180;
    this.direction = [Math.cos(around) * Math.sin(away), Math.sin(around) * Math.sin(away), Math.cos(away)];
    this.show();
  }

  show() {
    this.dot.setAttribute("cx", this.direction[0]);
    this.dot.setAttribute("cy", -this.direction[1]);
    this.azimuth.setAttribute("aria-valuetext", `${this.azimuth.value} degrees`);
    this.slant.setAttribute("aria-valuetext", `${this.slant.value} degrees`);
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.changed(this.direction); });
  }
}

// An object by normals, albedo and highlights (`object_view.py`), and tables of how it reflects, which Python evaluates
// (`reflectance_tables.py` says what they hold); without tables it is Lambertian.
export class Reflectance {
  constructor(basis, view, tables = null) {
    const count = view.width * view.height;
    this.view = view;
    this.normals = new Int16Array(basis, 0, 3 * count);
    this.albedo = new Uint16Array(basis, 6 * count, 3 * count);
    this.strength = new Uint16Array(basis, 12 * count, count);
    if (!tables) return;
    const size = 2 * view.tables.matte.reduce((product, entries) => product * entries);
    this.matte = new Float32Array(tables, 0, size);
    this.glossy = new Float32Array(tables, 4 * size);
  }

  draw(canvas, light) {
    const { width, height } = this.view, context = canvas.getContext("2d");
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const image = context.createImageData(width, height), data = image.data, [lx, ly, lz] = light;
    const peak = this.view.albedo / 65535, shine = this.view.strength / 65535, n = this.normals, a = this.albedo;
    for (let p = 0, i = 0; i < width * height; i++, p += 3) {
      data[4 * i + 3] = 255;
      const nz = n[p + 2] / 32767, cosine = (n[p] * lx + n[p + 1] * ly) / 32767 + nz * lz;
      if (cosine <= 0) continue;
      const [body, lobes] = this.matte ? this.reflect(cosine, nz, lz) : [1, 0], gloss = shine * this.strength[i] * lobes;
      for (let c = 0; c < 3; c++) data[4 * i + c] = encode((peak * a[p + c] * body + gloss) * cosine);
    }
    context.putImageData(image, 0, 0);
  }

  // What albedo and highlight strength are multiplied with, of the cosines n.l, n.v and l.v.
  reflect(cosine, facing, across) {
    const { least, limit, matte, glossy } = this.view.tables;
    const l = Math.max(cosine, least), v = Math.max(facing, least), more = Math.min(1, Math.max(l, v));
    const slant = Math.acosh(1 / more) / Math.acosh(1 / least), balance = more > least ? (l - v) / (more - least) : 0;
    const azimuth = (across - l * v) / Math.sqrt(Math.max((1 - l * l) * (1 - v * v), 1e-12));
    const tilt = Math.sqrt(Math.max(0, 1 - (cosine + facing) / Math.sqrt(2 + 2 * across)));
    interpolate(around, this.matte, matte, (azimuth + 1) / 2, (balance + 1) / 2, slant);
    interpolate(above, this.glossy, glossy, 0, across, tilt);
    const factor = Math.exp(Math.min(limit, Math.max(-limit, around[1] + above[1])));
    return [factor * Math.exp(around[0]), factor * above[0]];
  }
}

const around = new Float64Array(2), above = new Float64Array(2);

// The two values that a table holds at a place, linear between its entries, into `found`; shares of the way along the
// axes, the last of which runs fastest.
function interpolate(found, table, sizes, outer, middle, inner) {
  const depth = sizes.length === 3 ? sizes[0] - 1 : 0, rows = sizes.at(-2) - 1, columns = sizes.at(-1) - 1;
  const z = depth * Math.min(1, Math.max(0, outer)), y = rows * Math.min(1, Math.max(0, middle)), x = columns * Math.min(1, Math.max(0, inner));
  const k = Math.min(z | 0, Math.max(depth - 1, 0)), j = Math.min(y | 0, rows - 1), i = Math.min(x | 0, columns - 1);
  const row = 2 * (columns + 1), right = x - i, down = y - j, deep = z - k;
  found[0] = found[1] = 0;
  for (let back = 0; back < (depth ? 2 : 1); back++) {
    const weight = back ? deep : 1 - deep, start = ((k + back) * (rows + 1) + j) * row + 2 * i;
    for (let value = 0; value < 2; value++) {
      const at = start + value, above = table[at] + right * (table[at + 2] - table[at]), below = table[at + row] + right * (table[at + row + 2] - table[at + row]);
      found[value] += weight * (above + down * (below - above));
    }
  }
}
