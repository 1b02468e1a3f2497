"use strict";
// The page of a suggested motion: its animation, the commands and the predictions over time.
const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const COLOURS = 6;
const state = { motion: 0, time: 0, playing: false, before: 0 };
const meshes = Object.fromEntries(Object.entries(data.meshes).map(([name, mesh]) => [name, { vertices: numbers(mesh.vertices), faces: numbers(mesh.faces) }]));
for (const one of data.motions) {
  one.at = numbers(one.motion.time); one.poses = numbers(one.motion.poses.motion);
  for (const line of one.commands) { line.t = numbers(line.time); line.v = numbers(line.value); }
}
for (const line of data.predictions) { line.t = numbers(line.time); line.v = numbers(line.value); }

function items() {
  const one = data.motions[state.motion], found = [];
  let frame = 0;
  while (frame + 1 < one.at.length && one.at[frame + 1] <= state.time + 1e-6) frame++;
  data.bodies.forEach((body, b) => {
    const k = 7 * (frame * data.bodies.length + b), row = Array.from(one.poses.subarray(k, k + 7));
    if (!Number.isFinite(row[0])) return;
    // A weight within what carries it is seen through it.
    const weights = one.weights[body.name] ?? [], seen = weights.length ? 0.35 : 1;
    for (const geom of weights) found.push(...geomItems(geom, row.slice(0, 3), row.slice(3), geom.colour));
    for (const geom of body.geoms) found.push(...geomItems(geom, row.slice(0, 3), row.slice(3), [...geom.colour.slice(0, 3), Math.min(geom.colour[3], seen)]));
  });
  return found;
}
const camera = new Camera(data.view.scene.target, data.view.scene.distance, data.view.azimuth, data.view.elevation);
const view = new View($("view"), camera, meshes, items);

function draw(host, lines, duration) {
  const width = host.clientWidth, height = host.clientHeight;
  if (!width || !lines.length) return;
  const every = lines.flatMap((line) => [Math.min(...line.v), Math.max(...line.v)]);
  const low = Math.min(...every), high = Math.max(...every), margin = 0.06 * (high - low || 1);
  const x = scale(0, duration, 56, width - 14), y = scale(low - margin, high + margin, height - 34, 10);
  let out = "";
  for (const v of Chart.ticks(low - margin, high + margin, 5)) out += `<line class="grid" x1="56" x2="${width - 14}" y1="${y(v)}" y2="${y(v)}"/><text class="tick" x="49" y="${y(v) + 4}" text-anchor="end">${Chart.tick(v)}</text>`;
  for (const v of Chart.ticks(0, duration, width / 90)) out += `<text class="tick" x="${x(v)}" y="${height - 16}" text-anchor="middle">${Chart.tick(v)}</text>`;
  out += `<text class="axis" x="${width - 14}" y="${height - 2}" text-anchor="end">time [s]</text>`;
  lines.forEach((line, i) => {
    const d = Array.from(line.t, (t, k) => `${k ? "L" : "M"}${x(t).toFixed(1)} ${y(line.v[k]).toFixed(1)}`).join("");
    out += `<path class="c${i % COLOURS}" style="background:none" d="${d}"/>`;
  });
  out += `<line class="cursor" x1="${x(state.time)}" x2="${x(state.time)}" y1="10" y2="${height - 34}"/>`;
  host.innerHTML = `<svg viewBox="0 0 ${width} ${height}">${out}</svg>`;
}
function keys(host, lines) {
  host.innerHTML = lines.map((line, i) => `<i class="c${i % COLOURS}"></i>${Chart.escape(line.name)}${line.unit && line.unit !== "-" ? ` [${Chart.escape(line.unit)}]` : ""}`).join("");
}
function charts() {
  const one = data.motions[state.motion];
  draw($("commands"), one.commands, one.duration);
  draw($("predictions"), data.predictions, data.motions[0].duration);
}
function setTime(t) {
  const one = data.motions[state.motion];
  state.time = Math.min(Math.max(t, 0), one.duration);
  $("time").value = state.time; $("clock").textContent = `${state.time.toFixed(2)} s`;
  view.refresh(); charts();
}
function choose(k) {
  const one = data.motions[state.motion = k];
  $("time").max = one.duration; $("commands-section").hidden = !one.commands.length;
  keys($("commands-key"), one.commands); keys($("predictions-key"), data.predictions);
  setTime(0);
}
function play(now) {
  if (!state.playing) return;
  const next = state.time + Math.min(Math.max((now - state.before) / 1000, 0), 0.1) * Number($("speed").value);
  state.before = now;
  setTime(next);
  if (next >= data.motions[state.motion].duration) return setPlaying(false);
  requestAnimationFrame(play);
}
function setPlaying(on) {
  state.playing = on; $("play").textContent = on ? "❚❚" : "▶"; $("play").setAttribute("aria-label", on ? "pause" : "play");
  if (!on) return;
  if (state.time >= data.motions[state.motion].duration - 1e-3) setTime(0);
  state.before = performance.now(); requestAnimationFrame(play);
}
$("play").addEventListener("click", () => setPlaying(!state.playing));
$("time").addEventListener("input", (e) => { setPlaying(false); setTime(Number(e.target.value)); });
$("motion").addEventListener("change", (e) => { setPlaying(false); choose(e.target.selectedIndex); });
new ResizeObserver(charts).observe($("commands").parentElement);
choose(0);
