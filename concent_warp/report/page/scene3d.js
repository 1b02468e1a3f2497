"use strict";
// A small WebGL 2 viewer: boxes, spheres, cylinders, capsules and meshes as instances, turned with the mouse or fingers.
// z points up, lengths are metres, quaternions are w x y z.

const Mat = {
  /** Column-major 4x4 matrix of a pose (position, quaternion) and a scale along each axis. */
  pose(p, q, s) {
    const [w, x, y, z] = q, [a, b, c] = s;
    return [
      (1 - 2 * (y * y + z * z)) * a, 2 * (x * y + w * z) * a, 2 * (x * z - w * y) * a, 0,
      2 * (x * y - w * z) * b, (1 - 2 * (x * x + z * z)) * b, 2 * (y * z + w * x) * b, 0,
      2 * (x * z + w * y) * c, 2 * (y * z - w * x) * c, (1 - 2 * (x * x + y * y)) * c, 0,
      p[0], p[1], p[2], 1];
  },
  multiply(m, n) {
    const r = new Array(16).fill(0);
    for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++) for (let k = 0; k < 4; k++) r[4 * j + i] += m[4 * k + i] * n[4 * j + k];
    return r;
  },
  perspective(fov, aspect, near, far) {
    const f = 1 / Math.tan(fov / 2), d = near - far;
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0];
  },
  /** View matrix of a camera at `eye` that looks at `target`. */
  look(eye, target) {
    const z = Vec.unit(Vec.minus(eye, target)), x = Vec.unit(Vec.cross([0, 0, 1], z)), y = Vec.cross(z, x);
    return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -Vec.dot(x, eye), -Vec.dot(y, eye), -Vec.dot(z, eye), 1];
  },
};
const Vec = {
  minus: (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]],
  plus: (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]],
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  length: (a) => Math.hypot(a[0], a[1], a[2]),
  unit: (a) => { const l = Math.hypot(a[0], a[1], a[2]) || 1; return [a[0] / l, a[1] / l, a[2] / l]; },
};
/** Quaternion that turns the z axis into a direction. */
function alongZ(direction) {
  const d = Vec.unit(direction);
  if (d[2] < -0.999999) return [0, 1, 0, 0];
  const q = [1 + d[2], -d[1], d[0], 0], l = Math.hypot(...q);
  return q.map((v) => v / l);
}

/** Unit shapes as flat lists of positions and normals, three vertices a triangle. */
const Shapes = {
  box() {
    const out = { position: [], normal: [] };
    for (let axis = 0; axis < 3; axis++) for (const side of [-1, 1]) {
      const corner = (u, v) => { const p = [0, 0, 0]; p[axis] = side; p[(axis + 1) % 3] = u * side; p[(axis + 2) % 3] = v; return p; };
      const normal = [0, 0, 0]; normal[axis] = side;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) { out.position.push(...corner(u, v)); out.normal.push(...normal); }
    }
    return out;
  },
  grid(rings, sectors, point) {
    const out = { position: [], normal: [] };
    for (let i = 0; i < rings; i++) for (let j = 0; j < sectors; j++) {
      const at = (a, b) => point(a / rings, (b % sectors) / sectors * 2 * Math.PI);
      for (const [a, b] of [[i, j], [i + 1, j], [i + 1, j + 1], [i, j], [i + 1, j + 1], [i, j + 1]]) {
        const [p, n] = at(a, b); out.position.push(...p); out.normal.push(...n);
      }
    }
    return out;
  },
  sphere() {
    return Shapes.grid(10, 18, (t, f) => { const s = Math.sin(t * Math.PI), p = [s * Math.cos(f), s * Math.sin(f), Math.cos(t * Math.PI)]; return [p, p]; });
  },
  cylinder() {
    const side = Shapes.grid(1, 28, (t, f) => [[Math.cos(f), Math.sin(f), 1 - 2 * t], [Math.cos(f), Math.sin(f), 0]]);
    for (const z of [1, -1]) {
      const cap = Shapes.grid(1, 28, (t, f) => [[t * Math.cos(z * f), t * Math.sin(z * f), z], [0, 0, z]]);
      side.position.push(...cap.position); side.normal.push(...cap.normal);
    }
    return side;
  },
  cone() {
    return Shapes.grid(1, 18, (t, f) => [[t * Math.cos(f), t * Math.sin(f), 1 - 2 * t], [Math.cos(f) * 0.9, Math.sin(f) * 0.9, 0.45]]);
  },
  /** Flat-shaded mesh of vertices (n x 3) and faces (m x 3). */
  mesh(vertices, faces) {
    const out = { position: [], normal: [] };
    for (let i = 0; i < faces.length; i += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => Array.from(vertices.subarray(3 * faces[i + k], 3 * faces[i + k] + 3)));
      const n = Vec.unit(Vec.cross(Vec.minus(b, a), Vec.minus(c, a)));
      out.position.push(...a, ...b, ...c); out.normal.push(...n, ...n, ...n);
    }
    return out;
  },
};

