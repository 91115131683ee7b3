// The same in space: the holdable workspace as a body, the path to come as a ghost, the trail, the stage. Dragging turns it.

export class Space {
  constructor(canvas) {
    this.turn = -0.6; this.tilt = 0.45;
    let from = null;
    canvas.addEventListener("pointerdown", (event) => { if (this.isShown) { from = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); } });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      this.turn += (event.clientX - from[0]) * 0.01;
      this.tilt = Math.max(-1.5, Math.min(1.5, this.tilt + (event.clientY - from[1]) * 0.01));
      from = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { from = null; });
    this.isShown = false;
  }

  /** `g`: the canvas' context, cleared; `trail`: points; everything in m. */
  draw(g, width, height, { body, ghost, trail, status }, colour) {
    const surface = body?.surface_m ?? [], all = surface.flat();
    const [centre, radius] = around(all.length ? all : ghost ?? trail);
    const unit = (0.46 * Math.min(width, height)) / radius;
    const [ct, st, ci, si] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.tilt), Math.sin(this.tilt)];
    const at = ([x, y, z]) => {
      const [u, v, w] = [x - centre[0], y - centre[1], z - centre[2]];
      const right = u * ct + v * st, deep = -u * st + v * ct;
      return [width / 2 + right * unit, height / 2 - (w * ci + deep * si) * unit, deep * ci - w * si];
    };
    const line = (points, stroke, lineWidth, alpha = 1) => {
      if (!points || points.length < 2) return;
      g.beginPath();
      points.forEach((p, n) => { const [px, py] = at(p); n ? g.lineTo(px, py) : g.moveTo(px, py); });
      g.strokeStyle = stroke; g.lineWidth = lineWidth; g.globalAlpha = alpha; g.stroke(); g.globalAlpha = 1;
    };
    const faces = [];
    for (let r = 0; r + 1 < surface.length; r++) for (let n = 0; n + 1 < surface[r].length; n++) {
      const corners = [surface[r][n], surface[r][n + 1], surface[r + 1][n + 1], surface[r + 1][n]].map(at);
      faces.push([corners.reduce((sum, c) => sum + c[2], 0), corners]);
    }
    faces.sort((a, b) => b[0] - a[0]);
    g.fillStyle = colour("--body"); g.strokeStyle = colour("--line"); g.lineWidth = 0.7;
    for (const [, corners] of faces) {
      g.beginPath(); corners.forEach(([px, py], n) => (n ? g.lineTo(px, py) : g.moveTo(px, py))); g.closePath(); g.fill(); g.stroke();
    }
    line(ghost, colour("--soft"), 1, 0.7);
    line(trail, colour("--accent"), 1.6);
    const span = Number((radius * 0.4e6).toPrecision(1)) * 1e-6, [cx, cy] = at(centre);
    g.font = "11px system-ui";
    for (const [n, axis] of ["x", "y", "z"].entries()) {
      const [px, py] = at(centre.map((v, k) => v + (k === n ? span : 0))), [left, low] = [46, height - 40];
      g.strokeStyle = g.fillStyle = colour(`--${axis}`); g.lineWidth = 2;
      g.beginPath(); g.moveTo(left, low); g.lineTo(left + px - cx, low + py - cy); g.stroke();
      g.fillText(axis, left + (px - cx) * 1.15 + 2, low + (py - cy) * 1.15 + 4);
    }
    g.fillStyle = colour("--soft"); g.fillText(`axes: ${+(span * 1e6).toPrecision(2)} um`, 8, height - 6);
    if (status?.position_m) {
      const [tx, ty] = at(status.target_m), [px, py] = at(status.position_m);
      g.strokeStyle = colour("--warn"); g.lineWidth = 1.5; g.beginPath(); g.arc(tx, ty, 8, 0, 7); g.stroke();
      g.fillStyle = colour("--ink"); g.beginPath(); g.arc(px, py, 4, 0, 7); g.fill();
    }
  }
}

function around(points) {
  const low = [Infinity, Infinity, Infinity], high = low.map((v) => -v);
  for (const p of points ?? []) for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], p[k]); high[k] = Math.max(high[k], p[k]); }
  if (!(high[0] >= low[0])) return [[0, 0, 0], 2e-5];
  const centre = low.map((v, k) => (v + high[k]) / 2);
  return [centre, Math.max(...points.map((p) => Math.hypot(...p.map((v, k) => v - centre[k]))), 1e-7)];
}
