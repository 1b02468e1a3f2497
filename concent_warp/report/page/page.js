"use strict";
// Ties the charts, the 3D views and the controls of the page to the data that the report carries.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);

const meshes = Object.fromEntries(Object.entries(data.meshes).map(([name, m]) => [name, { vertices: numbers(m.vertices), faces: numbers(m.faces) }]));
const shown = data.shown;
const state = { demonstration: data.demonstrations[0], time: 0, playing: false, spheres: false, log: false, ghost: true, mark: true };

// ---- charts --------------------------------------------------------------------------------------------------------
const narrow = () => document.body.clientWidth < 640;
const errors = new LineChart($("errors"), (t) => setTime(t));
const schedule = $("schedule") ? new Schedule($("schedule"), (t) => setTime(t)) : null;

const timeline = new Timeline($("timeline"), (t, row) => { $("channel").value = stripChannels()[row].name; drawErrors(); setTime(t); });
const MOST_STRIPS = 12;

function leftMargin() {
  if (narrow()) return 46;
  const labels = [...(state.demonstration.schedule?.rows || []).map((r) => r.label), ...stripChannels().map((c) => c.words)];
  return 18 + 7 * Math.max(5, ...labels.map((label) => label.length));
}
const placesHere = (channel) => data.places.filter((p) => p.demonstration === state.demonstration.name && (!channel || p.channels.includes(channel)));
/** Channels whose noise is known, those with the worst spans and the largest error first. */
function stripChannels() {
  const d = state.demonstration, last = data.models[data.models.length - 1].name;
  if (!d.strips) {
    const worst = (c) => Math.min(99, ...placesHere(c.name).map((p) => p.number));
    const size = (c) => { const v = numbers(c.errors[last]); return Math.sqrt(v.reduce((a, e) => a + (Number.isFinite(e) ? e * e : 0), 0) / v.length) / c.noise; };
    d.strips = d.channels.filter((c) => c.noise).map((c) => [c, worst(c), size(c)]).sort((a, b) => a[1] - b[1] || b[2] - a[2]).slice(0, MOST_STRIPS).map((entry) => entry[0]);
  }
  return d.strips;
}
function drawTimeline() {
  const d = state.demonstration;
  timeline.show({
    x: [0, d.duration], phases: d.phases, left: leftMargin(), narrow: narrow(),
    rows: stripChannels().map((c) => ({
      label: c.words, places: placesHere(c.name),
      strips: shown.map((name) => ({ name, time: numbers(c.time), ratio: numbers(c.errors[name]).map((e) => e / c.noise) })),
    })),
  });
}
function drawErrors() {
  const d = state.demonstration, channel = d.channels.find((c) => c.name === $("channel").value) || d.channels[0];
  const time = numbers(channel.time);
  errors.show({
    x: [0, d.duration], xlabel: "time [s]", unit: channel.unit, left: leftMargin(), log: state.log, noise: channel.noise && channel.noise * channel.factor,
    label: `error of ${channel.name} over time`, phases: d.phases, places: placesHere(channel.name), at: (t) => `${t.toFixed(2)} s`,
    series: data.models.map((m) => ({ name: m.name, kind: m.kind, time, value: numbers(channel.errors[m.name]).map((v) => v * channel.factor) })),
  });
  $("errors-title").textContent = `Error of ${channel.name} [${channel.unit}]`;
}
function drawSchedule() {
  if (!schedule) return;
  const d = state.demonstration, s = d.schedule;
  schedule.show({ x: [0, d.duration], rows: s?.rows || [], targets: s?.targets || [], phases: d.phases, left: leftMargin(), narrow: narrow() });
  $("stages").closest(".scroll").hidden = !s?.stages.length;
  $("stages").innerHTML = (s?.stages || []).map((stage) => `<tr><th>${Chart.escape(stage.name)}</th><td>${stage.start.toFixed(2)} – ${stage.end.toFixed(2)}</td><td>${Chart.escape(stage.bodies.join(" · "))}</td><td>${Chart.escape(stage.links.join(", ") || "–")}</td><td class="number">${stage.primitives}</td><td class="number">${stage.pairs}</td></tr>`).join("");
}

