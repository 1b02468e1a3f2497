"use strict";
// Ties frames, outlines, plots and controls of the page of a tracked video to one time.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const WORDS = { tracked: "tracked", filled: "filled backward", bridged: "bridged", lost: "lost" };
const WORST = ["lost", "bridged", "filled", "tracked"];
const state = { demonstration: data.demonstrations[0], time: 0, playing: false };
const narrow = () => document.body.clientWidth < 640;
const worstOf = (states) => WORST.find((s) => states.includes(s)) || "tracked";

// ---- frames ----------------------------------------------------------------------------------------------------------
/** One camera: its frames on a canvas, the outlines above. */
class Screen {
  constructor(camera, host) {
    this.camera = camera; this.frame = -1; this.pictures = []; this.centre = null;
    const shown = camera.time.length === camera.total ? `all ${camera.total} frames` : `${camera.time.length} of ${camera.total} frames shown`;
    const figure = document.createElement("figure");
    figure.innerHTML = `<figcaption><b>${Chart.escape(camera.name)}</b><span class="quiet"><span class="when"></span>, ${shown}</span></figcaption>
      <div class="screen"><canvas width="${camera.width}" height="${camera.height}" role="img" aria-label="frame of ${Chart.escape(camera.name)}"></canvas><svg></svg><div class="flag" hidden></div></div>`;
    host.append(figure);
    this.box = figure.querySelector(".screen"); this.canvas = figure.querySelector("canvas"); this.svg = figure.querySelector("svg"); this.flag = figure.querySelector(".flag"); this.when = figure.querySelector(".when");
    this.size = this.closeUp();
  }
  picture(k) {
    if (!this.pictures[k]) {
      this.pictures[k] = new Image();
      this.pictures[k].onload = () => { if (k === this.frame) this.draw(); };
      this.pictures[k].src = `data:image/webp;base64,${this.camera.images[k]}`;
    }
    return this.pictures[k];
  }
  /** Corners of what is seen of the bodies in a frame [px]. */
  corners(k) {
    const all = Object.values(this.camera.bodies).flatMap((b) => [...b.seen[k], ...b.covered[k]]);
    if (!all.length) return null;
    const low = [1e9, 1e9], high = [-1e9, -1e9];
    all.forEach((v, i) => { low[i % 2] = Math.min(low[i % 2], v / 10); high[i % 2] = Math.max(high[i % 2], v / 10); });
    return [low, high];
  }
  /** Width and height of a close view [px]: room around the largest outline, in the shape of the image. */
  closeUp() {
    let most = 0;
    for (let k = 0; k < this.camera.time.length; k++) { const c = this.corners(k); if (c) most = Math.max(most, c[1][0] - c[0][0], (c[1][1] - c[0][1]) * this.camera.width / this.camera.height); }
    const width = Math.min(this.camera.width, Math.max(2 * most, 40));
    return [width, width * this.camera.height / this.camera.width];
  }
  window() {
    const { width, height } = this.camera, whole = [0, 0, width, height];
    if (!$("zoom").checked) return whole;
    const corners = this.corners(this.frame);
    if (corners) this.centre = [0, 1].map((i) => (corners[0][i] + corners[1][i]) / 2);
    if (!this.centre) return whole;
    const [w, h] = this.size;
    return [Math.min(Math.max(this.centre[0] - w / 2, 0), width - w), Math.min(Math.max(this.centre[1] - h / 2, 0), height - h), w, h];
  }
  show(time) { this.frame = nearest(this.camera.time, time); this.draw(); }
  draw() {
    const { camera, frame } = this, [x, y, w, h] = this.window(), picture = this.picture(frame), draw = this.canvas.getContext("2d");
    this.picture((frame + 1) % camera.time.length);
    if (picture.complete && picture.naturalWidth) {
      const share = picture.naturalWidth / camera.width;
      draw.drawImage(picture, x * share, y * share, w * share, h * share, 0, 0, camera.width, camera.height);
    }
    // Centres of pixels have whole coordinates.
    this.svg.setAttribute("viewBox", `${x - 0.5} ${y - 0.5} ${w} ${h}`);
    const bodies = Object.entries(camera.bodies), line = (ends) => { let d = ""; for (let i = 0; i < ends.length; i += 4) d += `M${ends[i] / 10} ${ends[i + 1] / 10}L${ends[i + 2] / 10} ${ends[i + 3] / 10}`; return d; };
    this.when.textContent = `frame of ${camera.time[frame].toFixed(2)} s`;
    let out = "";
    if ($("outlines").checked) for (const [name, body] of bodies) {
      const seen = line(body.seen[frame]), kind = body.state[frame];
      if (body.covered[frame].length) out += `<path class="${kind} covered" d="${line(body.covered[frame])}"/>`;
      if (seen) out += `<path class="halo" d="${seen}"/><path class="${kind}" d="${seen}"/>`;
      const size = 13 * w / (this.box.clientWidth || w), across = body.seen[frame].filter((_, i) => i % 2 === 0), down = body.seen[frame].filter((_, i) => i % 2);
      if (seen && bodies.length > 1) out += `<text x="${Math.min(...across) / 10}" y="${Math.max(Math.min(...down) / 10 - 0.4 * size, y + size)}" style="font-size:${size}px">${Chart.escape(name)}</text>`;
    }
    this.svg.innerHTML = out;
    const lost = bodies.filter(([, b]) => b.state[frame] === "lost").map(([name]) => name);
    this.box.className = `screen ${worstOf(bodies.map(([, b]) => b.state[frame]))}`;
    this.flag.hidden = !lost.length;
    this.flag.textContent = `${lost.join(", ")}: lost`;
  }
}
let screens = [];
function setCameras() {
  const host = $("views"), chosen = state.demonstration.cameras.filter((c) => !$("camera").value || c.name === $("camera").value);
  host.innerHTML = ""; host.className = chosen.length > 1 ? "several" : "";
  screens = chosen.map((camera) => new Screen(camera, host));
  screens.forEach((s) => s.show(state.time));
}

