// Objects under a light that is dragged: the pad that chooses the direction, and two ways to make the picture.
// Frame: x right, y up, z to the camera; a light vector points from the surface to the light.

import { element } from "./jobs.js";

const CURVE = new Uint8ClampedArray(4096); // linear radiance, 1 = 4095, as sRGB's 8 bits
for (let i = 0; i < 4096; i++) {
  const v = i / 4095;
  CURVE[i] = Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
}
export const coded = (v) => CURVE[v >= 1 ? 4095 : v <= 0 ? 0 : (v * 4095) | 0];

// A disc of directions, with two sliders for the keyboard. `surface`: a picture on which dragging works as well.
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

// An object by normals, albedo and highlights (`object_view.py`, whose `shading` this repeats).
export class Reflectance {
  constructor(buffer, view) {
    const count = view.width * view.height;
    this.view = view;
    this.normals = new Int16Array(buffer, 0, 3 * count);
    this.albedo = new Uint16Array(buffer, 6 * count, 3 * count);
    this.strength = new Uint16Array(buffer, 12 * count, count);
  }

  draw(canvas, light) {
    const { width, height, lobes } = this.view, context = canvas.getContext("2d");
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const image = context.createImageData(width, height), data = image.data;
    const [lx, ly, lz] = light, refined = Boolean(lobes.body);
    const [hx, hy, hz] = refined ? half(light) : [0, 0, 1], spread = refined ? 1 / Math.max(lx * hx + ly * hy + lz * hz, 1e-3) ** 2 : 0;
    const glints = refined ? table(lobes) : null, b = lobes.body, m = lobes.modes;
    const peak = this.view.albedo / 65535, shine = this.view.strength / 65535, n = this.normals, a = this.albedo;
    for (let p = 0, i = 0; i < width * height; i++, p += 3) {
      data[4 * i + 3] = 255;
      const nx = n[p] / 32767, ny = n[p + 1] / 32767, nz = n[p + 2] / 32767, cosine = nx * lx + ny * ly + nz * lz;
      if (cosine <= 0) continue;
      let body = 1, gloss = 0;
      if (refined) {
        const lit = Math.max(cosine, 0.02), seen = Math.max(nz, 0.02), x = 1 - lit, y = 1 - seen;
        let opposed = lz - lit * seen;
        if (opposed > 0) opposed /= Math.max(lit, seen);
        const near = nx * hx + ny * hy + nz * hz, s = x + y, t = Math.max(1 - near, 0);
        const g = m[0] * s * opposed + m[1] * (1 - lz) * opposed + m[2] * s * x * y + m[3] * s * (x - y) ** 2 + m[4] * t * t + m[5] * Math.sqrt(t);
        const factor = Math.exp(Math.min(0.7, Math.max(-0.7, g)));
        body = factor * Math.exp(b[0] * s + b[1] * x * y + b[2] * (x * x + y * y) + b[3] * opposed);
        gloss = factor * shine * this.strength[i] * glints[Math.min(4095, Math.max(0, 4095 * near) | 0)] * spread;
      }
      for (let c = 0; c < 3; c++) data[4 * i + c] = coded((peak * a[p + c] * body + gloss) * cosine);
    }
    context.putImageData(image, 0, 0);
  }
}

function half([x, y, z]) {
  const length = Math.hypot(x, y, z + 1);
  return [x / length, y / length, (z + 1) / length];
}

function table({ amplitudes, sharpness }) { // of n . h
  const values = new Float32Array(4096);
  for (let i = 0; i < 4096; i++) for (let k = 0; k < amplitudes.length; k++) values[i] += amplitudes[k] * Math.exp(sharpness[k] * (i / 4095 - 1));
  return values;
}
