// Circles of balls over a photograph: dragged and resized with the pointer, or by their numbers.

import { element } from "./jobs.js";

const FIELDS = { x: "column", y: "row", radius: "radius" };
const KINDS = { "": "as it looks", chrome: "chrome, a mirror", white: "white, matt" };

export class BallCircles {
  constructor(svg, canvas, list, touched) {
    [this.svg, this.canvas, this.list, this.touched, this.balls] = [svg, canvas, list, touched, []];
    new ResizeObserver(() => this.fit()).observe(canvas);
    svg.addEventListener("pointermove", (event) => { if (this.held && svg.hasPointerCapture(event.pointerId)) this.drag(event); });
    svg.addEventListener("pointerup", () => { if (this.held) { this.held = null; this.showRows(); } });
  }

  // Show the balls of photographs of some size; `highlights` of each are [column, row].
  load(width, height, balls) {
    [this.width, this.height, this.balls] = [width, height, balls.map((ball, number) => ({ highlights: [], said: balls.length === this.balls.length ? this.balls[number].said : "", ...ball }))];
    this.svg.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
    this.fit();
    this.draw();
    this.showRows();
  }

  // Return the balls as the server reads them.
  values() { return this.balls.map(({ x, y, radius, said }) => (said ? `${said}:` : "") + [x, y, radius].map((value) => Math.round(value * 100) / 100).join()); }

  add() {
    const radius = Math.min(this.width, this.height) / 10;
    this.balls.push({ x: this.width / 2, y: this.height / 2, radius, kind: "", highlights: [] });
    this.change();
    this.showRows();
    this.list.lastElementChild.querySelector("input").focus();
  }

  fit() { Object.assign(this.svg.style, { width: `${this.canvas.clientWidth}px`, height: `${this.canvas.clientHeight}px` }); }

  grab(event, ball, sizing) {
    event.preventDefault();
    this.svg.setPointerCapture(event.pointerId);
    const [x, y] = this.place(event);
    this.held = { ball, sizing, off: [ball.x - x, ball.y - y] };
  }

  drag(event) {
    const { ball, sizing, off } = this.held, [x, y] = this.place(event);
    if (sizing) ball.radius = Math.max(3, Math.hypot(x - ball.x, y - ball.y));
    else [ball.x, ball.y] = [x + off[0], y + off[1]];
    ball.highlights = [];
    this.change();
  }

  place(event) {
    const box = this.svg.getBoundingClientRect(), scale = this.width / box.width;
    return [(event.clientX - box.left) * scale - 0.5, (event.clientY - box.top) * scale - 0.5];
  }

  change() {
    this.draw();
    this.touched();
  }

  draw() {
    const unit = Math.max(this.width, this.height) / 100;
    this.svg.replaceChildren(...this.balls.flatMap((ball) => {
      const circle = element("circle", { class: "ball", cx: ball.x, cy: ball.y, r: ball.radius, "stroke-width": unit / 2 });
      const handle = element("circle", { class: "ball-size", cx: ball.x + ball.radius, cy: ball.y, r: 1.4 * unit });
      circle.addEventListener("pointerdown", (event) => this.grab(event, ball, false));
      handle.addEventListener("pointerdown", (event) => this.grab(event, ball, true));
      const spots = ball.highlights.map(([x, y]) => element("circle", { class: "ball-spot", cx: x, cy: y, r: Math.min(unit / 3, ball.radius / 16) }));
      return [circle, ...spots, handle];
    }));
  }

  showRows() {
    this.list.replaceChildren(...this.balls.map((ball, number) => {
      const name = `Ball ${number + 1}`;
      const inputs = Object.entries(FIELDS).map(([key, word]) => {
        const input = element("input", { type: "number", step: "any", min: key === "radius" ? 3 : 0, value: ball[key].toFixed(1), "aria-label": `${name}: ${word}` });
        input.addEventListener("input", () => {
          if (!Number.isFinite(input.valueAsNumber) || (key === "radius" && input.valueAsNumber < 3)) return;
          [ball[key], ball.highlights] = [input.valueAsNumber, []];
          this.change();
        });
        return element("label", {}, `${word} `, input);
      });
      const kind = element("select", { "aria-label": `${name}: kind` }, ...Object.entries(KINDS).map(([value, text]) => element("option", { value, selected: value === (ball.said ?? "") }, value || !ball.kind ? text : `${text}: ${ball.kind}`)));
      kind.addEventListener("change", () => { [ball.said, ball.highlights] = [kind.value, []]; this.change(); });
      const remove = element("button", { type: "button", class: "secondary", "aria-label": `Remove ball ${number + 1}` }, "Remove");
      remove.addEventListener("click", () => { this.balls.splice(number, 1); this.change(); this.showRows(); });
      return element("li", {}, element("b", {}, name), kind, ...inputs, remove);
    }));
  }
}
