// The page "Photographs".

import { BallCircles } from "./ball_circles.js";
import { $, ask, element, follow, post, seconds, showError } from "./jobs.js";
import { MaskPainter } from "./mask_painter.js";
import { MeshView } from "./mesh_view.js";
import { LightPad, Reflectance } from "./relight.js";

const state = { set: null, checked: null, runs: [], run: null, mesh: null, told: 0, alone: 0, alones: 0 };
const painter = new MaskPainter($("mask"), () => { $("mask-use").disabled = $("mask-reset").disabled = false; });
const balls = new BallCircles($("ball-circles"), $("mask"), $("balls"), () => { $("ball-use").disabled = false; });
const inSet = (path) => `/photographs/sets/${state.set}/${path}`;

// ---- Loading ----

async function begin() {
  state.set = (await post("/photographs/sets")).set;
  state.runs = [];
  balls.balls = [];
  state.alone = state.alones = 0;
  for (const id of ["pose", "ambient", "dark"]) $(id).replaceChildren();
  $("every").value = "";
  for (const id of ["review", "choose", "results"]) $(id).hidden = true;
}

// Load photographs, which begins a new set, or pictures of a ball alone.
async function upload(files, alone = false) {
  const box = $("load-status");
  try {
    if (!files.length) throw new Error("none of the chosen files can be used");
    if (!alone) await begin();
    const place = alone ? `ball/${state.alones += 1}` : "uploads";
    const bar = element("progress", { max: files.length, value: 0, "aria-label": "Uploading" });
    box.className = "status";
    box.replaceChildren(`Loading ${files.length} file${files.length > 1 ? "s" : ""}`, bar);
    box.hidden = false;
    for (const file of files) {
      await ask(inSet(`${place}/${encodeURIComponent(file.place || file.webkitRelativePath || file.name)}`), { method: "PUT", body: file });
      bar.value += 1;
    }
    if (alone) state.alone = state.alones;
    await check();
  } catch (error) { showError(box, error); }
}

async function example() {
  const box = $("load-status");
  $("example").disabled = true;
  try {
    await begin();
    const found = await follow(await post(inSet("start/example"), options()), box, "Example");
    if (found) review(found);
  } catch (error) { showError(box, error); }
  $("example").disabled = false;
}

const USABLE = $("files").accept.split(",");
const filterUsable = (files) => [...files].filter(({ name }) => USABLE.some((suffix) => name.toLowerCase().endsWith(suffix)) && !name.startsWith("."));

async function listDropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  const files = [];
  const walk = async (entry) => {
    if (entry.isFile) files.push(Object.assign(await new Promise((resolve, reject) => entry.file(resolve, reject)), { place: entry.fullPath.slice(1) }));
    else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
        if (!some.length) break;
        for (const child of some) await walk(child);
      }
    }
  };
  for (const entry of entries) await walk(entry);
  return filterUsable(entries.length ? files : transfer.files);
}

// ---- Checks and mask ----

const TICKED = ["lights", "refine", "discontinuities", "anyway"];
const ANSWERED = ["method", "gamma", "frame", "scale", "flat", "flatten", "ambient", "dark", "focal", "principal", "intensities", "every", "pose"];

// Return the answers to all questions of the page, as the server reads them.
const options = () => ({
  ...Object.fromEntries([...TICKED.map((id) => [id, $(id).checked]), ...ANSWERED.map((id) => [id, $(id).value])]),
  lit_by: $("lit-by").value, pixel_size: $("pixel-size").value, ball_radius: $("ball-radius").value, light_distance: $("light-distance").value || $("distance").value, balls: balls.values(), ball_alone: state.alone || "",
});

async function check(more = {}, box = $("load-status")) {
  try {
    const told = state.told;
    const found = await follow(await post(inSet("start/check"), { ...options(), ...more }), box, "Checks");
    if (found) review(found, box === $("load-status"));
    if (found && told !== state.told) doubt(); // answers changed meanwhile
  } catch (error) { showError(box, error); }
}

function fillSelect(id, rows) {
  const chosen = $(id).value;
  $(id).replaceChildren(...rows.map(([value, text]) => element("option", { value }, text)));
  if (rows.some(([value]) => value === chosen)) $(id).value = chosen;
}

