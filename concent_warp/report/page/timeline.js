"use strict";
// The timeline: a strip for each channel, coloured by how far the error stands above the noise, with the worst spans marked.

/** Steps of the colour scale: from this many times the noise on. */
const HEAT = [1.5, 3, 6, 12, 25, 50];
const heat = (ratio) => HEAT.filter((from) => ratio >= from).length;

/** Strips over time. spec: {x: [low, high], rows: [{label, strips: [{name, time, ratio}], places: [{number, start, end}]}], phases, left, narrow}. */
class Timeline {
  constructor(host, pick) {
    this.host = host; this.cursor = null;
    new ResizeObserver(() => this.spec && this.render()).observe(host);
    host.addEventListener("pointerdown", (e) => {
      const row = e.target.closest("[data-row]")?.dataset.row;
      if (this.x && row !== undefined) pick(Math.min(this.x.high, Math.max(this.x.low, this.x.inverse(e.clientX - host.getBoundingClientRect().left))), Number(row));
    });
  }
  show(spec) { this.spec = spec; this.render(); }
  /** Root mean square of a strip in pieces of some pixels, as runs of one colour. */
  runs(strip, columns) {
    const { low, high } = this.x, square = new Float64Array(columns), count = new Uint32Array(columns), lost = new Uint8Array(columns);
    strip.time.forEach((t, i) => {
      const k = Math.min(columns - 1, Math.max(0, Math.floor((t - low) / (high - low) * columns))), r = strip.ratio[i];
      if (r === Infinity) lost[k] = 1; else if (Number.isFinite(r)) { square[k] += r * r; count[k]++; }
    });
    const out = [];
    const reach = columns * Math.max(...strip.time.map((t, i) => i ? t - strip.time[i - 1] : 0).slice(1, 200), 0) / (high - low) + 1;
    let last = null, seen = -Infinity;
    for (let k = 0; k < columns; k++) {
      if (lost[k] || count[k]) seen = k;
      const level = lost[k] ? HEAT.length : count[k] ? heat(Math.sqrt(square[k] / count[k])) : last && k - seen <= reach ? last.level : -1;
      if (last && last.level === level) last.end = k + 1;
      else if (level >= 0) out.push(last = { start: k, end: k + 1, level });
      else last = null;
    }
    return out;
  }
  render() {
    const s = this.spec, width = this.host.clientWidth;
    if (!width) return;
    const strips = Math.max(1, ...s.rows.map((r) => r.strips.length)), thick = strips > 1 ? 9 : 14;
    const row = strips * (thick + 1) + (s.narrow ? 26 : 12), left = s.left, right = width - 14, top = 26, bottom = top + row * s.rows.length, height = bottom + 40;
    this.host.style.height = `${height}px`;
    const x = this.x = scale(s.x[0], s.x[1], left, right), columns = Math.max(20, Math.floor((right - left) / 4));
    let out = Chart.phases(s.phases, x, top, bottom, true);
    s.rows.forEach((r, i) => {
      const y = top + row * i + (s.narrow ? 20 : 6), full = r.strips.length * (thick + 1) - 1;
      out += s.narrow ? `<text class="row" x="${left + 2}" y="${y - 5}">${Chart.escape(r.label)}</text>`
        : `<text class="row" x="${left - 10}" y="${y + full / 2 + 4}" text-anchor="end">${Chart.escape(r.label)}</text>`;
      r.strips.forEach((strip, j) => {
        const at = y + j * (thick + 1);
        out += `<rect class="strip" x="${left}" y="${at}" width="${right - left}" height="${thick}"/>`;
        for (const run of this.runs(strip, columns)) {
          const a = left + run.start / columns * (right - left), b = left + run.end / columns * (right - left);
          out += `<rect class="heat${run.level}" x="${a.toFixed(1)}" y="${at}" width="${(b - a).toFixed(1)}" height="${thick}"/>`;
        }
      });
      for (const p of r.places) {
        const a = x(Math.max(p.start, x.low)), b = x(Math.min(p.end, x.high));
        out += `<rect class="place" x="${a - 1}" y="${y - 2}" width="${Math.max(b - a, 3) + 2}" height="${full + 4}" rx="3"/>` + badge((a + b) / 2, y + full / 2, p.number);
      }
      out += `<rect class="hit" data-row="${i}" x="${left}" y="${top + row * i}" width="${right - left}" height="${row}"><title>${Chart.escape(r.label)}</title></rect>`;
    });
    for (const v of Chart.ticks(x.low, x.high, (right - left) / 80)) out += `<text class="tick" x="${x(v)}" y="${bottom + 17}" text-anchor="middle">${Chart.tick(v)}</text>`;
    out += `<text class="axis" x="${right}" y="${height - 5}" text-anchor="end">time [s]</text><line class="axis-line" x1="${left}" x2="${right}" y1="${bottom}" y2="${bottom}"/><g class="cursor"></g>`;
    this.span = [top, bottom];
    this.host.innerHTML = `<svg width="${width}" height="${height}" role="img" aria-label="error over noise of every channel over time">${out}</svg>`;
    this.setCursor(this.cursor);
  }
  setCursor(time) {
    this.cursor = time;
    const group = this.host.querySelector(".cursor");
    if (group && this.x) group.innerHTML = time === null ? "" : `<line x1="${this.x(time)}" x2="${this.x(time)}" y1="${this.span[0]}" y2="${this.span[1]}"/>`;
  }
}

/** The number of a place. */
function badge(x, y, number) {
  return `<g class="badge-mark"><circle cx="${x}" cy="${y}" r="8.5"/><text x="${x}" y="${y + 4}" text-anchor="middle">${number}</text></g>`;
}