// ---- what the 3D views draw ----------------------------------------------------------------------------------------
const COLOURS = { moved: [0.90, 0.32, 0.17], touched: [0.95, 0.70, 0.20], gripped: [0.36, 0.42, 0.78], other: [0.60, 0.66, 0.72], measured: [0.13, 0.68, 0.40], place: [0.86, 0.08, 0.24] };
const ARROW = window.matchMedia("(prefers-color-scheme: dark)").matches ? [1, 1, 1, 1] : [0.1, 0.1, 0.12, 1];
const ball = (position, r, colour) => ({ shape: "sphere", position, quaternion: IDENTITY, scale: [r, r, r], colour });

// ---- replay --------------------------------------------------------------------------------------------------------
const motion = new Map();
function motionOf(d) {
  if (!motion.has(d.name)) {
    const m = d.motion;
    motion.set(d.name, {
      time: numbers(m.time), poses: Object.fromEntries(Object.entries(m.poses).map(([k, v]) => [k, numbers(v)])),
      measured: Object.fromEntries(Object.entries(m.measured).map(([k, v]) => [k, numbers(v)])),
      points: Object.fromEntries(Object.entries(m.points).map(([k, v]) => [k, { time: numbers(v.time), xyz: numbers(v.xyz), count: v.count }])),
    });
  }
  return motion.get(d.name);
}
const pose = (array, row) => [Array.from(array.subarray(7 * row, 7 * row + 3)), Array.from(array.subarray(7 * row + 3, 7 * row + 7))];
function sphereRows(model, body) {
  const g = data.geometry?.[model];
  if (!g) return null;
  if (!g.decoded) g.decoded = { body: numbers(g.body), position: numbers(g.position), radius: numbers(g.radius) };
  const index = data.geometry.bodies.indexOf(body);
  return index < 0 ? null : { ...g.decoded, rows: [...g.decoded.body.keys()].filter((i) => g.decoded.body[i] === index) };
}
function replayItems(model) {
  const d = state.demonstration, m = motionOf(d), frame = nearest(m.time, state.time), items = [];
  data.bodies.forEach((body, b) => {
    const [p, q] = pose(m.poses[model], frame * data.bodies.length + b);
    if (!Number.isFinite(p[0])) return;
    const spheres = state.spheres ? sphereRows(model, body.name) : null;
    if (spheres) for (const i of spheres.rows) items.push(ball(Vec.plus(p, turned(q, Array.from(spheres.position.subarray(3 * i, 3 * i + 3)))), spheres.radius[i], [...COLOURS[data.geometry.state[i]], 1]));
    else for (const geom of body.geoms) items.push(...geomItems(geom, p, q, geom.colour));
    const ghost = state.ghost && m.measured[body.name];
    if (ghost) {
      const [gp, gq] = pose(ghost, frame);
      if (Number.isFinite(gp[0])) for (const geom of body.geoms) items.push(...geomItems(geom, gp, gq, [...COLOURS.measured, 0.45]));
    }
    const points = state.ghost && m.points[body.name];
    if (points) {
      const k = nearest(points.time, state.time);
      for (let i = 0; i < points.count; i++) {
        const at = Array.from(points.xyz.subarray(3 * (k * points.count + i), 3 * (k * points.count + i) + 3));
        if (Number.isFinite(at[0])) items.push(ball(at, 0.0015, [...COLOURS.measured, 1]));
      }
    }
  });
  return items;
}
/** Where a place is: the point of contact, and an arrow from the model towards the measurement. */
function placeItems(model) {
  const m = motionOf(state.demonstration), frame = nearest(m.time, state.time), items = [], size = replayCamera.distance;
  for (const place of placesHere()) {
    const row = data.bodies.findIndex((b) => b.name === place.body);
    if (row < 0 || state.time < place.start - 0.02 || state.time > place.end + 0.02) continue;
    const [p, q] = pose(m.poses[model], frame * data.bodies.length + row);
    if (!Number.isFinite(p[0])) continue;
    if (place.point) items.push({ ...ball(Vec.plus(p, turned(q, place.point)), 0.008 * size, [...COLOURS.place, 1]), above: true });
    if (!place.arrow) continue;
    const way = Vec.unit(place.arrow), length = 0.1 * size, along = alongZ(way);
    items.push({ shape: "cylinder", position: Vec.plus(p, way, length / 2), quaternion: along, scale: [0.003 * size, 0.003 * size, length / 2], colour: [...COLOURS.place, 1], above: true });
    items.push({ shape: "cone", position: Vec.plus(p, way, length), quaternion: along, scale: [0.009 * size, 0.009 * size, 0.012 * size], colour: [...COLOURS.place, 1], above: true });
  }
  return items;
}
const replayCamera = new Camera(data.view.scene.target, data.view.scene.distance, data.view.azimuth, data.view.elevation);
const replayViews = shown.map((model, i) => new View($(`replay-${i}`), replayCamera, meshes, () => [...replayItems(model), ...(state.mark && i === shown.length - 1 ? placeItems(model) : [])]));