const listFindings = ({ findings, files }) => findings.map(({ level, text, images }) => element("li", { class: level }, element("b", {}, `${level}: `), text,
  images.length && images.length < files.length ? element("span", { class: "note" }, ` (${images.slice(0, 6).join(", ")}${images.length > 6 ? ", ..." : ""})`) : ""));

// Say what a run would do, or what would stop it.
function foresee(found) {
  $("trouble").hidden = !found.trouble;
  $("trouble").textContent = found.trouble;
  $("work").replaceChildren(...found.work.flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]));
  $("work").classList.remove("old");
  $("foresee").disabled = true;
}

function doubt() {
  state.told += 1;
  $("foresee").disabled = false;
  $("work").classList.add("old");
}

function review(found, first = true) {
  state.checked = found;
  const about = [`${found.files.length} photographs`, `${found.width} x ${found.height} pixels`, `${found.bits} bits`, `curve: ${found.gamma}`, `mask: ${found.mask}, ${found.pixels.toLocaleString("en")} pixels`];
  $("facts").replaceChildren(...about.map((text) => element("span", {}, text)));
  const marked = new Set(found.findings.flatMap((finding) => finding.images));
  const stamp = Date.now();
  $("thumbs").replaceChildren(...found.files.map((name, number) => element("figure", { class: marked.has(name) ? "marked" : "" },
    element("img", { src: inSet(`files/view/${number}.jpg?${stamp}`), alt: name, loading: "lazy" }), element("figcaption", { title: name }, name))));
  $("findings").replaceChildren(...(found.findings.length ? listFindings(found) : [element("li", {}, "No problems found.")]));
  $("notes").replaceChildren(...found.notes.map((note) => element("li", {}, note)));
  $("lights-row").hidden = !found.lights_there;
  fillSelect("method", found.methods.map(({ name }) => [name, name === "auto" ? "recommended" : name]));
  describeMethod();
  fillSelect("pose", found.poses.map((name) => [name, name]));
  $("pose-row").hidden = $("all-poses").hidden = found.poses.length < 2;
  $("every-row").hidden = !found.film;
  for (const [id, word] of [["ambient", "ambient"], ["dark", "dark"]]) fillSelect(id, [["", `by its name ("${word}")`], ["none", "none"], ...found.pictures.map((name) => [name, name])]);
  foresee(found);
  painter.load(inSet(`files/view/picture.jpg?${stamp}`), inSet(`files/view/mask.png?${stamp}`));
  balls.load(found.width, found.height, found.balls);
  $("ball-alone").hidden = !state.alone;
  $("ball-alone").firstChild.textContent = `The lights are those of a ${found.ball_alone} ball in pictures of its own.`;
  $("mask-use").disabled = $("ball-use").disabled = true;
  $("mask-reset").disabled = found.mask !== "painted";
  $("review").hidden = $("choose").hidden = false;
  if (first) $("review").scrollIntoView({ behavior: "smooth" });
}

function describeMethod() { $("method-about").textContent = state.checked.methods.find(({ name }) => name === $("method").value)?.about ?? ""; }

async function sendMask(blob) {
  try {
    await ask(inSet("mask"), { method: "PUT", body: blob });
    await check();
  } catch (error) { showError($("load-status"), error); }
}

// ---- Inference ----

async function infer(event) {
  event.preventDefault();
  $("start").disabled = true;
  const poses = event.submitter === $("all-poses") ? state.checked.poses : [$("pose").value];
  try {
    if (!$("mask-use").disabled) await ask(inSet("mask"), { method: "PUT", body: await painter.blob() });
    for (const pose of poses) {
      const found = await follow(await post(inSet("start/infer"), { ...options(), pose }), $("run-status"), poses.length > 1 ? `Pose ${pose}` : "Surface");
      if (!found) break;
      state.runs.push(found);
      await show(found);
    }
    if (state.runs.length) $("results").scrollIntoView({ behavior: "smooth" });
  } catch (error) { showError($("run-status"), error); }
  $("start").disabled = false;
}

// ---- Results ----

