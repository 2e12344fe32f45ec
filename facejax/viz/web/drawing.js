// Drawing of a moving mesh with WebGL 2, and a camera that orbits it. Used by the pages of `facejax.viz.html_viewer` and
// `facejax.export.web`.
//
// `meta` holds: points, face (the vertices of the face, which come first), faces (triangles that give normals; those
// after them close holes), landmarks (points at the end), target, distance, zoom and aspect of the camera, light, tint,
// sky, ground and inside of the shading.

const VERTEX = `#version 300 es
uniform mat3 turn; uniform vec3 eye; uniform vec2 zoom; uniform float lift, rise, dot_size;
in vec3 position, normal; in float cavity; in vec4 surface;
out vec3 n, albedo; out float gloss;
void main() {
  vec3 v = turn * (position - eye);
  v.z += lift;
  n = turn * normal;
  albedo = mix(surface.rgb / 12.92, pow((surface.rgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, surface.rgb)) * cavity;
  gloss = surface.a;
  float near = 10.0, far = 10000.0;
  gl_Position = vec4(v.xy * zoom, (-v.z * (far + near) - 2.0 * far * near) / (far - near), -v.z);
  gl_Position.y += rise * gl_Position.w;
  gl_PointSize = dot_size;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform int mode; uniform vec4 ink; uniform vec3 light[3], tint[3], sky, ground, inside;
in vec3 n, albedo; in float gloss;
out vec4 colour;
vec3 encode(vec3 c) { return mix(c * 12.92, 1.055 * pow(max(c, 1e-5), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
void main() {
  if (mode == 1) { colour = vec4(ink.rgb * ink.a, ink.a); return; }
  if (mode == 2) {
    float cover = 1.0 - smoothstep(0.36, 0.5, length(gl_PointCoord - 0.5));
    colour = vec4(ink.rgb, 1.0) * cover;
    return;
  }
  if (!gl_FrontFacing) { colour = vec4(encode(inside), 1.0); return; }
  vec3 m = normalize(n);
  m.z = max(m.z, 0.0);
  vec3 diffuse = mix(ground, sky, 0.5 + 0.5 * m.y);
  float shine = 0.0;
  for (int i = 0; i < 3; i++) {
    diffuse += pow(max((dot(m, light[i]) + 0.2) / 1.2, 0.0), 1.2) * tint[i];
    vec3 middle = normalize(light[i] + vec3(0, 0, 1));
    shine += pow(max(dot(m, middle), 0.0), 28.0) * dot(tint[i], vec3(1.0 / 3.0)) * 0.35;
  }
  colour = vec4(encode(min(diffuse * albedo + shine * gloss, 1.0)), 1.0);
}`;

function compile(gl) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  ["position", "normal", "cavity", "surface"].forEach((name, i) => gl.bindAttribLocation(program, i, name));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  return name => gl.getUniformLocation(program, name);
}

// Both directions of every edge give a vertex its neighbours; one direction is a line of the wireframe.
function edgesOf(triangles, count, points) {
  const seen = new Set();
  for (let t = 0; t < count; t += 3) {
    for (let k = 0; k < 3; k++) {
      const a = triangles[t + k], b = triangles[t + (k + 1) % 3];
      seen.add(Math.min(a, b) * points + Math.max(a, b));
    }
  }
  const edges = new Uint32Array(2 * seen.size);
  let i = 0;
  for (const key of seen) { edges[i++] = Math.floor(key / points); edges[i++] = key % points; }
  return edges;
}

function normals(positions, triangles, count, result) {
  result.fill(0);
  for (let t = 0; t < count; t += 3) {
    const a = 3 * triangles[t], b = 3 * triangles[t + 1], c = 3 * triangles[t + 2];
    const ux = positions[b] - positions[a], uy = positions[b + 1] - positions[a + 1], uz = positions[b + 2] - positions[a + 2];
    const vx = positions[c] - positions[a], vy = positions[c + 1] - positions[a + 1], vz = positions[c + 2] - positions[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const i of [a, b, c]) { result[i] += x; result[i + 1] += y; result[i + 2] += z; }
  }
  for (let i = 0; i < result.length; i += 3) {
    const length = Math.hypot(result[i], result[i + 1], result[i + 2]) || 1;
    result[i] /= length; result[i + 1] /= length; result[i + 2] /= length;
  }
}

// Brightness from mean curvature: hollows darker, ridges lighter.
function cavities(positions, normal, edges, mean, result) {
  const size = mean.length / 3;
  mean.fill(0);
  const reach = new Float32Array(size), count = new Float32Array(size);
  for (let e = 0; e < edges.length; e += 2) {
    const a = edges[e], b = edges[e + 1];
    const x = positions[3 * b] - positions[3 * a], y = positions[3 * b + 1] - positions[3 * a + 1], z = positions[3 * b + 2] - positions[3 * a + 2];
    const length = Math.hypot(x, y, z);
    mean[3 * a] += x; mean[3 * a + 1] += y; mean[3 * a + 2] += z;
    mean[3 * b] -= x; mean[3 * b + 1] -= y; mean[3 * b + 2] -= z;
    reach[a] += length; reach[b] += length; count[a]++; count[b]++;
  }
  for (let i = 0; i < size; i++) {
    const along = mean[3 * i] * normal[3 * i] + mean[3 * i + 1] * normal[3 * i + 1] + mean[3 * i + 2] * normal[3 * i + 2];
    result[i] = Math.exp(-Math.min(Math.max(1.6 * along / Math.max(reach[i], 1e-9), -0.25), 0.9));
  }
}

