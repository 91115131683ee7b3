// The page: hands what the server says to its parts, and what is clicked to the server.

import { History } from "./history.js";
import { Link } from "./link.js";
import { Plane } from "./plane.js";
import { Scope } from "./scope.js";
import { Setting } from "./setting.js";
import { Tree } from "./tree.js";

const FIELDS = ["reference_m", "estimate_m", "voltage_v", "disturbance_n"];
const FREE = new Set(["stop", "release"]);
const AXES = ["x", "y", "z"];
const QUIETLY = new Set(["settings", "values", "parameters", "recordings", "open_recording", "laws"]);  // looks, not deeds
const JOG_MS = 60;  // a jog is said again: at least 10 times a second
const at = (id) => document.getElementById(id);
const history = new History(FIELDS, 1 << 15);
const scope = new Scope(at("plot"), history);
const plane = new Plane(at("plane"), history);
const tree = new Tree(at("tree"));
let opened = null;  // a recording in place of what is live
let mine = false, held = false, status = null, hello = {}, previewTag = null;

// -- what the server says

const link = new Link({
  open() { setting.asksLaws = false; link.say({ do: "subscribe", fields: FIELDS, precision: "f4" }); link.say({ do: "recordings" }); },
  hello(value) {
    hello = value;
    if (value.period_us) scope.periodS = value.period_us * 1e-6;
    document.title = value.stage ? `${value.stage}: stage` : "Stage";
    if (value.period_us) bodyOf();
  },
  block(block) {
    if (opened && !opened.isFilled) { opened.isFilled = true; history.clear(); history.take(block); at("opened-at").disabled = false; seek(); return; }
    if (!opened) history.take(block);
  },
  settings(value) { setting.show(value); if (hello.period_us) bodyOf(); },
  values(value) { tree.values(value); },
  laws(value) { setting.showLaws(value); },
  parameters(value) { tree.parameters(value); },
  recordings: listRecordings,
  recording(value) { opened = { ...value, isFilled: false, live: opened?.live ?? scope.periodS }; showOpened(); },
  status: show,
  control(value) { mine = value.yours; held = value.held; showControl(); },
  answer,
  event(value) { if (value.kind === "saved") link.say({ do: "recordings" }); if (value.kind === "fault" && !value.old) log("fault", value.words.split("\n")[0], "aborted"); },
  preview(value) {
    plane.ghost = value.points_m;
    at("scan-words").textContent = `${value.duration_s.toFixed(2)} s; from (${um(value.low_m)}) to (${um(value.high_m)}) um; the combs can follow`;
  },
  body(value) { plane.body = value; },
  gone(why, wasOpen) { if (wasOpen) log("connection", why, "aborted"); mine = held = false; closeOpened(); endJog(); showControl(); at("words").textContent = "no connection to the server"; document.querySelector(".state").dataset.activity = "gone"; },
});

function bodyOf() { link.say({ do: "body" }); }

function show(value) {
  status = value;
  setting.showStatus(value);
  plane.status = value;
  document.querySelector(".state").dataset.activity = value.alive === false ? "gone" : value.activity;
  at("words").textContent = value.alive === false && value.t_s ? "the loop has stopped ticking" : value.words;
  at("mode").textContent = value.mode ? `${value.mode}: ${value.mode_words}` : "";
  if (value.position_m) for (const [n, axis] of AXES.entries()) {
    at(`set-${axis}`).textContent = (value.setpoint_m[n] * 1e6).toFixed(4);
    at(`now-${axis}`).textContent = (value.position_m[n] * 1e6).toFixed(4);
    at(`err-${axis}`).textContent = value.driven ? (Math.round(value.error_m[n] * 1e10) / 10 + 0).toFixed(1) : "-";
  }
  const facts = value.t_s === undefined ? [] : [
    ["in position", value.in_position ? "yes" : "no"], ["axes", value.in_sample_axes ? "sample" : "stage"], ["homed", value.homed ? "yes" : "no"],
    ["outputs", (value.outputs || []).join(", ") || "none"],
    ["bus load", `${(100 * value.bus_load).toFixed(0)} %`], ["missed ticks", value.missed_ticks], ...(value.stood_still_s ? [["stood still", `${value.stood_still_s.toPrecision(2)} s`]] : []),
    ["running", clock(value.t_s)], ["clients", value.clients],
  ];
  at("facts").replaceChildren(...facts.map(([name, v]) => { const d = document.createElement("div"); d.dataset.fact = name; const b = document.createElement("b"); b.textContent = v; d.append(b, name); return d; }));
  combs(value);
  at("fault").hidden = !value.last_fault;
  at("fault-words").textContent = (value.last_fault || "") + (value.saved ? `\nThe 2 s before it: ${value.saved}` : "");
  at("progress").hidden = !["scanning", "paused"].includes(value.activity);
  at("progress").value = value.progress || 0;
  showNext();
}