const inRun = (path, run = state.run) => inSet(`files/runs/${run.number}/view/${path}`);

const nameRun = (run) => `${run.number}. ${run.pose ? `${run.pose}, ` : ""}${run.method}`;

async function show(run) {
  state.run = run;
  $("results").hidden = false;
  $("runs").replaceChildren(...state.runs.map((other) => {
    const button = element("button", { type: "button", "aria-pressed": String(other === run) }, nameRun(other));
    button.addEventListener("click", () => show(other));
    return button;
  }));
  const facts = [];
  if (run.expected !== null) facts.push(`normals are probably off by ${run.expected.toFixed(1)}°`);
  if (run.error !== null) facts.push(`they are off by ${run.error.toFixed(1)}°: the truth is known here`);
  if (run.lamps) facts.push(run.lamps);
  if (run.camera?.startsWith("perspective")) facts.push(`camera: ${run.camera}`);
  facts.push(`normals and surface disagree by ${run.integrability.toFixed(1)}°`);
  if (run.residual !== null) facts.push(`${Math.round(100 * run.residual)} % of the brightness is not that of a matt surface`);
  if (run.components > 1) facts.push(`${run.components} parts`);
  facts.push(`took ${seconds(run.seconds)}`);
  $("verdict").hidden = !run.verdict;
  $("verdict").textContent = run.verdict;
  $("run-facts").replaceChildren(...facts.map((text) => element("span", {}, text)), ...(run.terms ? [element("span", {}, `weights: ${run.terms}`)] : []));
  $("run-findings").replaceChildren(...listFindings(run));
  $("download").href = inSet(`runs/${run.number}/download`);
  $("report").href = inSet(`files/runs/${run.number}/files/report.html`);
  listExports(run);
  $("normals").src = inRun("normals.png");
  $("depth").src = inRun("depth.png");
  const [basis, tables] = await Promise.all([inRun("basis.bin"), run.tables && inRun("tables.bin")].map(async (address) => address && (await fetch(address)).arrayBuffer()));
  const object = new Reflectance(basis, run, tables);
  if (state.run !== run) return;
  new LightPad($("relit-light"), $("relit"), (light) => object.draw($("relit"), light), run.lights);
  drawLights(run);
  $("cross").hidden = true;
  $("chart").replaceChildren();
  compare();
  try {
    state.mesh ??= new MeshView($("mesh"));
    await state.mesh.load(inRun("mesh.ply"));
  } catch (error) { $("mesh").replaceChildren(element("p", { class: "note" }, `The surface cannot be shown here: ${error.message}`)); }
}

// ---- For other programs ----

function listExports(run) {
  $("export-status").hidden = true;
  $("exports").replaceChildren(...run.exports.map(({ name, who, what }) => {
    const button = element("button", { type: "button", class: "secondary", "aria-label": `Get ${what} for ${who}` }, "Get");
    const row = element("li", {}, element("p", {}, element("b", {}, who), element("span", {}, what)), button);
    button.addEventListener("click", () => takeAway(run, name, row, button));
    return row;
  }));
}

async function takeAway(run, name, row, button) {
  row.querySelector(".finding")?.remove();
  button.disabled = true;
  try {
    const made = await follow(await post(inSet("start/export"), { run: run.number, name }), $("export-status"), "Export");
    if (made) element("a", { href: inSet(`files/runs/${run.number}/${made.file}`), download: made.name }).click();
  } catch (error) {
    $("export-status").hidden = true;
    row.append(element("p", { class: "finding error", role: "alert" }, error.message));
  }
  button.disabled = false;
}

