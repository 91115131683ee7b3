// All that there is to know, as a tree: the newest of every telemetry, and every parameter, each with its unit.

const UNITS = [
  ["_m_per_s3", "m/s3"], ["_m_per_s2", "m/s2"], ["_m_per_s", "m/s"], ["_n_per_m", "N/m"], ["_v_per_s", "V/s"], ["_n_per_v2", "N/V2"],
  ["_bit_per_s", "bit/s"], ["_volt_per_count", "V/count"], ["_farad_per_count", "F/count"], ["_us", "us"], ["_ms", "ms"], ["_nm", "nm"], ["_hz", "Hz"], ["_deg", "deg"],
  ["_pa", "Pa"], ["_kg_per_m3", "kg/m3"], ["_count", "counts"], ["_m", "m"], ["_n", "N"], ["_v", "V"], ["_f", "F"], ["_s", "s"],
];
const unitOf = (name) => UNITS.find(([suffix]) => name.endsWith(suffix))?.[1] ?? "";

export class Tree {
  constructor(place) { this.place = place; this.cells = {}; }

  /** The newest of telemetry: {field: [numbers]}. Built once, then only the numbers change. */
  values(told) {
    if (!this.telemetry) { this.telemetry = this.branch(this.place, "telemetry", true); this.fill(this.telemetry, told, this.cells); }
    for (const [name, numbers] of Object.entries(told)) if (this.cells[name]) this.cells[name].textContent = shown(numbers);
  }

  parameters(told) {
    this.place.querySelectorAll("details.parameters").forEach((old) => old.remove());
    for (const [name, values] of Object.entries(told)) {
      const branch = this.branch(this.place, name, false);
      branch.parentElement.classList.add("parameters");
      this.fill(branch, values, {});
    }
  }

  branch(place, name, open) {
    const details = document.createElement("details"), summary = document.createElement("summary"), inside = document.createElement("div");
    details.open = open; summary.textContent = name; details.append(summary, inside); place.append(details);
    return inside;
  }

  fill(place, values, cells) {
    for (const [name, value] of Object.entries(values)) {
      const isLeaf = value === null || typeof value !== "object" || (Array.isArray(value) && value.every((v) => v === null || typeof v !== "object"));
      if (!isLeaf) { this.fill(this.branch(place, name, false), value, {}); continue; }
      const row = document.createElement("div"), label = document.createElement("span"), cell = document.createElement("code"), unit = document.createElement("small");
      row.className = "leaf"; label.textContent = name; cell.textContent = shown(value); unit.textContent = unitOf(name);
      row.append(label, cell, unit); place.append(row); cells[name] = cell;
    }
  }
}

function shown(value) {
  if (Array.isArray(value)) return value.map(shown).join("  ");
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : String(+value.toPrecision(5));
  return value === null ? "-" : String(value);
}
