// Shared by all pages: requests, jobs with progress and cancel, small helpers for elements.

export const $ = (id) => document.getElementById(id);

export function element(name, attributes = {}, ...children) {
  const svg = ["svg", "circle", "line", "path", "text", "g", "rect", "title", "polyline", "defs", "radialGradient", "stop"];
  const made = svg.includes(name) ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  made.append(...children);
  return made;
}

export async function ask(path, options = {}) {
  const answer = await fetch(path, options);
  const body = await answer.json().catch(() => ({ message: `the server answered ${answer.status}` }));
  if (!answer.ok) throw new Error(body.message);
  return body;
}

export const post = (path, value = {}) =>
  ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) });

// The address of a file or task of this tab alone, such as its scene. Reloading the page keeps the tab's name.
export function inTab(path) {
  const name = sessionStorage.getItem("tab") ?? Math.random().toString(16).slice(2, 14);
  sessionStorage.setItem("tab", name);
  return `${path}${path.includes("?") ? "&" : "?"}tab=${name}`;
}

export function showError(box, error) {
  box.hidden = false;
  box.className = "status error";
  box.setAttribute("role", "alert");
  box.replaceChildren(error.message ?? String(error));
}

const STAGES = {
  "": "starting", reading: "reading the photographs", checks: "checking the photographs", pictures: "making thumbnails", lights: "finding the lights",
  normals: "finding the normals", refinement: "refining", depth: "building the surface", albedo: "finding the colours", surface: "drawing the surface", meshes: "writing meshes",
  "relit pictures": "relighting", page: "writing the report", export: "writing the files", "second look": "looking a second time",
};

export function seconds(value) {
  if (value === null || value === undefined) return "";
  return value < 90 ? `${Math.max(1, Math.round(value))} s` : `${Math.round(value / 60)} min`;
}

// Show a job in `box` until it ends; resolves to its result, or to null when it was cancelled.
export async function follow(job, box, title) {
  const bar = element("progress", { max: 1, value: 0, "aria-label": title });
  const text = element("span", {}), left = element("span", { class: "note" });
  const cancel = element("button", { type: "button", class: "secondary" }, "Cancel");
  cancel.addEventListener("click", () => { cancel.disabled = true; post(`/jobs/${job.id}/cancel`).catch(() => {}); });
  box.className = "status";
  box.setAttribute("role", "status");
  box.replaceChildren(element("div", { class: "row" }, text, cancel), bar, left);
  box.hidden = false;
  // Nobody waits for a job whose page was closed. A short running one may finish: stopping it would cost a new worker.
  const leave = () => { if (job.state === "queued" || job.task === "infer") navigator.sendBeacon(`/jobs/${job.id}/cancel`); };
  addEventListener("pagehide", leave);
  try { return await waited(); } finally { removeEventListener("pagehide", leave); }

  async function waited() {
    for (;;) {
      if (job.state === "queued") text.textContent = job.before ? `${title}: waiting for ${job.before} job${job.before > 1 ? "s" : ""}` : `${title}: starting`;
      else text.textContent = `${title}: ${STAGES[job.stage] ?? job.stage}`;
      bar.value = job.share;
      left.textContent = job.left === null ? "" : `about ${seconds(job.left)} left`;
      if (job.state === "done") { box.hidden = true; return job.result; }
      if (job.state === "cancelled") { box.replaceChildren("Cancelled."); return null; }
      if (job.state === "failed") throw new Error(job.message);
      await new Promise((resolve) => setTimeout(resolve, 250));
      job = await ask(`/jobs/${job.id}`);
    }
  }
}