function drawLights(run) {
  if (!run.lights.length) {
    $("sphere").replaceChildren();
    $("sphere-note").textContent = "This method does not find lights.";
    return;
  }
  const strongest = Math.max(...run.intensities);
  const svg = element("svg", { viewBox: "-1.08 -1.08 2.16 2.16", role: "img", "aria-label": `${run.lights.length} lights on the hemisphere` },
    element("circle", { r: 1, fill: "none", stroke: "currentColor", "stroke-width": 0.008 }),
    ...[30, 60].map((angle) => element("circle", { r: Math.sin(angle * Math.PI / 180), fill: "none", stroke: "currentColor", "stroke-width": 0.004, "stroke-dasharray": "0.02 0.03" })));
  run.lights.forEach(([x, y], number) => {
    const part = run.intensities[number] / strongest, sure = run.confidence.length ? run.confidence[number] : 1;
    const text = `${run.files[number]}: intensity ${part.toFixed(2)}${run.confidence.length ? `, confidence ${sure.toFixed(2)}` : ""}${run.distances?.length ? `, ${run.distances[number] ?? "over 50"} object sizes away` : ""}`;
    svg.append(element("circle", { class: "light", cx: x, cy: -y, r: 0.02 + 0.03 * Math.sqrt(part), fill: `hsl(${45 - 20 * (1 - part)} 95% ${35 + 25 * part}%)`, stroke: "currentColor", "stroke-width": 0.008, "fill-opacity": 0.25 + 0.75 * Math.min(1, sure) }, element("title", {}, text)));
  });
  $("sphere").replaceChildren(svg);
  $("sphere-note").textContent = `Seen from the camera; rings at 30° and 60°. Larger: stronger.${run.confidence.length ? " Fainter: less certain." : ""}${run.lamps ? ` ${run.lamps[0].toUpperCase()}${run.lamps.slice(1)}.` : ""}`;
}

// ---- A pixel's intensities ----

let pixel = null, asking = false;

function inspectPointed(event) {
  const image = $("normals"), box = image.getBoundingClientRect(), { width, height } = state.run;
  const scale = Math.min(box.width / width, box.height / height);
  const column = Math.floor((event.clientX - box.left - (box.width - width * scale) / 2) / scale);
  const row = Math.floor((event.clientY - box.top - (box.height - height * scale) / 2) / scale);
  if (column >= 0 && row >= 0 && column < width && row < height) inspect(row, column);
}

async function inspect(row, column) {
  pixel = [row, column];
  const image = $("normals"), { width, height } = state.run, scale = Math.min(image.clientWidth / width, image.clientHeight / height);
  $("cross").style.left = `${(image.clientWidth - width * scale) / 2 + (column + 0.5) * scale}px`;
  $("cross").style.top = `${(image.clientHeight - height * scale) / 2 + (row + 0.5) * scale}px`;
  $("cross").hidden = false;
  if (asking) return;
  asking = true;
  try {
    do {
      const [wanted, run] = [pixel, state.run];
      drawChart(await ask(inSet(`runs/${run.number}/pixel?row=${wanted[0]}&column=${wanted[1]}`)), wanted, run);
      if (wanted === pixel) break;
    } while (true);
  } catch { /* the run was removed */ }
  asking = false;
}

function drawChart({ observed, model }, [row, column], run) {
  const most = Math.max(...observed, ...(model ?? []), 1e-6), x = (i) => 4 + 92 * i / Math.max(1, observed.length - 1), y = (v) => 56 - 52 * v / most;
  const svg = element("svg", { viewBox: "0 0 100 62", role: "img", "aria-label": `Intensities of pixel row ${row * run.step}, column ${column * run.step}` }, element("line", { x1: 4, x2: 96, y1: 56, y2: 56, stroke: "currentColor", "stroke-width": 0.3 }));
  if (model) svg.append(element("polyline", { points: model.map((v, i) => `${x(i)},${y(v)}`).join(" "), fill: "none", stroke: "var(--accent)", "stroke-width": 0.7 }));
  observed.forEach((v, i) => svg.append(element("circle", { cx: x(i), cy: y(v), r: 0.9, fill: "#e0702c" }, element("title", {}, `${run.files[i]}: ${v.toFixed(4)}`))));
  $("chart").replaceChildren(svg);
  $("chart-note").textContent = `Row ${row * run.step}, column ${column * run.step}. Dots: the photographs, in order; ${model ? `line: computed ${run.tables ? "from what was found" : "for a matt surface"}. ` : ""}Highest: ${most.toFixed(3)}.`;
}

// ---- Comparison ----