/** What a person does next, on the way from off to holding. */
function showNext() {
  const off = status?.activity === "off", words = held && !mine ? "another client has control" : !mine ? "take control to move the stage"
    : status?.last_fault ? "clear the fault" : off && !status.homed ? "home: the sense offsets at 0 V" : off ? "enable: close the loop" : "";
  at("next").textContent = words;
}

function combs(value) {
  if (!value.voltage_v) return;
  const most = hello.voltage_max_v || 200;
  if (!at("comb-0")) at("combs").innerHTML = [0, 1, 2].map((n) => `<div class="comb"><span>${n + 1}</span><div class="bar"><i id="comb-${n}"></i></div><span id="volt-${n}"></span></div>`).join("") + '<p class="hint" id="headroom"></p>';
  value.voltage_v.forEach((v, n) => {
    const bar = at(`comb-${n}`);
    bar.style.transform = `scaleX(${Math.min(1, v / most)})`; bar.className = v > 0.9 * most ? "high" : "";
    at(`volt-${n}`).textContent = `${v.toFixed(1)} V`;
  });
  at("headroom").textContent = `headroom ${value.headroom_v.toFixed(1)} V of ${most} V${value.saturated ? "; at a limit" : ""}`;
}

function answer({ tag, verb, state, words }) {
  if (tag === previewTag && state === "refused") at("scan-words").textContent = words;
  if (["done", "refused", "aborted"].includes(state) && (words || state !== "done" || !QUIETLY.has(verb)) && verb !== "take_control" && verb !== "give_control") log(verb || "", words, state);
}

function log(verb, words, state) {
  const line = document.createElement("li");
  line.className = state;
  line.textContent = `${verb.replace("_", "-")} ${state}${words ? `: ${words}` : ""}`;
  at("log").prepend(line);
  while (at("log").children.length > 60) at("log").lastChild.remove();
}

function showControl() {
  setting.lock(mine);
  showNext();
  at("control").textContent = mine ? "Give control" : held ? "Another has control" : "Take control";
  at("control").disabled = held && !mine;
  for (const button of document.querySelectorAll("[data-do], #move button, #scan button[name=''], #scan button:not([name]), td button"))
    button.disabled = !mine && !FREE.has(button.dataset.do);
}

// -- what is asked

function ask(message, command, python) {
  at("as-command").textContent = `$ ${command}`;
  at("as-python").textContent = python;
  const tag = message && link.say(message);
  if (message && tag === null) log(message.do, "there is no connection to the server: ask again", "refused");
  return tag;
}

const setting = new Setting(ask, () => link.say({ do: "laws" }));

// -- recordings: the same page, the same code

function listRecordings({ folder, names }) {
  if (!names.length) { const none = document.createElement("li"); none.className = "hint"; none.textContent = "none yet: of a fault the 2 s before it are kept"; at("recordings").replaceChildren(none); return; }
  at("recordings").replaceChildren(...names.map((name) => {
    const row = document.createElement("li"), words = document.createElement("span"), open = document.createElement("button");
    words.textContent = name; open.className = "quiet small"; open.textContent = "Open";
    open.onclick = () => ask({ do: "open_recording", name }, `pkxyz recording ${folder}/${name} --to csv`, `hil.open_run("${folder}/${name}")`);
    row.append(words, open);
    return row;
  }));
}
function showOpened() {
  at("opened").hidden = !opened;
  scope.events = opened?.events ?? [];
  if (!opened) { scope.end = null; return; }
  scope.periodS = opened.period_us * 1e-6;
  if (scope.inSpectrum) at("spectrum").click();
  scrollTo(0, 0);
  at("opened-name").textContent = opened.name;
  const faults = opened.events.filter((event) => event.kind === "fault").map((event) => event.words.split(":")[0]);
  at("opened-words").textContent = `${(opened.ticks * scope.periodS).toFixed(1)} s, ${opened.events.length} events${faults.length ? `: ${[...new Set(faults)].join("; ")}` : ""}`;
  at("opened-at").value = 1;
  at("opened-at").disabled = true;  // until its rows are there
}
function seek() {
  const share = Number(at("opened-at").value), count = Math.round(scope.spanS / scope.periodS);
  scope.end = Math.min(history.end - 1, Math.round(history.begin + count + share * Math.max(0, history.end - 1 - history.begin - count)));
}
at("opened-at").oninput = seek;
function closeOpened() { if (opened) scope.periodS = opened.live; opened = null; history.clear(); showOpened(); }
at("opened-close").onclick = closeOpened;
at("recordings-again").onclick = () => link.say({ do: "recordings" });
at("keep").onclick = () => { ask({ do: "save", seconds: 60 }, "pkxyz ask save", "stage.save(60.0)"); setTimeout(() => link.say({ do: "recordings" }), 3000); };