// ---- strips of states --------------------------------------------------------------------------------------------------
function drawStrip() {
  const d = state.demonstration, host = $("strip"), width = host.clientWidth, row = 22;
  if (!width) return;
  const left = d.bodies.length > 1 ? Math.min(110, 12 + 7 * Math.max(...d.bodies.map((b) => b.name.length))) : 0, x = state.x = scale(d.start, Math.max(d.end, d.start + 1e-6), left + 1, width - 1);
  let out = "";
  d.bodies.forEach((b, i) => {
    out += left ? `<text x="0" y="${row * i + 13}">${Chart.escape(b.name)}</text>` : "";
    out += `<rect class="state tracked" x="${x(d.start)}" y="${row * i + 4}" width="${x(d.end) - x(d.start)}" height="10" rx="2"/>`;
    for (const s of b.spans) out += `<rect class="state ${s.state}" x="${x(s.start)}" y="${row * i + (s.state === "lost" ? 0 : 4)}" width="${Math.max(x(s.end) - x(s.start), 2)}" height="${s.state === "lost" ? 18 : 10}"><title>${WORDS[s.state]} ${s.start.toFixed(2)} to ${s.end.toFixed(2)} s</title></rect>`;
  });
  host.innerHTML = `<svg width="${width}" height="${row * d.bodies.length}" role="img" aria-label="state over time">${out}<g class="cursor"></g></svg>`;
  setStripCursor();
}
function setStripCursor() {
  const group = $("strip").querySelector(".cursor"), at = state.x?.(state.time);
  if (group) group.innerHTML = `<line x1="${at}" x2="${at}" y1="0" y2="${22 * state.demonstration.bodies.length}"/>`;
}

// ---- plots -------------------------------------------------------------------------------------------------------------
const axes = (stem, suffix = "") => ["x", "y", "z"].map((a) => ({ name: a, kind: a, key: `${stem}_${a}${suffix}`, band: suffix ? null : `${stem}_${a}_band` }));
const PLOTS = [
  { title: "Position since the first frame", unit: "mm", note: "world axes, band of 2σ", signed: true, lines: axes("position") },
  { title: "Orientation since the first frame", unit: "°", note: "rotation vector, world axes, band of 2σ", signed: true, lines: axes("rotation") },
  { title: "2σ of the position", unit: "mm", note: "world axes", lines: axes("position", "_2std") },
  { title: "2σ of the rotation", unit: "°", note: "world axes", lines: axes("rotation", "_2std") },
  { title: "Depth residual", unit: "mm", note: "scatter of measured − predicted depth", lines: [{ name: "depth", kind: "depth", key: "depth" }] },
  { title: "Edge and texture residual", unit: "px", note: "scatter in the image", lines: [{ name: "edges", kind: "edge", key: "edge" }, { name: "texture", kind: "texture", key: "texture" }] },
  { title: "Agreement", unit: "%", note: "", limit: { value: data.min_agreement, name: `least share of agreeing pixels that is accepted` },
    lines: [{ name: "pixels that agree", kind: "agreement", key: "agreement" }, { name: "outline in view", kind: "visible", key: "visible" }, { name: "correlation of the texture", kind: "correlation", key: "correlation" }] },
];
const charts = PLOTS.map((plot, i) => {
  const host = document.createElement("div");
  host.innerHTML = `<h3><span>${plot.title} [${plot.unit}]</span><small id="keys-${i}"></small></h3><div class="chart" id="chart-${i}"></div>`;
  $("charts").append(host);
  return new LineChart($(`chart-${i}`), (t) => { setPlaying(false); setTime(t); });
});
const bodyNow = () => state.demonstration.bodies.find((b) => b.name === $("body").value) || state.demonstration.bodies[0];
function drawPlots() {
  const d = state.demonstration, body = bodyNow(), time = numbers(body.time);
  $("plots-title").textContent = d.bodies.length > 1 ? `Track of ${body.name}` : "Track";
  const spans = body.spans.map((s) => ({ start: s.start, end: s.end, kind: s.state, name: WORDS[s.state] }));
  PLOTS.forEach((plot, i) => {
    const lines = plot.lines.filter((l) => body[l.key]).map((l) => ({ ...l, time, value: numbers(body[l.key]) }));
    const areas = lines.filter((l) => l.band && body[l.band]).map((l) => {
      const half = numbers(body[l.band]);
      return { kind: l.kind, time, low: l.value.map((v, k) => v - half[k]), high: l.value.map((v, k) => v + half[k]) };
    });
    $(`keys-${i}`).innerHTML = (plot.note && lines.length ? plot.note : lines.length ? "" : "not measured") + lines.map((l) => `<span class="key ${l.kind}"></span>${l.name}`).join("");
    charts[i].show({
      x: [d.start, Math.max(d.end, d.start + 1e-6)], xlabel: "time [s]", unit: plot.unit, left: narrow() ? 40 : 46, signed: plot.signed, limit: lines.length ? plot.limit : null,
      label: `${plot.title} over time`, spans, areas, series: lines, at: (t) => `${t.toFixed(2)} s`,
    });
  });
}
/** Why there is no pose, or none from going forward. */
const why = (kind, reason) => (reason ? `${kind === "lost" ? ": " : "; not found going forward: "}${Chart.escape(reason)}` : "");
function listSpans() {
  const d = state.demonstration;
  $("spans").innerHTML = d.bodies.flatMap((b, i) => b.spans.map((s, k) => `<li><button data-span="${i},${k}"><i class="state ${s.state}"></i><span><b>${s.start.toFixed(2)} – ${s.end.toFixed(2)} s</b> ${d.bodies.length > 1 ? Chart.escape(b.name) + " " : ""}${WORDS[s.state]}${why(s.state, s.reason)}</span></button></li>`)).join("");
  for (const button of $("spans").querySelectorAll("button")) button.addEventListener("click", () => {
    const [i, k] = button.dataset.span.split(",").map(Number), span = d.bodies[i].spans[k];
    setPlaying(false); $("body").value = d.bodies[i].name; drawPlots(); setTime(span.time);
  });
}