const VERTEX = `#version 300 es
layout(location=0) in vec3 position; layout(location=1) in vec3 normal;
layout(location=2) in mat4 place; layout(location=6) in vec4 colour;
uniform mat4 view, projection; out vec3 n, eye; out vec4 rgba;
void main() {
  mat3 m = mat3(place);
  vec3 s = vec3(dot(m[0], m[0]), dot(m[1], m[1]), dot(m[2], m[2]));
  n = mat3(view) * (m * (normal / max(s, 1e-20)));
  vec4 p = view * place * vec4(position, 1.0);
  eye = -p.xyz; rgba = colour; gl_Position = projection * p;
}`;
const FRAGMENT = `#version 300 es
precision highp float; in vec3 n, eye; in vec4 rgba; out vec4 colour;
void main() {
  vec3 m = normalize(n), e = normalize(eye);
  float key = max(dot(m, normalize(vec3(0.35, 0.75, 0.6))), 0.0), fill = 0.5 + 0.5 * m.y;
  float rim = pow(1.0 - max(dot(m, e), 0.0), 3.0);
  float shine = pow(max(dot(m, normalize(normalize(vec3(0.35, 0.75, 0.6)) + e)), 0.0), 40.0);
  vec3 c = rgba.rgb * (0.42 + 0.28 * fill + 0.42 * key) + 0.10 * shine - 0.10 * rim;
  colour = vec4(c, rgba.a);
}`;

/** Where a camera stands; several views may share one. */
class Camera {
  constructor(target, distance, azimuth, elevation) {
    this.home = { target, distance, azimuth, elevation }; this.listeners = []; this.reset();
  }
  reset() { Object.assign(this, { ...this.home, target: [...this.home.target] }); this.changed(); }
  aim(target, distance) { this.home.target = target; this.home.distance = distance; this.reset(); }
  /** Move along with something, so that coming home means coming home to it. */
  shift(by) { this.target = Vec.plus(this.target, by); this.home.target = Vec.plus(this.home.target, by); this.changed(); }
  changed() { for (const f of this.listeners) f(); }
  eye() {
    const c = Math.cos(this.elevation);
    return Vec.plus(this.target, [c * Math.cos(this.azimuth), c * Math.sin(this.azimuth), Math.sin(this.elevation)], this.distance);
  }
  turn(dx, dy) {
    this.azimuth -= dx; this.elevation = Math.min(1.55, Math.max(-1.55, this.elevation + dy)); this.changed();
  }
  zoom(factor) {
    this.distance = Math.min(20 * this.home.distance, Math.max(0.05 * this.home.distance, this.distance * factor)); this.changed();
  }
  pan(dx, dy) {
    const back = Vec.unit(Vec.minus(this.eye(), this.target)), right = Vec.unit(Vec.cross([0, 0, 1], back)), up = Vec.cross(back, right);
    this.target = Vec.plus(Vec.plus(this.target, right, -dx * this.distance), up, dy * this.distance); this.changed();
  }
}

