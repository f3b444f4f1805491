// The page "Studio".

import { $, ask, element, follow, inTab, post, showError } from "./jobs.js";
import { LightStage } from "./light_stage.js";
import { LightPad } from "./relight.js";

let scene = null, pad = null, material = "red-phenolic", mesh = null, wanted = 0, shown = 0, busy = false;

function readChoice() {
  const shape = $("shape").value, seeded = shape === "blobby" || shape === "sculpture";
  const numbers = Object.fromEntries(["yaw", "pitch", "roll", "bounces"].map((id) => [id, Number($(id).value)]));
  return { shape: shape === "own" ? mesh : seeded ? `${shape}:${$("seed").value}` : shape, material, ...numbers, size: 256 };
}

// Render the chosen scene; while one is being rendered, only the latest choice waits.
async function render() {
  wanted += 1;
  if (busy) return;
  busy = true;
  while (shown !== wanted) {
    const number = wanted;
    try {
      const began = performance.now(), about = await follow(await post(inTab("/studio/start/scene"), readChoice()), $("status"), "Scene");
      if (about) {
        const [basis, truth] = await Promise.all(["basis.bin", "truth.bin"].map(async (name) => (await fetch(inTab(`/studio/files/${name}`))).arrayBuffer()));
        const light = pad?.direction;
        scene = new LightStage(basis, truth, about);
        $("rate").textContent = `${about.name}: rendered in ${((performance.now() - began) / 1000).toFixed(1)} s`;
        pad = new LightPad($("lamp"), $("view"), draw, about.lights);
        if (light) pad.set(light[0], light[1]);
      }
    } catch (error) { showError($("status"), error); }
    shown = number;
  }
  busy = false;
  if (["shadows", "interreflections"].includes($("overlay").value)) renderDirect();
}

let frames = [];
function draw(light) {
  if (!scene) return;
  const began = performance.now();
  scene.draw($("view"), light, $("overlay").value);
  frames = [...frames.slice(-20), performance.now() - began];
  $("view").dataset.milliseconds = (frames.reduce((sum, value) => sum + value, 0) / frames.length).toFixed(1);
}

// Images without interreflections are rendered when an overlay needs them.
async function renderDirect() {
  const current = scene;
  if (current && !current.direct && Number($("bounces").value) > 0) {
    try {
      if (await follow(await post(inTab("/studio/start/scene"), { ...readChoice(), direct: true }), $("status"), "Direct light"))
        current.direct = new Uint8Array(await (await fetch(inTab("/studio/files/direct.bin"))).arrayBuffer());
    } catch (error) { showError($("status"), error); }
  }
  pad?.show();
}

// ---- Materials ----

async function fillGallery() {
  try {
    const { groups, tile, picture } = await follow(await post("/studio/start/gallery"), $("gallery-status"), "Materials");
    let place = 0;
    const buttons = Object.entries(groups).flatMap(([group, names]) => names.map((name) => {
      const button = element("button", { type: "button", class: "tile", "data-words": `${name} ${group}`, "data-name": name, title: name, "aria-label": name });
      button.style.background = `#000 url(${picture}) -${tile * place++}px 0`;
      button.style.width = button.style.height = `${tile}px`;
      button.addEventListener("click", () => choose(name));
      return button;
    }));
    $("gallery").replaceChildren(...buttons);
    markChosen();
  } catch (error) { showError($("gallery-status"), error); }
}

function markChosen() { for (const button of $("gallery").children) button.setAttribute("aria-pressed", button.dataset.name === material); }

function choose(name) {
  material = name;
  $("name").value = name;
  markChosen();
  render();
}

$("search").addEventListener("input", () => {
  const words = $("search").value.toLowerCase();
  for (const button of $("gallery").children) button.hidden = !button.dataset.words.includes(words);
});

// ---- Files ----

async function load(input, use) {
  const [file] = input.files;
  input.value = "";
  if (!file) return;
  try {
    const { name } = await ask(`/studio/uploads/${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
    use(name);
  } catch (error) { showError($("status"), error); }
}

$("load-mesh").addEventListener("click", () => $("mesh-file").click());
$("mesh-file").addEventListener("change", () => load($("mesh-file"), (name) => {
  mesh = name;
  $("shape").querySelector("[value=own]")?.remove();
  $("shape").append(element("option", { value: "own" }, name));
  $("shape").value = "own";
  $("seed-row").hidden = true;
  render();
}));
$("load-material").addEventListener("click", () => $("material-file").click());
$("material-file").addEventListener("change", () => load($("material-file"), choose));
$("own").addEventListener("submit", (event) => { event.preventDefault(); choose($("name").value.trim()); });

$("keep").addEventListener("click", async () => {
  try {
    const name = await follow(await post(inTab("/studio/start/keep"), readChoice()), $("keep-status"), "Test scene");
    if (!name) return;
    $("keep-status").hidden = false;
    $("keep-status").replaceChildren(element("a", { class: "button", href: inTab(`/studio/files/${name}`), download: true }, "Download shard, preset and command (ZIP)"));
  } catch (error) { showError($("keep-status"), error); }
});
$("preset").addEventListener("click", async () => {
  try {
    const text = await follow(await post(inTab("/studio/start/preset"), readChoice()), $("keep-status"), "Preset");
    if (!text) return;
    $("preset-text").textContent = text;
    $("preset-out").hidden = false;
  } catch (error) { showError($("keep-status"), error); }
});

// ---- Wiring ----

$("shape").addEventListener("change", () => {
  $("seed-row").hidden = !["blobby", "sculpture"].includes($("shape").value);
  render();
});
$("seed").addEventListener("input", () => { $("seed-value").value = $("seed").value; });
for (const id of ["seed", "yaw", "pitch", "roll", "bounces"]) $(id).addEventListener("change", render);
$("overlay").addEventListener("change", () => { if (["shadows", "interreflections"].includes($("overlay").value)) renderDirect(); else pad?.show(); });
render().then(fillGallery);
