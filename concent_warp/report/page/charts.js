"use strict";
// Charts as SVG: lines over time with shaded phases, and the contact schedule. Colours are classes of the style sheet.

const Chart = {
  escape: (text) => String(text).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" }[c])),
  number(value) {
    if (!Number.isFinite(value)) return value > 0 ? "diverged" : "–";
    const size = Math.abs(value);
    return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : size >= 0.1 || size === 0 ? 2 : 3);
  },
  /** Round numbers that divide a span in about `count` parts. */
  ticks(low, high, count) {
    const rough = (high - low) / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(rough || 1));
    const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough) || power;
    const out = [];
    for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-12 ? 0 : v);
    return out;
  },
  logTicks(low, high) {
    const out = [];
    for (let p = Math.floor(Math.log10(low)); p <= Math.ceil(Math.log10(high)); p++) for (const k of [1, 2, 5]) {
      const v = k * 10 ** p;
      if (v >= low * 0.999 && v <= high * 1.001) out.push(v);
    }
    return out;
  },
  tick: (v) => String(Number(v.toPrecision(6))),
  /** Bands of the phases with their names; the names step aside when they are too narrow for the band. */
  phases(phases, x, top, bottom, named) {
    let out = "";
    phases.forEach((p, i) => {
      const a = x(Math.max(p.start, x.low)), b = x(Math.min(p.end, x.high));
      if (b <= a) return;
      out += `<rect class="band band${p.band}" x="${a}" y="${top}" width="${b - a}" height="${bottom - top}"/>`;
      if (i) out += `<line class="transition" x1="${a}" x2="${a}" y1="${top}" y2="${bottom}"/>`;
      const room = Math.floor((b - a - 6) / 6.6), text = p.name.length <= room ? p.name : room >= 3 ? p.name.slice(0, room - 1) + "…" : "";
      if (named && text) out += `<text class="phase" x="${a + 4}" y="${top - 6}">${Chart.escape(text)}</text>`;
    });
    return out;
  },
  /** A shaded interval with a bar at its top, and its name where there is room. */
  span(span, x, top, bottom) {
    const a = x(Math.max(span.start, x.low)), width = Math.max(x(Math.min(span.end, x.high)) - a, 2);
    const name = width > 7 * span.name.length ? `<text class="span-name ${span.kind}" x="${a + width / 2}" y="${top + 15}" text-anchor="middle">${Chart.escape(span.name)}</text>` : "";
    return `<rect class="span ${span.kind}" x="${a}" y="${top}" width="${width}" height="${bottom - top}"/><rect class="span-bar ${span.kind}" x="${a}" y="${top}" width="${width}" height="4"/>${name}`;
  },
};

/** Arrays travel as base64 of little-endian 32-bit numbers. */
function numbers(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
  return new (packed.type === "i" ? Int32Array : Float32Array)(bytes.buffer);
}

/** A linear or logarithmic map from values to pixels. */
function scale(low, high, from, to, log) {
  const f = log ? Math.log : (v) => v, a = f(low), b = f(high);
  const map = (v) => from + (f(v) - a) / (b - a || 1) * (to - from);
  map.low = low; map.high = high;
  map.inverse = (p) => { const v = a + (p - from) / (to - from) * (b - a); return log ? Math.exp(v) : v; };
  return map;
}

/** Lines over a common axis. spec: {x: [low, high], xlabel, unit, series: [{name, kind, time, value}], noise, phases, places, log};
 * further, optional: {signed, areas: [{kind, time, low, high}], spans: [{start, end, kind, name}], limit: {value, name}}. */
