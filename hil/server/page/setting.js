// What is set of the stage: axes of the sample, named positions, law, settle window, and the way back.

const at = (id) => document.getElementById(id);
const numberOf = (text) => Number(String(text).trim().replace(",", "."));

export class Setting {
  /** `ask(message, command, python)` asks the server and shows what does the same; `lookAtLaws()` asks which can be had. */
  constructor(ask, lookAtLaws) {
    this.ask = ask; this.lookAtLaws = lookAtLaws; this.points = []; this.asksLaws = false;
    at("sample").onsubmit = (event) => { event.preventDefault(); this.setSample(); };
    at("plane-point").onclick = () => this.addPoint();
    at("name-position").onsubmit = (event) => {
      event.preventDefault();
      const name = at("name-position").elements.name.value.trim();
      if (name) this.do({ do: "name_position", name }, `pkxyz ask name ${quoted(name)}`, `stage.name_position(${JSON.stringify(name)})`);
    };
    at("law-form").onsubmit = (event) => {
      event.preventDefault();
      const name = at("law-form").elements.law.value;
      this.do({ do: "law", controller: name }, `pkxyz ask law ${name}`, `stage.change_law("${name}")`);
    };
    for (const begin of ["pointerdown", "focus"]) at("law-form").elements.law.addEventListener(begin, () => this.askLaws());
    at("quiet").onclick = () => { const on = !this.status?.quiet; this.do({ do: "quiet", on }, `pkxyz ask quiet ${on ? "on" : "off"}`, `stage.quiet_holds(${on ? "True" : "False"})`); };
    at("settle").onsubmit = (event) => {
      event.preventDefault();
      const f = at("settle").elements, window_m = numberOf(f.window.value) * 1e-9, dwell_s = numberOf(f.dwell.value) * 1e-3, sigmas = numberOf(f.sigmas.value);
      const said = [`window_m=${+window_m.toPrecision(6)}`, `dwell_s=${+dwell_s.toPrecision(6)}`, `sigmas=${sigmas}`];
      this.do({ do: "settle", window_m, dwell_s, sigmas }, `pkxyz ask settle ${said.join(" ")}`, `stage.settle_window(${said.join(", ")})`);
    };
  }

  do(message, command, python) { this.ask({ ...message, who: "page" }, command, python); }

  /** Which laws this stage and bus can have takes seconds to find out: asked once, when somebody is about to choose. */
  askLaws() { if (!this.asksLaws && this.lookAtLaws() !== null) this.asksLaws = true; }

  /** `told`: by law why not, nothing where it can be had. */
  showLaws(told) {
    for (const option of at("law-form").elements.law.options) option.disabled = Boolean(told[option.value]);
    at("law-not").replaceChildren(...Object.entries(told).filter(([, why]) => why).map(([name, why]) => {
      const row = document.createElement("li");
      row.textContent = `no ${name}: ${why.replace(/^(controller|law) '[^']*': (law '[^']*': )?/, "")}`;
      return row;
    }));
  }

  setSample() {
    const f = at("sample").elements, origin_m = ["x", "y", "z"].map((a) => numberOf(f[`origin_${a}`].value) * 1e-6);
    const turn = { rotation_deg: numberOf(f.rotation.value), slope_x: numberOf(f.slope_x.value) * 1e-3, slope_y: numberOf(f.slope_y.value) * 1e-3 };
    const scale = ["x", "y", "z"].map((a) => numberOf(f[`scale_${a}`].value));
    const plain = Object.entries(turn).map(([key, v]) => `${key}=${+v.toPrecision(9)}`);
    const [o, s] = [origin_m, scale].map((list) => list.map((v) => +v.toPrecision(9)));
    this.do({ do: "sample", origin_m: o, scale: s, ...turn }, `pkxyz ask sample ${plain.join(" ")} origin_m=${o} scale=${s}`,
      `stage.set_sample(${plain.join(", ")}, origin_m=(${o.join(", ")}), scale=(${s.join(", ")}))`);
  }

  addPoint() {
    if (!this.status?.target_m) return;
    this.points.push(this.status.target_m);
    if (this.points.length === 3) {
      const points_m = this.points, said = points_m.map((p) => p.map((v) => +v.toPrecision(9)));
      this.points = [];
      this.do({ do: "tilt_plane", points_m }, `pkxyz ask tilt ${said.map((p) => p.join(",")).join(" ")}`, `stage.tilt_plane(${said.map((p) => `(${p.join(", ")})`).join(", ")})`);
    }
    at("plane-point").textContent = this.points.length ? `Take point ${this.points.length + 1} of 3` : "Plane from 3 points";
  }

  /** What is set now; a form that somebody is writing in keeps what is written. */
  show(told) {
    this.told = told;
    if (!at("sample").contains(document.activeElement)) {
      const f = at("sample").elements, sample = told.sample;
      ["x", "y", "z"].forEach((a, n) => { f[`origin_${a}`].value = +(sample.origin_m[n] * 1e6).toPrecision(7); f[`scale_${a}`].value = sample.scale[n]; });
      f.rotation.value = +sample.rotation_deg.toPrecision(7); f.slope_x.value = +(sample.slope_x * 1e3).toPrecision(6); f.slope_y.value = +(sample.slope_y * 1e3).toPrecision(6);
    }
    if (!at("settle").contains(document.activeElement)) {
      const f = at("settle").elements;
      f.window.value = +(told.settle.window_m * 1e9).toPrecision(5); f.dwell.value = +(told.settle.dwell_s * 1e3).toPrecision(5); f.sigmas.value = told.settle.sigmas;
    }
    at("positions").replaceChildren(...Object.entries(told.positions).map(([name, place]) => {
      const row = document.createElement("li"), words = document.createElement("span");
      words.textContent = `${name}: ${place.map((v) => +(v * 1e6).toPrecision(6)).join(", ")} um`;
      row.append(words, this.button("Go", () => this.do({ do: "move", to: name }, `pkxyz ask go ${quoted(name)}`, `stage.move_to_position(${JSON.stringify(name)})`)),
        this.button("Forget", () => this.do({ do: "forget_position", name }, `pkxyz ask forget ${quoted(name)}`, `stage.forget_position(${JSON.stringify(name)})`)));
      return row;
    }));
    at("history").replaceChildren(...told.history.map(({ at: when, who, what, digest }) => {
      const row = document.createElement("li"), words = document.createElement("span");
      words.textContent = `${what}${who ? `, ${who}` : ""}${when ? `, ${when.replace("T", " ").replace("Z", " UTC")}` : ""} (${digest})`;
      row.append(words);
      if (digest !== told.digest) row.append(this.button("Back to this", () => this.do({ do: "restore", digest }, `pkxyz ask restore ${digest}`, `stage.restore_settings("${digest}")`)));
      return row;
    }));
    this.lock(this.mine);
  }

  button(words, act) { const b = document.createElement("button"); b.type = "button"; b.className = "quiet small"; b.textContent = words; b.onclick = act; return b; }

  showStatus(status) {
    this.status = status;
    at("law-now").textContent = status.law ? `now ${status.law}` : "";
    at("quiet").setAttribute("aria-pressed", Boolean(status.quiet));
  }

  /** Without control nothing can be set. */
  lock(mine) { this.mine = mine; for (const each of document.querySelectorAll("#settings button, #settings input, #settings select")) each.disabled = !mine; }
}

const quoted = (name) => (/^[\w.-]+$/.test(name) ? name : `'${name}'`);