let treeTimer = null;
function openTree(on) {
  at("tree").hidden = !on;
  at("tree-open").textContent = on ? "Hide" : "Show";
  clearInterval(treeTimer);
  if (!on) return;
  link.say({ do: "parameters" });
  link.say({ do: "values" });
  treeTimer = setInterval(() => link.say({ do: "values" }), 500);
}

function verb(name) { ask({ do: name }, `pkxyz ask ${name.replace("_", "-")}`, `stage.${name}()`); }

function number(text) { return text.trim() === "" ? null : Number(text.replace(",", ".")) * 1e-6; }

function moveTo(target) {
  const given = Object.entries(target).filter(([, v]) => v !== null && Number.isFinite(v));
  if (!given.length) return;
  const words = given.map(([key, v]) => `${key[0]}=${+v.toPrecision(9)}`);
  ask({ do: "move", ...Object.fromEntries(given) }, `pkxyz ask move ${words.join(" ")}`, `stage.move_to(${words.join(", ")})`);
}

function moveBy(axis, way) {
  ask({ do: "move", relative: true, [`${axis}_m`]: way }, `pkxyz ask move --by ${axis}=${way}`, `stage.move_by(${axis}=${way})`);
}

let jogTimer = null;
function jog(axis, direction) {
  const step = Number(at("step").value);
  if (step) return moveBy(axis, direction * step);
  const speed = Number(at("speed").value);
  endJog();
  ask({ do: "jog", axis, direction, velocity_m_per_s: speed }, `pkxyz ask jog ${axis}=${direction * speed} seconds=1`, `stage.jog("${axis}", ${direction}, 1.0, velocity_m_per_s=${speed})`);
  jogTimer = setInterval(() => link.say({ do: "jog_again" }), JOG_MS);
}
function endJog() { if (jogTimer !== null) { clearInterval(jogTimer); jogTimer = null; link?.say({ do: "jog_end" }); } }

function segments() {
  const f = new FormData(at("scan")), value = (name) => Number(String(f.get(name)).replace(",", "."));
  const limits = { velocity_max_m_per_s: 0.5e-3, acceleration_max_m_per_s2: 0.5, jerk_max_m_per_s3: 300 };
  return [
    { kind: "move", to_m: status?.target_m ?? hello.middle_m, ...limits },
    { kind: "raster", line_length_m: value("length") * 1e-6, lines: value("lines"), line_pitch_m: value("pitch") * 1e-6, layers: 1, layer_pitch_m: 1e-6, line_rate_hz: value("rate"), ...limits },
  ];
}

// -- the page's own parts

const axes = at("axes");
for (const axis of AXES) {
  const row = document.createElement("tr");
  row.innerHTML = `<td class="name" style="color: var(--${axis})">${axis}</td><td class="value"><span id="set-${axis}">-</span> <small>um</small></td>
    <td class="value"><span id="now-${axis}">-</span> <small>um</small></td><td class="value"><span id="err-${axis}">-</span> <small>nm</small></td>
    <td><button data-jog="${axis}" data-way="-1"></button></td><td><button data-jog="${axis}" data-way="1"></button></td>`;
  axes.append(row);
}
function jogLabels() {
  const step = at("step").selectedOptions[0].textContent, speed = at("speed").selectedOptions[0].textContent;
  for (const button of document.querySelectorAll("[data-jog]"))
    button.textContent = `${button.dataset.way > 0 ? "+" : "-"}${Number(at("step").value) ? step : speed}`;
}
for (const button of document.querySelectorAll("[data-jog]")) {
  button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); jog(button.dataset.jog, Number(button.dataset.way)); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(end, endJog);
}
const KEYS = { ArrowLeft: ["x", -1], ArrowRight: ["x", 1], ArrowDown: ["y", -1], ArrowUp: ["y", 1], PageDown: ["z", -1], PageUp: ["z", 1] };
addEventListener("keydown", (event) => {
  if (event.target.matches?.("input, select")) return;
  if (event.code === "Space") { event.preventDefault(); stop(); }
  const key = KEYS[event.key];
  if (key && mine) { event.preventDefault(); if (!event.repeat) jog(...key); }
});
addEventListener("keyup", endJog);
addEventListener("blur", endJog);
document.addEventListener("visibilitychange", () => { if (document.hidden) endJog(); });