/** One canvas. `draw` gives what is seen: a list of {shape, position, quaternion, scale, colour: [r, g, b, a], above: whether nothing hides it}. */
class View {
  constructor(canvas, camera, meshes, draw) {
    this.canvas = canvas; this.camera = camera; this.draw = draw; this.dirty = false; this.buffers = {};
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: false });
    if (!gl) { canvas.replaceWith(Object.assign(document.createElement("p"), { className: "missing", textContent: "This browser has no WebGL 2, so the 3D view is left out." })); return; }
    this.program = link(gl, VERTEX, FRAGMENT);
    this.uniform = { view: gl.getUniformLocation(this.program, "view"), projection: gl.getUniformLocation(this.program, "projection") };
    for (const name of ["box", "sphere", "cylinder", "cone"]) this.buffers[name] = upload(gl, Shapes[name]());
    for (const [name, mesh] of Object.entries(meshes)) this.buffers[`mesh:${name}`] = upload(gl, Shapes.mesh(mesh.vertices, mesh.faces));
    camera.listeners.push(() => this.refresh());
    new ResizeObserver(() => this.refresh()).observe(canvas);
    steer(canvas, camera);
    this.refresh();
  }
  refresh() {
    if (this.dirty || !this.gl) return;
    this.dirty = true;
    requestAnimationFrame(() => { this.dirty = false; this.render(); });
  }
  render() {
    const gl = this.gl, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) { this.canvas.width = width; this.canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.CULL_FACE);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.program);
    const far = this.camera.distance;
    gl.uniformMatrix4fv(this.uniform.view, false, Mat.look(this.camera.eye(), this.camera.target));
    gl.uniformMatrix4fv(this.uniform.projection, false, Mat.perspective(0.6, width / height, far * 0.02, far * 60));
    const items = this.draw();
    this.pass(items.filter((item) => item.colour[3] >= 1 && !item.above));
    gl.enable(gl.BLEND); gl.depthMask(false);
    this.pass(items.filter((item) => item.colour[3] < 1));
    gl.disable(gl.BLEND); gl.depthMask(true);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.pass(items.filter((item) => item.above));
  }
  pass(items) {
    const gl = this.gl, groups = new Map();
    for (const item of items) { if (!groups.has(item.shape)) groups.set(item.shape, []); groups.get(item.shape).push(item); }
    for (const [shape, members] of groups) {
      const buffer = this.buffers[shape];
      if (!buffer) continue;
      const data = new Float32Array(20 * members.length);
      members.forEach((item, i) => { data.set(Mat.pose(item.position, item.quaternion, item.scale), 20 * i); data.set(item.colour, 20 * i + 16); });
      gl.bindVertexArray(buffer.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer.instances);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, buffer.count, members.length);
    }
  }
}

function link(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

function upload(gl, shape) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  for (const [slot, name] of [[0, "position"], [1, "normal"]]) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(shape[name]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(slot); gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
  }
  const instances = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, instances);
  for (let k = 0; k < 5; k++) {
    gl.enableVertexAttribArray(2 + k); gl.vertexAttribPointer(2 + k, 4, gl.FLOAT, false, 80, 16 * k); gl.vertexAttribDivisor(2 + k, 1);
  }
  return { array, instances, count: shape.position.length / 3 };
}

/** One finger or button turns, two fingers or the right button shift, pinch or wheel zooms, a double click goes home. */
function steer(canvas, camera) {
  const fingers = new Map();
  canvas.tabIndex = 0;
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); canvas.focus({ preventScroll: true }); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const size = canvas.clientHeight, dx = (e.clientX - old[0]) / size, dy = (e.clientY - old[1]) / size;
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== e.pointerId)[1], spread = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      camera.zoom(spread(old) / spread([e.clientX, e.clientY])); camera.pan(dx * 0.3, dy * 0.3);
    } else if (e.buttons & 2 || e.shiftKey) camera.pan(dx * 0.6, dy * 0.6);
    else camera.turn(dx * 3, dy * 3);
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !e.ctrlKey) return;
    e.preventDefault(); camera.zoom(Math.exp(e.deltaY * 0.001));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => camera.reset());
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
  canvas.addEventListener("keydown", (e) => {
    if (keys[e.key]) { e.preventDefault(); camera.turn(...keys[e.key]); }
    else if (e.key === "+" || e.key === "=") camera.zoom(0.9);
    else if (e.key === "-") camera.zoom(1.1);
  });
}

// ---- bodies ---------------------------------------------------------------------------------------------------
const IDENTITY = [1, 0, 0, 0];
function turned(q, v) {
  const [w, x, y, z] = q, t = Vec.cross([x, y, z], v).map((c) => 2 * c);
  return Vec.plus(Vec.plus(v, t, w), Vec.cross([x, y, z], t));
}
function times(p, q) {
  return [p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3], p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
    p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1], p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]];
}
/** Items of one geom of a body at a pose. */
function geomItems(geom, position, quaternion, colour) {
  const at = Vec.plus(position, turned(quaternion, geom.position)), q = times(quaternion, geom.quaternion), [a, b, c] = geom.size;
  const item = (shape, scale, offset = 0) => ({ shape, scale, colour, quaternion: q, position: offset ? Vec.plus(at, turned(q, [0, 0, offset])) : at });
  switch (geom.shape) {
    case "capsule": return [item("cylinder", [a, a, b]), item("sphere", [a, a, a], b), item("sphere", [a, a, a], -b)];
    case "cylinder": return [item("cylinder", [a, a, b])];
    case "sphere": return [item("sphere", [a, a, a])];
    case "ellipsoid": return [item("sphere", [a, b, c])];
    case "mesh": return [item(`mesh:${geom.mesh}`, [1, 1, 1])];
    default: return [item("box", [a, b, c])];
  }
}
