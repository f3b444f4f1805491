// A scene under each of its lights, or under any light mixed from those around it. Without this script the page is whole.
// Frame: x right, y up, z to the camera; a light vector points from the surface to the light.
"use strict";
(() => {
  const scenes = JSON.parse(document.getElementById("stages").textContent), viewer = document.getElementById("viewer");
  const find = (name) => viewer.querySelector(`[name=${name}]`), [choice, slider, normals] = ["scene", "image", "normals"].map(find);
  const canvas = viewer.querySelector("canvas"), context = canvas.getContext("2d"), told = viewer.querySelector("output");
  const disc = viewer.querySelector("svg"), dots = disc.querySelector("g"), dot = disc.querySelector(".dot");
  const LINEAR = Float32Array.from({ length: 256 }, (_, i) => (i <= 10 ? i / 255 / 12.92 : ((i / 255 + 0.055) / 1.055) ** 2.4));
  let scene = null, light = null; // light: a direction that was dragged to; null: the image of the slider

  function show(number) {
    const img = new Image();
    img.onload = () => {
      const sheet = document.createElement("canvas");
      [sheet.width, sheet.height] = [img.width, img.height];
      const drawn = sheet.getContext("2d", { willReadFrequently: true });
      drawn.drawImage(img, 0, 0);
      scene = { ...scenes[number], drawn, cells: new Map() };
      [canvas.width, canvas.height] = [scene.width, scene.height];
      canvas.setAttribute("aria-label", scene.caption);
      slider.max = scene.lights.length;
      slider.value = 1 + scene.lights.reduce((best, [, , z], k) => (z > scene.lights[best][2] ? k : best), 0);
      dots.replaceChildren(...scene.lights.map(([x, y]) => circle(x, y)));
      light = null;
      draw();
    };
    img.src = scenes[number].sheet;
  }

  function circle(x, y) {
    const one = document.createElementNS("http://www.w3.org/2000/svg", "circle");
    for (const [name, value] of Object.entries({ cx: x, cy: -y, r: 0.022 })) one.setAttribute(name, value);
    return one;
  }

  // Cell 0 of the sheet shows the normals, cell k the scene under light k.
  function cell(k) {
    if (!scene.cells.has(k)) {
      const { columns, width, height } = scene;
      scene.cells.set(k, scene.drawn.getImageData((k % columns) * width, Math.floor(k / columns) * height, width, height));
    }
    return scene.cells.get(k);
  }

  // Lights around a direction, with weights that fall with the angle; their spacing on the hemisphere sets how fast.
  function around([x, y, z]) {
    const spread = Math.sqrt(2 * Math.PI / scene.lights.length) * 0.6;
    const near = scene.lights.map((l, k) => [k + 1, Math.acos(Math.min(1, x * l[0] + y * l[1] + z * l[2]))]).sort((a, b) => a[1] - b[1]).slice(0, 5);
    const weights = near.map(([k, angle]) => [k, Math.exp(-((angle ** 2 - near[0][1] ** 2) / spread ** 2))]), sum = weights.reduce((total, [, w]) => total + w, 0);
    return weights.map(([k, w]) => [k, w / sum]);
  }

  function mixed() {
    const sum = new Float32Array(4 * scene.width * scene.height), image = context.createImageData(scene.width, scene.height);
    for (const [k, weight] of around(light)) {
      const { data } = cell(k);
      for (let i = 0; i < sum.length; i++) sum[i] += weight * LINEAR[data[i]];
    }
    for (let i = 0; i < sum.length; i++) {
      const v = sum[i];
      image.data[i] = i % 4 === 3 ? 255 : 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
    }
    return image;
  }

  let waiting = false;
  function draw() {
    if (waiting || !scene) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const number = Number(slider.value), [x, y, z] = light ?? scene.lights[number - 1];
      context.putImageData(normals.checked ? cell(0) : light ? mixed() : cell(number), 0, 0);
      dot.setAttribute("cx", x);
      dot.setAttribute("cy", -y);
      const height = Math.round(Math.asin(Math.min(1, z)) * 180 / Math.PI), which = light ? "mixed from the images around" : `image ${number} of ${scene.lights.length}`;
      told.textContent = `${which}; light (${[x, y, z].map((v) => v.toFixed(2)).join(", ")}), ${height} degrees above the image plane`;
    });
  }

  for (const target of [canvas, disc]) {
    const follow = (event) => {
      const box = target.getBoundingClientRect(), most = 0.995;
      let x = 2 * (event.clientX - box.left) / box.width - 1, y = 1 - 2 * (event.clientY - box.top) / box.height;
      if (target === disc) [x, y] = [1.1 * x, 1.1 * y];
      const length = Math.hypot(x, y);
      if (length > most) [x, y] = [x / length * most, y / length * most];
      light = [x, y, Math.sqrt(1 - x * x - y * y)];
      normals.checked = false;
      draw();
    };
    target.addEventListener("pointerdown", (event) => { target.setPointerCapture(event.pointerId); follow(event); });
    target.addEventListener("pointermove", (event) => { if (target.hasPointerCapture(event.pointerId)) follow(event); });
  }
  choice.append(...scenes.map(({ caption }, k) => new Option(caption, k)));
  choice.addEventListener("change", () => show(Number(choice.value)));
  slider.addEventListener("input", () => { light = null; normals.checked = false; draw(); });
  normals.addEventListener("input", draw);
  viewer.hidden = false;
  show(0);
})();