function stop() { ask({ do: "stop" }, "pkxyz ask stop", "stage.stop()"); }
at("stop").onclick = stop;
at("control").onclick = () => ask({ do: mine ? "give_control" : "take_control" }, "pkxyz ask takes control by itself, and gives it back", `stage.${mine ? "give" : "take"}_control()`);
for (const button of document.querySelectorAll("[data-do]")) button.onclick = () => verb(button.dataset.do);
at("move").onsubmit = (event) => { event.preventDefault(); const f = new FormData(at("move")); moveTo(Object.fromEntries(AXES.map((a) => [`${a}_m`, number(f.get(`${a}_m`))]))); };
at("middle").onclick = () => moveTo(Object.fromEntries(AXES.map((a, n) => [`${a}_m`, hello.middle_m?.[n] ?? null])));
at("scan").onsubmit = (event) => { event.preventDefault(); preview(); asPath("path", "follow"); };
at("scan").elements.preview.onclick = preview;
function preview() { previewTag = asPath("preview", "preview"); }
function asPath(verb, method) {
  const asked = segments(), text = JSON.stringify(asked);
  return ask({ do: verb, segments: asked }, `pkxyz ask ${verb} '${text}'`, `stage.${method}(segments=${text})`);
}

at("step").onchange = at("speed").onchange = jogLabels;
at("view").onchange = () => { plane.view = at("view").value; at("view-hint").textContent = plane.view === "3d" ? "what combs hold; drag to turn" : "shaded: what the combs hold"; };
at("shown").onchange = () => { scope.what = at("shown").value; scope.rebuild(); };
at("span").onchange = () => { scope.spanS = Number(at("span").value); if (opened) seek(); };
function setTrigger() { const axis = AXES.indexOf(at("trigger").value); scope.trigger = axis < 0 ? null : { axis, level: number(at("level").value) ?? 0 }; }
at("trigger").onchange = at("level").onchange = setTrigger;
function toggles(id, set) { at(id).onclick = () => { const on = at(id).getAttribute("aria-pressed") !== "true"; at(id).setAttribute("aria-pressed", on); set(on); }; }
toggles("tree-open", openTree);
toggles("hold", (on) => { scope.held = on; });
toggles("spectrum", (on) => { scope.inSpectrum = on; scope.rebuild(); });
at("csv").onclick = () => { seen(); save(URL.createObjectURL(new Blob([scope.csv()], { type: "text/csv" })), "scope.csv"); };
function seen() { ask(null, "pkxyz ask save", `stage.capture("reference_m", "estimate_m", seconds=${scope.spanS})`); }
at("png").onclick = () => save(scope.png(), "scope.png");
function save(url, name) { const a = document.createElement("a"); a.href = url; a.download = name; a.click(); }

at("theme").onclick = () => paint(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
function paint(theme) { document.documentElement.dataset.theme = theme; localStorage.setItem("theme", theme); scope.rebuild(); }
const um = (m) => m.map((v) => (v * 1e6).toFixed(2)).join(", ");
const twoDigits = (v) => String(Math.floor(v)).padStart(2, "0");
const clock = (s) => (s < 60 ? `${s.toFixed(1)} s` : `${s < 3600 ? Math.floor(s / 60) : `${Math.floor(s / 3600)}:${twoDigits((s / 60) % 60)}`}:${twoDigits(s % 60)}`);

jogLabels();
showControl();
paint(localStorage.getItem("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
/** 30 times a second, or as often as leaves a slow machine time for what comes in. */
async function drawAgain() {
  const begin = performance.now();
  scope.draw(); plane.draw();
  await null; await null;  // the plot draws behind us
  const took = performance.now() - begin;
  setTimeout(drawAgain, Math.max(1000 / 30 - took, 2 * took));
}
drawAgain();