class LineChart {
  constructor(host, pick) {
    this.host = host; this.pick = pick; this.cursor = null;
    new ResizeObserver(() => this.spec && this.render()).observe(host);
    host.addEventListener("pointermove", (e) => this.point(e));
    host.addEventListener("pointerdown", (e) => { this.point(e); if (this.pick && this.x) this.pick(this.at(e)); });
    host.addEventListener("pointerleave", () => { this.tip(null); });
  }
  show(spec) { this.spec = spec; this.render(); }
  at(e) {
    const left = this.host.getBoundingClientRect().left;
    return Math.min(this.x.high, Math.max(this.x.low, this.x.inverse(e.clientX - left)));
  }
  range() {
    const s = this.spec, values = [];
    for (const line of s.series) for (const v of line.value) if (Number.isFinite(v)) values.push(v);
    for (const area of s.areas || []) for (const edge of [area.low, area.high]) for (const v of edge) if (Number.isFinite(v)) values.push(v);
    if (s.noise) values.push(s.noise);
    if (s.limit) values.push(s.limit.value);
    if (!values.length) return [0.1, 1];
    let high = values.reduce((a, b) => Math.max(a, b), 0);
    const least = s.signed ? values.reduce((a, b) => Math.min(a, b), 0) : 0, margin = 0.06 * (high - least);
    if (!s.log) return [least && least - margin, high + margin || 1];
    const sorted = values.filter((v) => v > 0).sort((a, b) => a - b);
    const low = sorted[Math.floor(sorted.length * 0.01)] || high / 100;
    return [low, Math.max(high * 1.15, low * 3)];
  }
  render() {
    const s = this.spec, width = this.host.clientWidth, height = this.host.clientHeight;
    if (!width) return;
    const left = s.left ?? 52, right = width - 14, top = s.phases?.length ? 30 : 14, bottom = height - 38;
    const [low, high] = this.range();
    const x = this.x = scale(s.x[0], s.x[1], left, right), y = this.y = scale(low, high, bottom, top, s.log);
    let out = Chart.phases(s.phases || [], x, top, bottom, true);
    for (const v of s.log ? Chart.logTicks(low, high) : Chart.ticks(low, high, Math.max(4, (bottom - top) / 50))) {
      out += `<line class="grid" x1="${left}" x2="${right}" y1="${y(v)}" y2="${y(v)}"/><text class="tick" x="${left - 7}" y="${y(v) + 4}" text-anchor="end">${Chart.tick(v)}</text>`;
    }
    for (const v of Chart.ticks(x.low, x.high, (right - left) / 80)) out += `<text class="tick" x="${x(v)}" y="${bottom + 17}" text-anchor="middle">${Chart.tick(v)}</text>`;
    out += `<text class="axis" x="${right}" y="${height - 5}" text-anchor="end">${Chart.escape(s.xlabel)}</text>`;
    if (s.noise && s.noise >= low && s.noise <= high) {
      out += `<rect class="floor" x="${left}" width="${right - left}" y="${y(s.noise)}" height="${Math.max(bottom - y(s.noise), 0)}"/><line class="noise" x1="${left}" x2="${right}" y1="${y(s.noise)}" y2="${y(s.noise)}"/>`;
    }
    for (const span of s.spans || []) out += Chart.span(span, x, top, bottom);
    for (const area of s.areas || []) out += `<path class="area ${area.kind}" d="${this.area(area)}"/>`;
    if (s.limit) out += `<line class="noise" x1="${left}" x2="${right}" y1="${y(s.limit.value)}" y2="${y(s.limit.value)}"/><text class="noise-name" x="${left + 5}" y="${y(s.limit.value) + 13}">${Chart.escape(s.limit.name)}</text>`;
    for (const p of s.places || []) {
      const a = x(Math.max(p.start, x.low)), b = x(Math.min(p.end, x.high));
      out += `<rect class="place" x="${a}" y="${top}" width="${Math.max(b - a, 3)}" height="${bottom - top}"/>`;
    }
    for (const line of s.series) out += `<path class="line ${line.kind}" d="${this.path(line, low)}"/>`;
    if (s.noise && s.noise >= low && s.noise <= high) out += `<text class="noise-name" x="${left + 5}" y="${y(s.noise) - 4}">noise floor</text>`;
    for (const p of s.places || []) out += badge((x(Math.max(p.start, x.low)) + x(Math.min(p.end, x.high))) / 2, top + 11, p.number);
    out += `<line class="axis-line" x1="${left}" x2="${right}" y1="${bottom}" y2="${bottom}"/><g class="cursor"></g>`;
    this.host.innerHTML = `<svg width="${width}" height="${height}" role="img" aria-label="${Chart.escape(s.label || "")}">${out}</svg><div class="tip" hidden></div>`;
    this.setCursor(this.cursor);
  }
  path(line, low) {
    let out = "", pen = false;
    for (let i = 0; i < line.time.length; i++) {
      const v = line.value[i];
      if (!Number.isFinite(v)) { pen = false; continue; }
      out += `${pen ? "L" : "M"}${this.x(line.time[i]).toFixed(1)} ${this.y(Math.max(v, low)).toFixed(1)}`;
      if (!pen && !Number.isFinite(line.value[i + 1])) out += "h0"; // a dot
      pen = true;
    }
    return out;
  }
  /** Closed outlines of an area, one for each stretch without gaps. */
  area(area) {
    let out = "", start = -1;
    for (let i = 0; i <= area.time.length; i++) {
      const here = i < area.time.length && Number.isFinite(area.low[i]) && Number.isFinite(area.high[i]);
      if (here && start < 0) start = i;
      if (here || start < 0) continue;
      const rows = Array.from({ length: i - start }, (_, k) => start + k), at = (edge) => (k) => `${this.x(area.time[k]).toFixed(1)} ${this.y(edge[k]).toFixed(1)}`;
      out += `M${rows.map(at(area.low)).join("L")}L${rows.reverse().map(at(area.high)).join("L")}Z`;
      start = -1;
    }
    return out;
  }
  setCursor(time) {
    this.cursor = time;
    const group = this.host.querySelector(".cursor");
    if (!group || !this.x) return;
    const inside = time !== null && time >= this.x.low && time <= this.x.high;
    group.innerHTML = inside ? `<line x1="${this.x(time)}" x2="${this.x(time)}" y1="${this.y(this.y.high)}" y2="${this.y(this.y.low)}"/>` : "";
  }
  point(e) {
    if (!this.x) return;
    this.tip(this.at(e), e);
  }
  tip(time, e) {
    const tip = this.host.querySelector(".tip");
    if (!tip) return;
    tip.hidden = time === null;
    if (time === null) return;
    const s = this.spec;
    const rows = s.series.map((line) => {
      const i = nearest(line.time, time);
      return `<span class="key ${line.kind}"></span>${Chart.escape(line.name)} <b>${Chart.number(line.value[i])}</b> ${s.unit}`;
    });
    const phase = [...(s.phases || []), ...(s.spans || [])].find((p) => time >= p.start && time < p.end);
    tip.innerHTML = `<div class="when">${Chart.escape(s.at(time))}${phase ? " · " + Chart.escape(phase.name) : ""}</div>` + rows.map((r) => `<div>${r}</div>`).join("");
    const box = this.host.getBoundingClientRect(), px = e.clientX - box.left;
    tip.style.left = `${Math.min(Math.max(px + 14, 0), box.width - tip.offsetWidth - 4)}px`;
    if (px + 14 + tip.offsetWidth > box.width) tip.style.left = `${Math.max(0, px - 14 - tip.offsetWidth)}px`;
    tip.style.top = "34px";
  }
}