/** Where the followed body is: as measured, else as the last model has it. */
function followed() {
  const m = motionOf(state.demonstration), name = $("follow").value, frame = nearest(m.time, state.time);
  const seen = m.measured[name] && pose(m.measured[name], frame)[0];
  if (seen && Number.isFinite(seen[0])) return seen;
  const row = data.bodies.findIndex((b) => b.name === name), at = pose(m.poses[shown[shown.length - 1]], frame * data.bodies.length + row)[0];
  return Number.isFinite(at[0]) ? at : state.at || data.view.scene.target;
}
function aimReplay() {
  const body = data.view.bodies[$("follow").value];
  state.at = body ? followed() : null;
  replayCamera.aim(body ? state.at : data.view.scene.target, body ? body.distance : data.view.scene.distance);
}
function setTime(t) {
  const d = state.demonstration;
  state.time = Math.min(Math.max(t, 0), d.duration);
  $("time").value = state.time;
  const phase = d.phases.find((p) => state.time >= p.start && state.time < p.end);
  $("clock").textContent = `${state.time.toFixed(2)} s${phase ? " · " + phase.name : ""}`;
  errors.setCursor(state.time); schedule?.setCursor(state.time); timeline.setCursor(state.time);
  if (state.at) { const at = followed(); replayCamera.shift(Vec.minus(at, state.at)); state.at = at; }
  replayViews.forEach((v) => v.refresh());
}
let before = 0;
function play(now) {
  if (!state.playing) return;
  // The time of a frame that had begun before the button was pressed lies before that of the press.
  const passed = Math.min(Math.max((now - before) / 1000, 0), 0.1);
  const next = state.time + passed * Number($("speed").value);
  before = now;
  if (next >= state.demonstration.duration) { setTime(state.demonstration.duration); setPlaying(false); return; }
  setTime(next); requestAnimationFrame(play);
}
function setPlaying(on) {
  state.playing = on; $("play").textContent = on ? "❚❚" : "▶"; $("play").setAttribute("aria-label", on ? "pause" : "play");
  if (!on) return;
  if (state.time >= state.demonstration.duration - 1e-3) setTime(0);
  before = performance.now(); requestAnimationFrame(play);
}