// ---- time and controls ---------------------------------------------------------------------------------------------------
function setTime(t) {
  const d = state.demonstration;
  state.time = Math.min(Math.max(t, d.start), d.end);
  $("time").value = state.time;
  $("clock").textContent = narrow() ? `${state.time.toFixed(2)} s` : `${state.time.toFixed(2)} of ${d.end.toFixed(2)} s`;
  screens.forEach((s) => s.show(state.time));
  charts.forEach((c) => c.setCursor(state.time));
  setStripCursor();
  $("states").innerHTML = d.bodies.map((b) => {
    b.decoded ??= { time: numbers(b.time) };
    const k = nearest(b.decoded.time, state.time), now = b.state[k], reason = b.reasons[b.reason[k]];
    return `<div>${Chart.escape(b.name)}: <b class="${now}">${WORDS[now]}</b>${why(now, reason)}</div>`;
  }).join("");
}
let before = 0;
function play(now) {
  if (!state.playing) return;
  // The time of a frame that had begun before the button was pressed lies before that of the press.
  const next = state.time + Math.min(Math.max((now - before) / 1000, 0), 0.1) * Number($("speed").value);
  before = now;
  setTime(next);
  if (next >= state.demonstration.end) setPlaying(false); else requestAnimationFrame(play);
}
function setPlaying(on) {
  state.playing = on; $("play").textContent = on ? "❚❚" : "▶"; $("play").setAttribute("aria-label", on ? "pause" : "play");
  if (!on) return;
  if (state.time >= state.demonstration.end - 1e-3) setTime(state.demonstration.start);
  before = performance.now(); requestAnimationFrame(play);
}
const choice = (name) => `<option value="${Chart.escape(name)}">${Chart.escape(name)}</option>`;
function setDemonstration(name) {
  const d = state.demonstration = data.demonstrations.find((one) => one.name === name);
  const several = d.cameras.length > 1;
  $("camera").innerHTML = (several ? '<option value="">all</option>' : "") + d.cameras.map((c) => choice(c.name)).join("");
  $("body").innerHTML = d.bodies.map((b) => choice(b.name)).join("");
  $("time").min = d.start; $("time").max = d.end; state.time = d.start;
  setCameras(); drawStrip(); drawPlots(); listSpans(); setTime(d.start);
}
$("demonstration").addEventListener("change", (e) => { setPlaying(false); setDemonstration(e.target.value); });
$("camera").addEventListener("change", setCameras);
$("body").addEventListener("change", drawPlots);
$("time").addEventListener("input", (e) => { setPlaying(false); setTime(Number(e.target.value)); });
$("play").addEventListener("click", () => setPlaying(!state.playing));
for (const id of ["outlines", "zoom"]) $(id).addEventListener("change", () => screens.forEach((s) => s.draw()));
$("strip").addEventListener("pointerdown", (e) => { setPlaying(false); setTime(state.x.inverse(e.clientX - $("strip").getBoundingClientRect().left)); });
window.addEventListener("resize", () => { drawStrip(); drawPlots(); });
$("demonstration").value = data.first;
setDemonstration(data.first);
document.documentElement.dataset.ready = "yes";
