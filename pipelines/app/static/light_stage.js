// A scene under any light, blended from images under one light each (`studio_tasks.write_basis`): the three images
// around the light, with barycentric weights. Nothing is rendered while the light moves.

import { encode } from "./relight.js";

export class LightStage {
  constructor(basis, truth, about) {
    const count = about.width * about.height;
    this.about = about;
    this.images = new Uint8Array(basis);
    this.direct = null; // the same without interreflections
    this.normals = new Int8Array(truth, 0, 3 * count);
    this.depth = new Uint8Array(truth, 3 * count, count);
    this.table = Float32Array.from({ length: 256 }, (_, i) => about.headroom * (i / 255) ** 2); // exposed linear radiance
    this.places = about.lights.map(([x, y, z]) => [x / (1 + z), y / (1 + z)]);
  }

  // Numbers and weights of the images to blend for a direction; outside all triangles, those of the nearest edge.
  weights([x, y, z]) {
    const px = x / (1 + z), py = y / (1 + z);
    let best = null, most = -Infinity;
    for (const triangle of this.about.triangles) {
      const [[ax, ay], [bx, by], [cx, cy]] = triangle.map((k) => this.places[k]);
      const area = (by - cy) * (ax - cx) + (cx - bx) * (ay - cy);
      const a = ((by - cy) * (px - cx) + (cx - bx) * (py - cy)) / area, b = ((cy - ay) * (px - cx) + (ax - cx) * (py - cy)) / area;
      const least = Math.min(a, b, 1 - a - b);
      if (least > most) [best, most] = [triangle.map((k, i) => [k, [a, b, 1 - a - b][i]]), least];
      if (least >= 0) break;
    }
    if (!best) {
      const near = this.about.lights.map(([lx, ly, lz], k) => [k, lx * x + ly * y + lz * z]).sort((one, two) => two[1] - one[1]);
      return [[near[0][0], 1]];
    }
    const held = best.map(([k, w]) => [k, Math.max(0, w)]), sum = held.reduce((total, [, w]) => total + w, 0);
    return held.map(([k, w]) => [k, w / sum]).filter(([, w]) => w > 0.002);
  }

  // Exposed linear radiance under a light, (h, w, 3).
  mix(images, light) {
    const size = 3 * this.about.width * this.about.height, sum = new Float32Array(size), { table } = this;
    for (const [k, weight] of this.weights(light)) {
      const start = k * size;
      for (let i = 0; i < size; i++) sum[i] += weight * table[images[start + i]];
    }
    return sum;
  }

  draw(canvas, light, overlay = "picture") {
    const { width, height } = this.about, context = canvas.getContext("2d");
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const image = context.createImageData(width, height), data = image.data, count = width * height;
    data.fill(255);
    if (overlay === "normals" || overlay === "depth") {
      for (let i = 0; i < count; i++) {
        if (!this.depth[i]) continue;
        for (let c = 0; c < 3; c++) data[4 * i + c] = overlay === "depth" ? 15 + 0.88 * this.depth[i] : 127.5 * (1 + this.normals[3 * i + c] / 127);
      }
    } else {
      const full = this.mix(this.images, light), direct = this.direct ? this.mix(this.direct, light) : full;
      const inter = overlay === "interreflections", scale = inter ? 4 : 1;
      for (let i = 0; i < count; i++) {
        const lit = direct[3 * i] + direct[3 * i + 1] + direct[3 * i + 2];
        const shadow = overlay === "shadows" && this.depth[i] && lit < 0.02;
        for (let c = 0; c < 3; c++) {
          const value = inter ? Math.max(0, full[3 * i + c] - direct[3 * i + c]) : full[3 * i + c];
          data[4 * i + c] = shadow ? [214, 60, 120][c] : encode(scale * value);
        }
      }
    }
    context.putImageData(image, 0, 0);
  }
}
