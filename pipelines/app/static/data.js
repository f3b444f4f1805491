// The page "Data and runs".

import { $, ask, element, follow, inTab, showError } from "./jobs.js";
import { LightStage } from "./light_stage.js";
import { LightPad } from "./relight.js";

const state = { folder: null, rows: [], shown: 60, stage: null, pad: null, timer: null };
const query = (path, values = {}) => `/data/${path}?${new URLSearchParams({ folder: state.folder, ...values })}`;

async function begin() {
  const { root, rows } = await ask("/data/list");
  $("root").textContent = rows.length ? `Contents of ${root}.` : `${root} contains neither data folders nor runs. Render scenes (sdps render-data), or choose another folder: sdps app FOLDER.`;
  $("folders").replaceChildren(...rows.map(({ folder, kind }) => {
    const button = element("button", { type: "button", "aria-pressed": "false" }, `${kind}: ${folder === "." ? root.split("/").pop() || root : folder}`);
    button.addEventListener("click", () => {
      for (const other of $("folders").children) other.setAttribute("aria-pressed", other === button);
      open(folder, kind);
    });
    return button;
  }));
}

async function open(folder, kind) {
  state.folder = folder;
  clearTimeout(state.timer);
  for (const id of ["scenes", "curves", "results", "status", "lamp-card", "lamp-status"]) $(id).hidden = true;
  try {
    if (kind === "data") await showScenes();
    else { await showCurves(folder); await showResults(); }
  } catch (error) { showError($("status"), error); }
}

// ---- Scenes ----

async function showScenes() {
  state.rows = await ask(query("scenes"));
  state.shown = 60;
  const count = (name) => state.rows.filter((row) => row.state === name).length;
  const facts = [`${state.rows.length} scenes`, `${count("rendered")} rendered`, `${count("planned")} to render`, `${count("failed")} failed`];
  $("counts").replaceChildren(...facts.map((text) => element("span", {}, text)));
  $("scenes").hidden = false;
  drawTiles();
}

function listMatching() {
  const words = $("find").value.toLowerCase().split(/\s+/).filter(Boolean), key = $("sort").value;
  const rows = state.rows.filter((row) => words.every((word) => `${row.id} ${row.shape} ${row.material} ${row.split} ${row.state}`.toLowerCase().includes(word)));
  const order = { failed: 0, rendered: 1, planned: 2 }, planned = (row) => row.state === "planned"; // scenes with a picture come first
  return rows.sort((one, two) => planned(one) - planned(two) || (key === "radiance" ? (two.radiance ?? -1) - (one.radiance ?? -1)
    : key === "state" ? order[one.state] - order[two.state] : one[key].localeCompare(two[key], "en", { numeric: true })));
}

const seen = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) if (isIntersecting) { seen.unobserve(target); fill(target.row, target); }
}, { rootMargin: "200px" });

async function measure(row) {
  if (row.picture || row.state !== "rendered") return;
  try { Object.assign(row, await ask(query("scene", { id: row.id }))); } catch (error) { row.reason = error.message; }
}

async function fill(row, figure) {
  await measure(row);
  if (row.picture) figure.querySelector("img").src = row.picture;
  figure.querySelector(".note").textContent = (row.radiance ?? null) === null ? row.reason || row.state : `mean radiance ${row.radiance.toFixed(3)}`;
}

function drawTiles() {
  const rows = listMatching(), some = rows.slice(0, state.shown);
  $("tiles").replaceChildren(...some.map((row) => {
    const button = element("button", { type: "button", class: "scene", disabled: row.state !== "rendered" },
      element("img", { alt: "", width: 384, height: 96 }), element("span", {}, `${row.id}: ${row.shape}, ${row.material} (${row.split})`), element("span", { class: "note" }, row.reason || row.state));
    button.row = row;
    button.addEventListener("click", () => showUnderLamp(row));
    seen.observe(button);
    return button;
  }));
  $("more").hidden = rows.length <= state.shown;
}

async function showUnderLamp(row) {
  try {
    const about = await follow(await ask(inTab(query("start", { id: row.id })), { method: "POST" }), $("lamp-status"), "Scene");
    if (!about) return;
    const [basis, truth] = await Promise.all(["basis.bin", "truth.bin"].map(async (name) => (await fetch(inTab(`/data/files/${name}`))).arrayBuffer()));
    state.stage = new LightStage(basis, truth, about);
    $("lamp-title").textContent = `${row.id}: ${row.shape}, ${row.material}`;
    $("lamp-card").hidden = false;
    $("scrub").max = about.lights.length - 1;
    state.pad = new LightPad($("lamp"), $("view"), (direction) => state.stage.draw($("view"), direction, $("overlay").value), about.lights);
    showLight();
    $("lamp-card").scrollIntoView({ behavior: "smooth", block: "center" });
  } catch (error) { showError($("lamp-status"), error); }
}

function showLight() {
  const number = Number($("scrub").value), [x, y, z] = state.stage.about.lights[number];
  state.pad.set(x, y);
  $("scrub-note").textContent = `Light ${number + 1} of ${state.stage.about.lights.length}: ${[x, y, z].map((v) => v.toFixed(3)).join(", ")}. Between the lights, images are blended.`;
}

