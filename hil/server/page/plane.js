// Where the stage is, in a plane: its trail, its set-point, the path to come, and what the combs hold.

import { Space } from "./space.js";

const VIEWS = { xy: [0, 1], xz: [0, 2], yz: [1, 2] };

export class Plane {
  constructor(canvas, history) {
    this.canvas = canvas; this.history = history; this.view = "xy";
    this.ghost = null; this.body = null; this.status = null; this.space = new Space(canvas);
  }

  draw() {
    const { canvas } = this, scale = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== width * scale || canvas.height !== height * scale) { canvas.width = width * scale; canvas.height = height * scale; }
    const g = canvas.getContext("2d"), css = getComputedStyle(document.documentElement);
    const colour = (name) => css.getPropertyValue(name).trim();
    this.space.isShown = this.view === "3d";
    if (this.space.isShown) {
      const { history } = this, trail = [];
      g.setTransform(scale, 0, 0, scale, 0, 0); g.clearRect(0, 0, width, height);
      for (let n = Math.max(history.begin, history.end - 4000); n < history.end; n += 8) trail.push([0, 1, 2].map((axis) => history.value("estimate_m", axis, n)));
      this.space.draw(g, width, height, { body: this.body, ghost: this.ghost, trail, status: this.status }, colour);
      return;
    }
    const [a, b] = VIEWS[this.view], box = this.box(a, b);
    const unit = Math.min((width - 70) / (box[1] - box[0]), (height - 44) / (box[3] - box[2]));
    const px = (u) => width / 2 + 14 + (u - (box[0] + box[1]) / 2) * unit;
    const py = (v) => height / 2 - 8 - (v - (box[2] + box[3]) / 2) * unit;
    g.setTransform(scale, 0, 0, scale, 0, 0);
    g.clearRect(0, 0, width, height);
    this.grid(g, box, px, py, width, height, a, b, colour);
    const outline = this.body?.[this.view];
    if (outline?.length) { this.trace(g, outline, px, py); g.closePath(); g.fillStyle = colour("--body"); g.fill(); g.strokeStyle = colour("--line"); g.stroke(); }
    if (this.ghost) { this.trace(g, this.ghost.map((p) => [p[a], p[b]]), px, py); g.strokeStyle = colour("--soft"); g.lineWidth = 1; g.globalAlpha = .6; g.stroke(); g.globalAlpha = 1; }
    const { history } = this, first = Math.max(history.begin, history.end - 4000), trail = [];
    for (let n = first; n < history.end; n += 4) trail.push([history.value("estimate_m", a, n), history.value("estimate_m", b, n)]);
    if (trail.length > 1) { this.trace(g, trail, px, py); g.strokeStyle = colour("--accent"); g.lineWidth = 1.5; g.stroke(); }
    if (this.status?.position_m) {
      const target = this.status.target_m, now = this.status.position_m;
      g.strokeStyle = colour("--warn"); g.lineWidth = 1.5;
      g.beginPath(); g.arc(px(target[a]), py(target[b]), 8, 0, 7); g.stroke();
      g.fillStyle = colour("--ink"); g.beginPath(); g.arc(px(now[a]), py(now[b]), 4, 0, 7); g.fill();
    }
  }

  /** What is looked at: the path if there is one, else what the combs hold. */
  box(a, b) {
    const points = this.ghost?.map((p) => [p[a], p[b]]) ?? (this.body?.[this.view]?.length ? this.body[this.view] : [[-15e-6, -15e-6], [15e-6, 15e-6]]);
    let [u0, u1, v0, v1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [u, v] of points) { u0 = Math.min(u0, u); u1 = Math.max(u1, u); v0 = Math.min(v0, v); v1 = Math.max(v1, v); }
    const margin = 0.08 * Math.max(u1 - u0, v1 - v0, 1e-7);
    return [u0 - margin, u1 + margin, v0 - margin, v1 + margin];
  }

  trace(g, points, px, py) { g.beginPath(); points.forEach(([u, v], n) => (n ? g.lineTo(px(u), py(v)) : g.moveTo(px(u), py(v)))); }

  grid(g, box, px, py, width, height, a, b, colour) {
    const raw = (box[1] - box[0]) / 5, power = 10 ** Math.floor(Math.log10(raw)), step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw);
    g.strokeStyle = colour("--line"); g.fillStyle = colour("--soft"); g.lineWidth = 1; g.font = "11px system-ui";
    const label = (v) => `${+(v * 1e6).toPrecision(6)}`;
    g.textAlign = "center";
    for (let u = Math.ceil(box[0] / step) * step; u <= box[1]; u += step) { g.beginPath(); g.moveTo(px(u), 6); g.lineTo(px(u), height - 24); g.stroke(); g.fillText(label(u), px(u), height - 10); }
    g.textAlign = "right";
    for (let v = Math.ceil(box[2] / step) * step; v <= box[3]; v += step) { g.beginPath(); g.moveTo(36, py(v)); g.lineTo(width - 6, py(v)); g.stroke(); g.fillText(label(v), 32, py(v) + 4); }
    g.textAlign = "left"; g.fillText(`${"xyz"[a]} and ${"xyz"[b]} in um`, 40, 16);
  }
}
