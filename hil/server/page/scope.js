// The scope: what is shown, from when, and whether it waits for a trigger. The trigger looks at set-points, whatever is shown.

import { spectrum } from "./spectrum.js";

const SHOWN = {
  error: { unit: "nm", scale: 1e9, density: { unit: "nm", scale: 1e9 }, lines: [["error", (h, a, n) => h.value("estimate_m", a, n) - h.value("reference_m", a, n)]] },
  position: { unit: "um", scale: 1e6, density: { unit: "nm", scale: 1e9 }, lines: [["", (h, a, n) => h.value("estimate_m", a, n)], ["set-point", (h, a, n) => h.value("reference_m", a, n)]] },
  voltage: { unit: "V", scale: 1, density: { unit: "mV", scale: 1e3 }, names: ["1", "2", "3"], lines: [["comb", (h, a, n) => h.value("voltage_v", a, n)]] },
  disturbance: { unit: "uN", scale: 1e6, density: { unit: "nN", scale: 1e9 }, lines: [["disturbance", (h, a, n) => h.value("disturbance_n", a, n)]] },
};
const POINTS = 2000, LEGEND = 36;
const DENSITY_MIN = 1e-9;  // of a unit: what stands has none but of rounding, and no end of decades to label
/** A label of a logarithmic axis: powers of ten alone, in few characters. */
const decade = (v) => { const power = Math.log10(v), whole = Math.round(power); return v === null || Math.abs(power - whole) > 1e-6 ? "" : Math.abs(whole) < 4 ? String(+v.toPrecision(2)) : `1e${whole}`; };

export class Scope {
  constructor(place, history) {
    this.place = place; this.history = history;
    this.what = "error"; this.spanS = 2; this.periodS = 5e-4;
    this.held = false; this.inSpectrum = false; this.trigger = null; this.events = []; this.end = null;
    new ResizeObserver(() => this.plot?.setSize(this.size())).observe(place);
  }

  /** As high as there is room in its card and in the window before it is scrolled. */
  size() {
    const { place } = this, seen = innerHeight - place.getBoundingClientRect().top - scrollY;
    return { width: Math.max(200, place.clientWidth), height: Math.max(280, Math.min(place.clientHeight, seen) - LEGEND) };
  }

  /** Everything anew: another quantity, another axis, other colours. */
  rebuild() {
    const shown = SHOWN[this.what], css = getComputedStyle(document.documentElement);
    const colour = (name) => css.getPropertyValue(name).trim();
    const series = [{ label: this.inSpectrum ? "Hz" : "s" }];
    for (const [label, , ] of shown.lines) {
      ["x", "y", "z"].forEach((axis, a) => series.push({
        label: `${label} ${shown.names ? shown.names[a] : axis}`.trim(), stroke: colour(`--${axis}`), width: label === "set-point" ? 1 : 1.4,
        dash: label === "set-point" ? [4, 3] : undefined, points: { show: false },
        value: (_, v) => (v == null ? "" : v.toPrecision(4)),
      }));
    }
    const axes = [this.inSpectrum ? "Hz" : "s", this.inSpectrum ? `${shown.density.unit}/\u221aHz` : shown.unit].map((label, n) => ({
      label, stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line") }, labelSize: 16, size: n ? 58 : 32, labelGap: n ? 0 : -4,
      ...(this.inSpectrum ? { values: (_, splits) => splits.map(decade) } : {}),
    }));
    const scales = this.inSpectrum ? { x: { time: false, distr: 3 }, y: { distr: 3 } } : { x: { time: false } };
    this.plot?.destroy();
    this.plot = new window.uPlot({ ...this.size(), series, axes, scales, cursor: { drag: { x: true, y: true } }, hooks: { draw: [(plot) => this.markers(plot)] } }, this.data(), this.place);
  }

  data() {
    const { history } = this, shown = SHOWN[this.what];
    const count = Math.min(Math.round(this.spanS / this.periodS), history.rows - 1);
    let end = this.end ?? history.end - 1;
    if (this.trigger) {
      const at = history.trigger(this.trigger.axis, this.trigger.level, end - Math.floor(count / 2));
      if (at >= 0) end = at + Math.floor(count / 2);
      this.zero = at >= 0 ? at : end;
    } else this.zero = end;
    const first = Math.max(history.begin, end - count + 1);
    if (end - first < 16) return [[0], ...shown.lines.flatMap(() => [[null], [null], [null]])];
    if (this.inSpectrum) return this.spectra(shown, first, end);
    const step = Math.max(1, Math.ceil((end - first) / POINTS));
    const rows = [];
    for (let n = first + ((step - (first % step)) % step); n <= end; n += step) rows.push(n);
    const time = rows.map((n) => (n - this.zero) * this.periodS);
    return [time, ...shown.lines.flatMap(([, value]) => [0, 1, 2].map((axis) => rows.map((n) => this.extreme(value, axis, n, step, end) * shown.scale)))];
  }

  /** Of the rows that share a point, the one that is farthest from the first: a spike is not lost. */
  extreme(value, axis, n, step, end) {
    let best = value(this.history, axis, n);
    if (step === 1) return best;
    const base = best;
    for (let k = n + 1; k < Math.min(n + step, end); k++) {
      const v = value(this.history, axis, k);
      if (Math.abs(v - base) > Math.abs(best - base)) best = v;
    }
    return best;
  }

  spectra(shown, first, end) {
    let hz;
    const lines = shown.lines.flatMap(([, value]) => [0, 1, 2].map((axis) => {
      const values = Float64Array.from({ length: end - first }, (_, k) => value(this.history, axis, first + k) * shown.density.scale);
      const [f, density] = spectrum(values, this.periodS);
      hz = f;
      return Array.from(density, (v) => (v > DENSITY_MIN ? v : null));
    }));
    return [hz, ...lines];
  }

  /** Events of a recording: a line each, with its words, as far as there is room. */
  markers(plot) {
    if (this.inSpectrum || !this.events.length) return;
    const css = getComputedStyle(document.documentElement), { left, top, width, height } = plot.bbox, g = plot.ctx;
    let free = -Infinity;
    g.save();
    g.font = `${11 * devicePixelRatio}px system-ui`; g.textAlign = "left"; g.setLineDash([]);
    for (const { tick, kind, words } of this.events) {
      const x = plot.valToPos((tick - this.history.tickOf(this.zero)) * this.periodS, "x", true);
      if (!(x >= left && x <= left + width)) continue;
      g.strokeStyle = g.fillStyle = css.getPropertyValue(kind === "fault" ? "--bad" : kind === "missed" ? "--warn" : "--soft");
      g.beginPath(); g.moveTo(x, top); g.lineTo(x, top + height); g.stroke();
      if (x > free) { const text = words.split(":")[0].slice(0, 40); g.fillText(text, x + 4, top + 12 * devicePixelRatio); free = x + g.measureText(text).width + 8; }
    }
    g.restore();
  }

  draw() { if (!this.held && this.plot) this.plot.setData(this.data(), true); }

  csv() {
    const shown = SHOWN[this.what], unit = this.inSpectrum ? `${shown.density.unit}_per_rtHz` : shown.unit;
    const names = this.plot.series.map((s, n) => (n === 0 ? `${this.inSpectrum ? "frequency" : "time"}_${s.label}` : `${s.label.replace(/\s+/g, "_")}_${unit}`));
    const rows = this.plot.data[0].map((_, n) => this.plot.data.map((column) => column[n]).join(","));
    return `${names.join(",")}\n${rows.join("\n")}\n`;
  }

  png() { return this.plot.ctx.canvas.toDataURL("image/png"); }
}
