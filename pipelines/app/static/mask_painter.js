// Painting a mask over a photograph.

import { element } from "./jobs.js";

export class MaskPainter {
  constructor(canvas, touched) {
    this.canvas = canvas;
    this.touched = touched;
    this.adding = true;
    this.radius = 14;
    this.mask = element("canvas");
    let last = null;
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); last = this.place(event); this.stroke(last, last); });
    canvas.addEventListener("pointermove", (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      const now = this.place(event);
      this.stroke(last, now);
      last = now;
    });
  }

  // Show a picture and a mask; the mask has the photographs' full size.
  async load(picture, mask) {
    const [below, above] = await Promise.all([picture, mask].map(async (address) => {
      const image = new Image();
      image.src = address;
      await image.decode();
      return image;
    }));
    this.picture = below;
    [this.mask.width, this.mask.height] = [above.naturalWidth, above.naturalHeight];
    const scale = 640 / Math.max(above.naturalWidth, above.naturalHeight);
    [this.canvas.width, this.canvas.height] = [Math.round(above.naturalWidth * scale), Math.round(above.naturalHeight * scale)];
    this.mask.getContext("2d").drawImage(above, 0, 0);
    this.draw();
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect(), scale = this.mask.width / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  }

  stroke([x0, y0], [x1, y1]) {
    const context = this.mask.getContext("2d"), scale = this.mask.width / this.canvas.getBoundingClientRect().width;
    context.strokeStyle = this.adding ? "#fff" : "#000";
    context.lineWidth = 2 * this.radius * scale;
    context.lineCap = "round";
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1 + 0.01);
    context.stroke();
    this.draw();
    this.touched();
  }

  draw() {
    const { width, height } = this.canvas, context = this.canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(this.mask, 0, 0, width, height);
    const inside = context.getImageData(0, 0, width, height).data;
    context.drawImage(this.picture, 0, 0, width, height);
    const image = context.getImageData(0, 0, width, height), data = image.data, tint = [255, 80, 160];
    for (let i = 0; i < data.length; i += 4) {
      if (inside[i] > 127) continue;
      for (let c = 0; c < 3; c++) data[i + c] = 0.45 * data[i + c] + 0.55 * tint[c];
    }
    context.putImageData(image, 0, 0);
  }

  blob() { return new Promise((resolve) => this.mask.toBlob(resolve, "image/png")); }
}