// ---- contact geometry ----------------------------------------------------------------------------------------------
let geometryViews = [];
function geometryItems(model) {
  const body = $("body").value, spheres = sphereRows(model, body), items = [], start = sphereRows(shown[0], body);
  const after = model === shown[shown.length - 1] && shown.length > 1;
  const end = sphereRows(shown[shown.length - 1], body), place = (g, i) => Array.from(g.position.subarray(3 * i, 3 * i + 3));
  const way = new Map(spheres.rows.map((i) => [i, Vec.length(Vec.minus(place(end, i), place(start, i)))])), farthest = Math.max(...way.values(), 1e-9);
  for (const i of spheres.rows) {
    const at = place(spheres, i), kind = data.geometry.state[i], share = kind === "moved" ? 0.2 + 0.8 * way.get(i) / farthest : 1;
    items.push(ball(at, spheres.radius[i], [...COLOURS[kind].map((c, k) => share * c + (1 - share) * COLOURS.other[k]), 1]));
    if (!after || kind !== "moved" || !$("arrows").checked) continue;
    const shift = Vec.minus(at, place(start, i)), length = Vec.length(shift);
    if (length < 3e-4) continue;
    const q = alongZ(shift), u = Vec.unit(shift), reach = length;
    items.push({ shape: "cylinder", position: Vec.plus(at, u, -reach / 2), quaternion: q, scale: [0.0003, 0.0003, reach / 2], colour: ARROW, above: true });
    items.push({ shape: "cone", position: Vec.plus(at, u, -0.0006), quaternion: q, scale: [0.0007, 0.0007, 0.001], colour: ARROW, above: true });
  }
  const owner = data.bodies.find((b) => b.name === body);
  if (owner && $("hull").checked) for (const geom of owner.geoms) items.push(...geomItems(geom, [0, 0, 0], IDENTITY, [0.35, 0.45, 0.55, 0.22]));
  return items;
}
function setUpGeometry() {
  if (!data.geometry) return;
  const camera = new Camera([0, 0, 0], 0.2, -0.9, 0.65);
  const aim = () => {
    const spheres = sphereRows(shown[0], $("body").value), low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
    for (const i of spheres.rows) for (let k = 0; k < 3; k++) {
      low[k] = Math.min(low[k], spheres.position[3 * i + k] - spheres.radius[i]); high[k] = Math.max(high[k], spheres.position[3 * i + k] + spheres.radius[i]);
    }
    camera.aim(low.map((v, k) => (v + high[k]) / 2), 2.1 * Vec.length(Vec.minus(high, low)));
    $("geometry-facts").textContent = data.geometry.facts[$("body").value];
  };
  geometryViews = shown.map((model, i) => new View($(`geometry-${i}`), camera, meshes, () => geometryItems(model)));
  $("body").addEventListener("change", aim);
  for (const id of ["arrows", "hull"]) $(id).addEventListener("change", () => geometryViews.forEach((v) => v.refresh()));
  aim();
}

// ---- unexplained forces --------------------------------------------------------------------------------------------
function forceItems() {
  const name = $("forces-body").value, body = data.bodies.find((b) => b.name === name), items = [], reach = data.view.bodies[name]?.distance / 10 || 0.05;
  for (const geom of body.geoms) items.push(...geomItems(geom, [0, 0, 0], IDENTITY, [...geom.colour.slice(0, 3), 0.5]));
  const most = Math.max(...data.forces.map((f) => Vec.length(f.vector)), 1e-12), colour = [...COLOURS.place, 1];
  for (const f of data.forces.filter((f) => f.body === name)) {
    const way = Vec.unit(f.vector), length = reach * (0.4 + 0.6 * Vec.length(f.vector) / most), q = alongZ(way);
    const spread = Math.min(0.25 * reach, Math.max(0.02 * reach, ...f.std.map((s) => s || 0)));
    items.push({ ...ball(f.point, spread, [...COLOURS.place, 0.999]), above: true });
    items.push({ shape: "cylinder", position: Vec.plus(f.point, way, length / 2), quaternion: q, scale: [0.02 * reach, 0.02 * reach, length / 2], colour, above: true });
    items.push({ shape: "cone", position: Vec.plus(f.point, way, length), quaternion: q, scale: [0.06 * reach, 0.06 * reach, 0.08 * reach], colour, above: true });
  }
  return items;
}
function setUpForces() {
  if (!$("forces-view")) return;
  const camera = new Camera([0, 0, 0], 0.2, -0.9, 0.5);
  const aim = () => {
    const name = $("forces-body").value;
    $("forces-labels").textContent = data.forces.filter((f) => f.body === name).map((f) => f.label).join(" · ");
    camera.aim([0, 0, 0], 5 * (data.view.bodies[name]?.distance / 10 || 0.05));
  };
  new View($("forces-view"), camera, meshes, forceItems);
  $("forces-body").addEventListener("change", aim);
  aim();
}