function compare() {
  $("compare-card").hidden = state.runs.length < 2;
  if (state.runs.length < 2) return;
  for (const [id, offset] of [["left", 1], ["right", 0]]) {
    $(id).replaceChildren(...state.runs.map((run, place) => element("option", { value: place + 1 }, nameRun(run))));
    $(id).value = state.runs.length - offset;
  }
  showCompared();
}

function showCompared() {
  for (const id of ["left", "right"]) $(`${id}-image`).src = inRun(`${$("kind").value}.png`, state.runs[$(id).value - 1]);
  divide();
}

function divide() {
  const part = $("divide").value;
  $("right-image").style.clipPath = `inset(0 0 0 ${part}%)`;
  $("divider").style.left = `${part}%`;
}

// ---- Wiring ----

$("choose-files").addEventListener("click", () => $("files").click());
$("choose-folder").addEventListener("click", () => $("folder").click());
for (const id of ["files", "folder"]) $(id).addEventListener("change", () => { const chosen = filterUsable($(id).files); $(id).value = ""; upload(chosen); });
$("example").addEventListener("click", example);
$("drop").addEventListener("dragover", (event) => { event.preventDefault(); $("drop").classList.add("over"); });
$("drop").addEventListener("dragleave", () => $("drop").classList.remove("over"));
$("drop").addEventListener("drop", async (event) => { event.preventDefault(); $("drop").classList.remove("over"); upload(await listDropped(event.dataTransfer)); });
for (const [id, adding] of [["brush-add", true], ["brush-take", false]]) $(id).addEventListener("click", () => {
  painter.adding = adding;
  $("brush-add").setAttribute("aria-pressed", adding);
  $("brush-take").setAttribute("aria-pressed", !adding);
});
$("brush-size").addEventListener("input", () => { painter.radius = Number($("brush-size").value); });
$("mask-use").addEventListener("click", async () => sendMask(await painter.blob()));
$("mask-reset").addEventListener("click", () => sendMask(new Blob([])));
$("ball-find").addEventListener("click", () => check({ balls: ["auto"] }));
$("ball-add").addEventListener("click", () => balls.add());
$("ball-load").addEventListener("click", () => $("ball-files").click());
$("ball-files").addEventListener("change", () => { const chosen = filterUsable($("ball-files").files); $("ball-files").value = ""; upload(chosen, true); });
$("ball-leave").addEventListener("click", () => { state.alone = 0; check(); });
$("ball-use").addEventListener("click", () => check());
$("method").addEventListener("change", describeMethod);
$("foresee").addEventListener("click", () => check({}, $("run-status")));
for (const id of ["pose", "every"]) $(id).addEventListener("change", () => check());
$("form").addEventListener("input", doubt);
for (const id of ["gamma", "lights", "frame"]) $(id).addEventListener("change", () => { if (id !== "frame" || $("lights").checked) check({}, $("run-status")); });
$("light-distance").addEventListener("change", () => { $("distance").hidden = $("distance-note").hidden = $("light-distance").value !== ""; });
$("form").addEventListener("submit", infer);
const hover = $("normals").parentElement;
hover.tabIndex = 0;
hover.setAttribute("role", "group");
hover.setAttribute("aria-label", "Pixels of the normal map; arrow keys move");
hover.addEventListener("pointermove", inspectPointed);
hover.addEventListener("pointerdown", inspectPointed);
hover.addEventListener("keydown", (event) => {
  const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
  if (!step) return;
  event.preventDefault();
  const { width, height } = state.run, [row, column] = pixel ?? [height >> 1, width >> 1], by = event.shiftKey ? 10 : 1;
  inspect(Math.min(height - 1, Math.max(0, row + by * step[0])), Math.min(width - 1, Math.max(0, column + by * step[1])));
});
for (const id of ["left", "right", "kind"]) $(id).addEventListener("change", showCompared);
$("divide").addEventListener("input", divide);
const compared = $("divider").parentElement;
const slide = (event) => { const box = compared.getBoundingClientRect(); $("divide").value = 100 * (event.clientX - box.left) / box.width; divide(); };
compared.addEventListener("pointerdown", (event) => { compared.setPointerCapture(event.pointerId); slide(event); });
compared.addEventListener("pointermove", (event) => { if (compared.hasPointerCapture(event.pointerId)) slide(event); });