// Returns an object with `positions` (3 numbers for each point) to be filled before `update()`, and `draw(options)`.
// `space()` returns the top and bottom of the part of the canvas that is free for the face, in pixels of the page.
function createDrawing(canvas, meta, triangles, surface, space, changed) {
  const gl = canvas.getContext("webgl2", {antialias: true});
  if (!gl) throw Error("This page needs WebGL 2, which this browser does not offer.");
  const edges = edgesOf(triangles, 3 * meta.faces, meta.points);
  const skinEdges = edges.filter((_, i) => edges[i - i % 2] < meta.face);
  const positions = new Float32Array(3 * meta.points), normal = new Float32Array(3 * meta.points);
  const cavity = new Float32Array(meta.points).fill(1), mean = new Float32Array(3 * meta.face);
  const at = compile(gl);
  const buffers = [[positions, 3, gl.FLOAT], [normal, 3, gl.FLOAT], [cavity, 1, gl.FLOAT], [surface, 4, gl.UNSIGNED_BYTE]].map(([data, size, kind], i) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, size, kind, kind === gl.UNSIGNED_BYTE, 0, 0);
    return buffer;
  });
  const indices = gl.createBuffer();
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
  const all = new Uint32Array(triangles.length + edges.length);
  all.set(triangles); all.set(edges, triangles.length);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, all, gl.STATIC_DRAW);
  for (const name of ["light", "tint"]) gl.uniform3fv(at(name), meta[name].flat());
  for (const name of ["sky", "ground", "inside"]) gl.uniform3fv(at(name), meta[name]);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.enable(gl.CULL_FACE);
  gl.polygonOffset(2, 4);

  let view;
  const resetView = () => { view = {yaw: 0, pitch: 0, distance: meta.distance, target: [...meta.target]}; changed(); };
  resetView();

  function update() {
    normals(positions, triangles, 3 * meta.faces, normal);
    cavities(positions, normal, skinEdges, mean, cavity);
    [positions, normal, cavity].forEach((data, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[i]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, data);
    });
  }

  function axes() {
    const [s, c, t, d] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
    return {right: [c, 0, -s], up: [-s * t, d, -c * t], back: [s * d, t, c * d]};
  }

  // The face is centred in what the heading and the controls leave free.
  function fit() {
    const height = canvas.clientHeight, {top, bottom} = space();
    const free = Math.max((bottom - top) / height, 0.3);
    const zoom = meta.zoom * Math.min(free, canvas.clientWidth / height / meta.aspect);
    return {zoom, rise: 1 - (top + bottom) / height};
  }

  function draw({wire = false, marks = false} = {}) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const {right, up, back} = axes();
    const {zoom, rise} = fit();
    gl.uniformMatrix3fv(at("turn"), true, [...right, ...up, ...back]);
    gl.uniform3fv(at("eye"), view.target.map((x, i) => x + view.distance * back[i]));
    gl.uniform2f(at("zoom"), zoom * height / width, zoom);
    gl.uniform1f(at("rise"), rise);
    gl.uniform1f(at("lift"), 0);
    gl.uniform1i(at("mode"), 0);
    // Back faces are pushed away a little: at an outline they would show as a dark rim.
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.cullFace(gl.FRONT);
    gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.cullFace(gl.BACK);
    gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
    if (wire) {
      gl.uniform1f(at("lift"), 0.4);
      gl.uniform1i(at("mode"), 1);
      gl.uniform4f(at("ink"), 0.05, 0.10, 0.20, 0.35);
      gl.drawElements(gl.LINES, edges.length, gl.UNSIGNED_INT, 4 * triangles.length);
    }
    if (marks) {
      gl.uniform1i(at("mode"), 2);
      gl.uniform4f(at("ink"), 0.02, 0.55, 0.95, 1);
      gl.uniform1f(at("lift"), 2.5);
      gl.uniform1f(at("dot_size"), 8 * ratio);
      gl.drawArrays(gl.POINTS, meta.points - meta.landmarks, meta.landmarks);
    }
  }

  const orbit = (x, y) => {
    view.yaw -= x; view.pitch = Math.min(Math.max(view.pitch + y, -1.5), 1.5); changed();
  };
  const zoomBy = factor => { view.distance = Math.min(Math.max(view.distance * factor, 0.15 * meta.distance), 6 * meta.distance); changed(); };
  const pan = (x, y) => {
    const {right, up} = axes(), scale = 2 * view.distance / fit().zoom / canvas.clientHeight;
    view.target = view.target.map((value, i) => value - scale * (x * right[i] - y * up[i]));
    changed();
  };
  const fingers = new Map();
  canvas.onpointerdown = event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); };
  canvas.onpointerup = canvas.onpointercancel = event => fingers.delete(event.pointerId);
  canvas.onpointermove = event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const x = event.clientX - before.clientX, y = event.clientY - before.clientY;
    fingers.set(event.pointerId, event);
    if (fingers.size === 2) {
      const other = [...fingers.values()].find(finger => finger.pointerId !== event.pointerId);
      const gap = finger => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY) || 1;
      zoomBy(gap(before) / gap(event));
      pan(x / 2, y / 2);
    } else if (event.buttons & 6 || event.shiftKey) pan(x, y);
    else orbit(x * 0.008, y * 0.008);
  };
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoomBy(Math.exp(event.deltaY * (event.deltaMode ? 0.04 : 0.0012)));
  }, {passive: false});
  canvas.oncontextmenu = event => event.preventDefault();
  canvas.ondblclick = resetView;
  return {positions, update, draw, orbit, zoomBy, resetView};
}

export {createDrawing};