// ---- fit -----------------------------------------------------------------------------------------------------------
function drawFit() {
  if (!data.history.length) return;
  const generation = data.history.map((h) => h.generation), line = (key) => data.history.map((h) => h[key] === null ? NaN : 1e3 * h[key]);
  const series = [
    { name: "median candidate", kind: "null", key: "candidates" }, { name: "estimate", kind: "before", key: "loss" },
    { name: "estimate, held-out frames", kind: "held", key: "held_out" }, { name: "best so far", kind: "after", key: "best" },
  ].filter((s) => s.key in data.history[0]);
  new LineChart($("fit-chart")).show({
    x: [generation[0], Math.max(generation[generation.length - 1], generation[0] + 1)], xlabel: "generation", unit: "mm", log: true, label: "convergence of the fit",
    at: (g) => `generation ${Math.round(g)}`, series: series.map((s) => ({ ...s, time: generation, value: line(s.key) })),
  });
  $("fit-keys").innerHTML = series.map((s) => `<span><span class="key ${s.kind}"></span>${s.name}</span>`).join("");
}

// ---- controls ------------------------------------------------------------------------------------------------------
function setDemonstration(name) {
  state.demonstration = data.demonstrations.find((d) => d.name === name);
  $("time").max = state.demonstration.duration;
  $("channel").value = state.demonstration.opening.channel;
  drawTimeline(); drawErrors(); drawSchedule(); setTime(state.demonstration.opening.time); aimReplay();
}
function showPlace(place) {
  setPlaying(false);
  $("demonstration").value = place.demonstration;
  setDemonstration(place.demonstration);
  $("channel").value = place.channels[0];
  if (data.view.bodies[place.body]) $("follow").value = place.body;
  drawErrors(); setTime(place.peak); aimReplay();
  $("replay").scrollIntoView({ behavior: "smooth", block: "nearest" });
}
for (const button of document.querySelectorAll("[data-place]")) button.addEventListener("click", () => showPlace(data.places.find((p) => p.number === Number(button.dataset.place))));
$("demonstration").addEventListener("change", (e) => { setPlaying(false); setDemonstration(e.target.value); });
$("channel").addEventListener("change", drawErrors);
$("log").addEventListener("change", (e) => { state.log = e.target.checked; drawErrors(); });
$("time").addEventListener("input", (e) => { setPlaying(false); setTime(Number(e.target.value)); });
$("follow").addEventListener("change", aimReplay);
$("play").addEventListener("click", () => setPlaying(!state.playing));
$("spheres")?.addEventListener("change", (e) => { state.spheres = e.target.checked; replayViews.forEach((v) => v.refresh()); });
$("ghost").addEventListener("change", (e) => { state.ghost = e.target.checked; replayViews.forEach((v) => v.refresh()); });
$("mark")?.addEventListener("change", (e) => { state.mark = e.target.checked; replayViews.forEach((v) => v.refresh()); });
window.addEventListener("resize", () => { drawTimeline(); drawErrors(); drawSchedule(); });
setUpGeometry();
setUpForces();
drawFit();
state.log = $("log").checked;
$("demonstration").value = data.first;
setDemonstration(data.first);
document.documentElement.dataset.ready = "yes";