function nearest(times, t) {
  let a = 0, b = times.length - 1;
  while (b - a > 1) { const m = (a + b) >> 1; if (times[m] <= t) a = m; else b = m; }
  return Math.abs(times[b] - t) < Math.abs(times[a] - t) ? b : a;
}

/** Rows of contact over time. spec: {x, rows: [{label, kind, bars: [[start, end]], count: [[time, n]]}], targets, phases, left}. */
class Schedule {
  constructor(host, pick) {
    this.host = host; this.cursor = null;
    new ResizeObserver(() => this.spec && this.render()).observe(host);
    host.addEventListener("pointerdown", (e) => {
      if (!this.x) return;
      const t = this.x.inverse(e.clientX - host.getBoundingClientRect().left);
      if (t >= this.x.low && t <= this.x.high) pick(t);
    });
  }
  show(spec) { this.spec = spec; this.render(); }
  render() {
    const s = this.spec, width = this.host.clientWidth, narrow = s.narrow;
    if (!width) return;
    const row = narrow ? 42 : 30, left = s.left, right = width - 14, top = 26, bottom = top + row * s.rows.length, height = bottom + 40;
    this.host.style.height = `${height}px`;
    const x = this.x = scale(s.x[0], s.x[1], left, right);
    let out = Chart.phases(s.phases, x, top, bottom, true);
    s.rows.forEach((r, i) => {
      const low = top + row * (i + 1) - 6, full = narrow ? 20 : row - 12;
      out += narrow ? `<text class="row" x="${left + 2}" y="${low - full - 4}">${Chart.escape(r.label)}</text>`
        : `<text class="row" x="${left - 10}" y="${low - full / 2 + 4}" text-anchor="end">${Chart.escape(r.label)}</text>`;
      for (const [a, b] of r.bars) out += `<rect class="contact ${r.kind}" x="${x(a)}" y="${low - full}" width="${Math.max(x(b) - x(a), 1.5)}" height="${full}" rx="2"><title>${Chart.escape(r.label)}: ${a.toFixed(2)} to ${b.toFixed(2)} s</title></rect>`;
      const most = Math.max(...r.count.map((c) => c[1]), 1);
      let path = "";
      r.count.forEach(([t, n], k) => { const h = low - full * n / most; path += `${k ? `H${x(t).toFixed(1)}V${h.toFixed(1)}` : `M${x(t).toFixed(1)} ${low}V${h.toFixed(1)}`}`; });
      if (path) out += `<path class="count ${r.kind}" d="${path}V${low}Z"/>`;
    });
    for (const target of s.targets) {
      for (const i of target.rows) {
        const cx = x(target.time), cy = top + row * (i + 1) - 6 - (narrow ? 20 : row - 12) / 2;
        out += `<path class="target" d="M${cx} ${cy - 6}l6 6l-6 6l-6 -6z"><title>target event of ${Chart.escape(target.name)}, ${target.time.toFixed(2)} s</title></path>`;
      }
    }
    for (const v of Chart.ticks(x.low, x.high, (right - left) / 80)) out += `<text class="tick" x="${x(v)}" y="${bottom + 17}" text-anchor="middle">${Chart.tick(v)}</text>`;
    out += `<text class="axis" x="${right}" y="${height - 5}" text-anchor="end">time [s]</text><line class="axis-line" x1="${left}" x2="${right}" y1="${bottom}" y2="${bottom}"/><g class="cursor"></g>`;
    this.span = [top, bottom];
    this.host.innerHTML = `<svg width="${width}" height="${height}" role="img" aria-label="contact schedule">${out}</svg>`;
    this.setCursor(this.cursor);
  }
  setCursor(time) {
    this.cursor = time;
    const group = this.host.querySelector(".cursor");
    if (!group || !this.x) return;
    group.innerHTML = time === null ? "" : `<line x1="${this.x(time)}" x2="${this.x(time)}" y1="${this.span[0]}" y2="${this.span[1]}"/>`;
  }
}
