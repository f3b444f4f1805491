// Maps of normals under a light that is dragged, and errors under the pointer. Without this script the page is whole.
// Frame: x right, y up, z to the camera; the light points from the surface. Normals n are coloured (n + 1) / 2.
"use strict";
(() => {
  const figures = [...document.querySelectorAll("figure[data-kind]")];
  const bar = document.getElementById("light"), [lit, around, away] = bar.querySelectorAll("input");
  const RADIANS = Math.PI / 180;

  // Normals of a picture, (h, w, 3) flat, zero where it is white.
  function decode(img) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [img.naturalWidth, img.naturalHeight];
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(img, 0, 0);
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    const normals = new Float32Array(3 * canvas.width * canvas.height);
    for (let p = 0, i = 0; i < data.length; i += 4, p += 3) {
      const n = [data[i], data[i + 1], data[i + 2]].map((v) => v / 127.5 - 1), length = Math.hypot(...n);
      if (length < 1.5) for (let c = 0; c < 3; c++) normals[p + c] = n[c] / Math.max(length, 1e-6);
    }
    return { canvas, normals, width: canvas.width, height: canvas.height };
  }

  class NormalMap {
    constructor(figure) {
      this.figure = figure;
      this.img = figure.querySelector("img");
      this.visible = true;
    }

    get decoded() { return this.kept ??= decode(this.img); }

    // White Lambertian, sRGB's curve as a power of 1 / 2.2.
    draw(light) {
      const { canvas, normals, width, height } = this.decoded, context = canvas.getContext("2d");
      const image = context.createImageData(width, height), { data } = image;
      for (let p = 0, i = 0; i < data.length; i += 4, p += 3) {
        const [x, y, z] = [normals[p], normals[p + 1], normals[p + 2]], outside = x === 0 && y === 0 && z === 0;
        const value = outside ? 255 : 255 * Math.max(0, x * light[0] + y * light[1] + z * light[2]) ** (1 / 2.2);
        data[i] = data[i + 1] = data[i + 2] = value;
        data[i + 3] = 255;
      }
      context.putImageData(image, 0, 0);
      if (!canvas.isConnected) {
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `${this.img.alt}, lit`);
        this.img.after(canvas);
      }
      this.show(true);
    }

    show(light) {
      this.img.hidden = light;
      if (this.kept) this.kept.canvas.hidden = !light;
    }

    at(place) {
      const { normals, width, height } = this.decoded;
      const p = 3 * (Math.min(height - 1, Math.floor(place[1] * height)) * width + Math.min(width - 1, Math.floor(place[0] * width)));
      return normals.slice(p, p + 3);
    }
  }

  const maps = figures.filter((figure) => figure.dataset.kind !== "beside").map((figure) => new NormalMap(figure));
  const mapOf = new WeakMap(maps.map((map) => [map.figure, map]));

  // The pointer's place in a picture, from (0, 0) to (1, 1), whatever room object-fit leaves around it.
  function placeIn(figure, event) {
    const picture = [...figure.querySelectorAll("img, canvas")].find((one) => !one.hidden), box = picture.getBoundingClientRect();
    const [w, h] = picture.tagName === "IMG" ? [picture.naturalWidth, picture.naturalHeight] : [picture.width, picture.height];
    const scale = Math.min(box.width / w, box.height / h);
    return { box, scale, w, h, place: [
      (event.clientX - box.left - (box.width - scale * w) / 2) / (scale * w),
      (event.clientY - box.top - (box.height - scale * h) / 2) / (scale * h)] };
  }

  function light() {
    const [a, b] = [around.value * RADIANS, away.value * RADIANS];
    return [Math.cos(a) * Math.sin(b), Math.sin(a) * Math.sin(b), Math.cos(b)];
  }

  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      for (const map of maps) {
        if (!lit.checked) map.show(false);
        else if (map.visible) map.draw(light());
      }
    });
  }

  function point(place) {
    const [x, y] = [2 * place[0] - 1, 1 - 2 * place[1]];
    around.value = Math.round(Math.atan2(y, x) / RADIANS);
    away.value = Math.round(Math.asin(Math.min(1, Math.hypot(x, y))) / RADIANS);
    lit.checked = true;
    redraw();
  }

  function angle(a, b) {
    return Math.acos(Math.min(1, Math.max(-1, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]))) / RADIANS;
  }

  function show(strip, truth, event) {
    const { place } = placeIn(event.currentTarget, event), inside = place.every((v) => v >= 0 && v < 1);
    const wanted = inside ? mapOf.get(truth).at(place) : null;
    for (const figure of strip.querySelectorAll("figure[data-kind]")) mark(figure, inside ? place : null);
    if (!inside) return;
    const texts = wanted.some(Boolean) ? [...strip.querySelectorAll('figure[data-kind="normals"]')].map((figure) => {
      const name = figure.querySelector("img").alt.replace(/^normals, /, "");
      return `${name}: ${angle(wanted, mapOf.get(figure).at(place)).toFixed(1)}°`;
    }) : ["outside the mask"];
    strip.readout.textContent = `Error under the pointer: ${texts.join(", ")}`;
  }

  function mark(figure, place) {
    let dot = figure.querySelector(".mark");
    if (!dot) {
      dot = document.createElement("span");
      dot.className = "mark";
      figure.append(dot);
    }
    dot.hidden = !place;
    if (!place) return;
    const { box, scale, w, h } = placeIn(figure, { clientX: 0, clientY: 0 }), outer = figure.getBoundingClientRect();
    dot.style.left = `${box.left - outer.left + (box.width - scale * w) / 2 + place[0] * scale * w}px`;
    dot.style.top = `${box.top - outer.top + (box.height - scale * h) / 2 + place[1] * scale * h}px`;
  }

  for (const map of maps) {
    map.figure.addEventListener("pointerdown", (event) => {
      map.figure.setPointerCapture(event.pointerId);
      point(placeIn(map.figure, event).place);
    });
    map.figure.addEventListener("pointermove", (event) => {
      if (map.figure.hasPointerCapture(event.pointerId)) point(placeIn(map.figure, event).place);
    });
    map.img.draggable = false;
  }
  for (const strip of document.querySelectorAll(".strip")) {
    const truth = strip.querySelector('figure[data-kind="truth"]');
    if (!truth || !strip.querySelector('figure[data-kind="normals"]')) continue;
    strip.readout = document.createElement("p");
    strip.readout.className = "note readout";
    strip.readout.textContent = "Point at a picture: the error there, to half a degree.";
    strip.after(strip.readout);
    for (const figure of strip.querySelectorAll("figure[data-kind]")) {
      figure.addEventListener("pointermove", (event) => show(strip, truth, event));
      figure.addEventListener("pointerleave", () => strip.querySelectorAll("figure[data-kind]").forEach((one) => mark(one, null)));
    }
  }
  for (const input of [around, away]) input.addEventListener("input", () => { lit.checked = true; redraw(); });
  lit.addEventListener("input", redraw);
  const watcher = new IntersectionObserver((seen) => {
    for (const one of seen) mapOf.get(one.target).visible = one.isIntersecting;
    redraw();
  }, { rootMargin: "200px" });
  for (const map of maps) watcher.observe(map.figure);
  bar.hidden = !maps.length;
})();