// ---- Learning curves ----

const COLOURS = ["#3b6fb6", "#d2691e", "#2e8b57", "#a03070", "#7a6a00", "#606060"];

async function showCurves(folder) {
  const models = await ask(query("curves"));
  if (state.folder !== folder) return;
  const keys = [...new Set(Object.values(models).flatMap((series) => Object.keys(series)))].sort();
  $("curves").hidden = !keys.length;
  $("charts").replaceChildren(...keys.map((key) => drawChart(key, Object.entries(models).filter(([, series]) => series[key]).map(([name, series]) => [name, series[key]]))));
  state.timer = setTimeout(() => { if (state.folder === folder && !document.hidden) showCurves(folder).catch(() => {}); else state.timer = setTimeout(() => showCurves(folder), 5000); }, 5000);
}

function drawChart(key, lines) {
  const points = lines.flatMap(([, values]) => values), most = Math.max(...points.map(([step]) => step), 1);
  const high = Math.max(...points.map(([, v]) => v)), low = Math.min(0, ...points.map(([, v]) => v)), x = (s) => 12 + 86 * s / most, y = (v) => 54 - 50 * (v - low) / Math.max(high - low, 1e-9);
  const text = (at, up, words, anchor) => element("text", { x: at, y: up, "font-size": 3.6, "text-anchor": anchor, fill: "currentColor" }, words);
  const svg = element("svg", { viewBox: "0 0 100 62", role: "img", "aria-label": `${key.replaceAll("_", " ")} over steps, last ${lines.map(([name, values]) => `${name} ${values.at(-1)[1].toFixed(3)}`).join(", ")}` },
    element("line", { x1: 12, x2: 98, y1: 54, y2: 54, stroke: "currentColor", "stroke-width": 0.3 }), text(11, 6, high.toPrecision(3), "end"), text(11, 54, low.toPrecision(2), "end"), text(98, 59, `step ${most.toLocaleString("en")}`, "end"));
  lines.forEach(([, values], k) => svg.append(element("polyline", { points: values.map(([s, v]) => `${x(s).toFixed(2)},${y(v).toFixed(2)}`).join(" "), fill: "none", stroke: COLOURS[k % COLOURS.length], "stroke-width": 0.7 })));
  const legend = lines.map(([name, values], k) => element("span", {}, element("i", { class: "key", style: `background:${COLOURS[k % COLOURS.length]}` }), `${name}: ${values.at(-1)[1].toFixed(3)}`));
  return element("article", { class: "card" }, element("h3", {}, key.replaceAll("_", " ")), svg, element("p", { class: "facts" }, ...legend));
}

// ---- Results ----

async function showResults() {
  const sections = await ask(query("sections"));
  $("results").hidden = !sections.length;
  $("tables").replaceChildren(...sections.map((section) => element("article", {}, element("h3", {}, section.title), element("p", { class: "note" }, section.text), ...section.tables.map(buildTable),
    ...section.strips.map((strip) => element("figure", {}, element("figcaption", {}, strip.title), element("div", { class: "thumbs", tabindex: 0, role: "group", "aria-label": strip.title },
      ...strip.pictures.map(({ file, caption }) => element("figure", { class: "large" }, element("img", { src: query("picture", { section: section.name, file }), alt: caption, loading: "lazy" }), element("figcaption", {}, caption)))))))));
}

function buildTable({ title, header, rows, note }) {
  const body = element("tbody"), number = (text) => Number.parseFloat(text);
  const show = (list) => body.replaceChildren(...list.map((cells) => element("tr", {}, ...cells.map((cell) => element("td", { class: Number.isNaN(number(cell)) ? "" : "number" }, cell)))));
  let last = null;
  const heads = header.map((name, column) => {
    const button = element("button", { type: "button" }, name);
    button.addEventListener("click", () => {
      const down = last !== column;
      last = down ? column : null;
      const sorted = [...rows].sort((one, two) => Number.isNaN(number(one[column])) || Number.isNaN(number(two[column])) ? one[column].localeCompare(two[column]) : number(two[column]) - number(one[column]));
      show(down ? sorted : sorted.reverse());
      for (const [k, other] of heads.entries()) other.setAttribute("aria-sort", k === column ? (down ? "descending" : "ascending") : "none");
    });
    return element("th", { scope: "col" }, button);
  });
  show(rows);
  return element("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": title }, element("table", {}, element("caption", {}, title), element("thead", {}, element("tr", {}, ...heads)), body), note ? element("p", { class: "note" }, note) : "");
}

// ---- Wiring ----

$("find").addEventListener("input", () => { state.shown = 60; drawTiles(); });
$("sort").addEventListener("change", async () => {
  if ($("sort").value === "radiance") for (const row of listMatching().slice(0, 300)) await measure(row);
  drawTiles();
});
$("more").addEventListener("click", () => { state.shown += 120; drawTiles(); });
$("scrub").addEventListener("input", showLight);
$("overlay").addEventListener("change", () => state.pad?.show());
begin().catch((error) => showError($("status"), error));
