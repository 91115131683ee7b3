// The last seconds of telemetry: one ring a column, all written together.

export class History {
  constructor(fields, rows) {
    this.rows = rows;
    this.columns = Object.fromEntries(fields.map((field) => [field, new Float32Array(3 * rows)]));
    this.tick = new Float64Array(rows);
    this.clear();
  }

  clear() { this.end = 0; }

  take(block) {
    if (block.lost) this.clear();
    for (let n = 0; n < block.count; n++) {
      const at = this.end % this.rows;
      this.tick[at] = block.first + n;
      for (const [field, ring] of Object.entries(this.columns)) {
        const { values } = block.columns[field];
        ring[3 * at] = values[3 * n]; ring[3 * at + 1] = values[3 * n + 1]; ring[3 * at + 2] = values[3 * n + 2];
      }
      this.end++;
    }
  }

  tickOf(n) { return this.tick[n % this.rows]; }

  get begin() { return Math.max(0, this.end - this.rows); }

  value(field, axis, n) { return this.columns[field][3 * (n % this.rows) + axis]; }

  /** The last row up to `before` at which the set-point of an axis rises above a level; -1 if there is none. */
  trigger(axis, level, before) {
    for (let n = before; n > this.begin + 1; n--) {
      if (this.value("reference_m", axis, n) > level && this.value("reference_m", axis, n - 1) <= level) return n;
    }
    return -1;
  }
}
