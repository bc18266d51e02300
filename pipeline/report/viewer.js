// The 3D view, map and section of the surfaces that the page carries as JSON. Plain WebGL 2, no library.
"use strict";
(() => {
  const TERMS = 13; // of the polynomial that takes pixel and height to x and y
  const STILL_MS = 160; // without movement before all points are drawn again
  const FRAME_MS = 30; // that a frame may take while the view moves: fewer points are drawn where all take longer
  const SECTION_COLOUR = [0.9, 0.0, 0.49];
  const START = { yaw: -0.45, tilt: 0.8, zoom: 1, x: 0, y: 0 };

  const VERTEX = `#version 300 es
    precision highp float; precision highp int; precision highp usampler2D;
    uniform usampler2D heights, colours;
    uniform ivec2 size;
    uniform int stride;
    uniform float x[${TERMS}], y[${TERMS}];
    uniform vec4 scale;      // zero and step of the heights; middle and half range
    uniform vec4 colourScale; // zero, step, low, high
    uniform vec4 across;     // du/dx, dv/dx, du/dy, dv/dy at the middle, pixels per mm
    uniform vec3 centre;
    uniform float exaggeration;
    uniform mat4 view;
    uniform float pixelsPerMm;
    const float STEEPEST = 6.0; // rise over run, 80 degrees: what is steeper bridges a step or is a stray point
    out float seen, known, share, light, torn;
    out vec2 pixel;
    uint code(ivec2 p) { return texelFetch(heights, p, 0).r; }
    float height(uint q) { return scale.x + scale.y * (float(q) - 1.0); }
    float beside(ivec2 p, ivec2 d, float own) { // height one step on, or its own where there is none
      uint q = code(clamp(p + d, ivec2(0), size - 1));
      return q > 0u ? height(q) : own;
    }
    void main() {
      ivec2 p = min(stride * ivec2(gl_VertexID >> 1, gl_InstanceID + (gl_VertexID & 1)), size - 1);
      uint q = code(p);
      seen = q > 0u ? 1.0 : 0.0;
      float z = q > 0u ? height(q) : scale.z;
      vec2 n = (2.0 * vec2(p) - vec2(size - 1)) / vec2(max(size - 1, ivec2(1)));
      float h = (z - scale.z) / scale.w;
      float terms[${TERMS}] = float[${TERMS}](1.0, n.x, n.y, n.x * n.x, n.x * n.y, n.y * n.y, h, h * n.x, h * n.y,
        n.x * n.x * n.x, n.x * n.x * n.y, n.x * n.y * n.y, n.y * n.y * n.y);
      vec3 at = vec3(0.0, 0.0, z);
      for (int i = 0; i < ${TERMS}; i++) at.xy += vec2(x[i], y[i]) * terms[i];
      vec4 around = vec4(beside(p, ivec2(-stride, 0), z), beside(p, ivec2(stride, 0), z),
        beside(p, ivec2(0, -stride), z), beside(p, ivec2(0, stride), z));
      vec2 s = (around.yw - around.xz) / float(2 * stride);
      vec4 jump = abs(around - z);
      float steepest = max(max(jump.x, jump.y), max(jump.z, jump.w)) * pixelsPerMm / float(stride);
      torn = steepest > STEEPEST ? 1.0 : 0.0;
      vec3 normal = normalize(vec3(-exaggeration * vec2(dot(s, across.xy), dot(s, across.zw)), 1.0));
      light = 0.5 + 0.55 * max(dot(normal, normalize(vec3(-0.4, 0.5, 0.9))), 0.0);
      uint c = texelFetch(colours, p, 0).r;
      known = c > 0u ? 1.0 : 0.0;
      share = (colourScale.x + colourScale.y * (float(c) - 1.0) - colourScale.z) / (colourScale.w - colourScale.z);
      pixel = vec2(p);
      at -= centre;
      at.z *= exaggeration;
      gl_Position = view * vec4(at, 1.0);
    }`;

  const FRAGMENT = `#version 300 es
    precision highp float;
    uniform sampler2D palette;
    uniform vec3 section; // a u + b v + c: distance from the section's line in pixels
    uniform vec3 sectionColour;
    uniform bool picking;
    in float seen, known, share, light, torn;
    in vec2 pixel;
    out vec4 colour;
    void main() {
      if (seen < 0.99 || torn > 0.99) discard;
      if (picking) {
        vec2 p = floor(pixel + 0.5);
        colour = vec4(mod(p, 256.0), floor(p / 256.0)) / 255.0;
        return;
      }
      float s = (clamp(share, 0.0, 1.0) * 255.0 + 0.5) / 256.0;
      vec3 own = known > 0.99 ? texture(palette, vec2(s, 0.5)).rgb : vec3(0.55);
      float away = dot(section, vec3(pixel, 1.0));
      float width = max(fwidth(away), 1e-4);
      own *= light;
      colour = vec4(mix(sectionColour, own, smoothstep(0.8, 1.6, abs(away) / width)), 1.0);
    }`;

  const byId = (id) => document.getElementById(id);
  const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  async function inflated(text) {
    const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Codes of a layer: low bytes, then high bytes, of zigzag differences from one pixel to the next. 0 is no value.
  async function codesOf(text, count) {
    const bytes = await inflated(text);
    const codes = new Uint16Array(count);
    for (let i = 0, last = 0; i < count; i++) {
      const zigzag = bytes[i] | (bytes[count + i] << 8);
      last = (last + ((zigzag >>> 1) ^ -(zigzag & 1))) & 0xffff;
      codes[i] = last;
    }
    return codes;
  }

  async function decoded(surface) {
    for (const layer of surface.layers) {
      if (!layer.codes) layer.codes = await codesOf(layer.data, surface.rows * surface.cols);
      layer.data = "";
      if (layer.lookup) continue;
      const palette = bytesOf(palettes[layer.palette]);
      layer.rgba = new Uint8Array(1024);
      for (let i = 0; i < 256; i++) layer.rgba.set([palette[3 * i], palette[3 * i + 1], palette[3 * i + 2], 255], 4 * i);
      layer.lookup = new Uint32Array(layer.rgba.buffer);
    }
    return surface;
  }

  const valueAt = (layer, i) => (layer.codes[i] ? layer.zero + layer.step * (layer.codes[i] - 1) : NaN);

  function placeAt(surface, u, v, z) {
    const n = (2 * u - surface.cols + 1) / Math.max(surface.cols - 1, 1);
    const m = (2 * v - surface.rows + 1) / Math.max(surface.rows - 1, 1);
    const h = (z - surface.z_middle) / surface.z_half;
    const terms = [1, n, m, n * n, n * m, m * m, h, h * n, h * m, n * n * n, n * n * m, n * m * m, m * m * m];
    const sum = (coefficients) => terms.reduce((total, term, i) => total + coefficients[i] * term, 0);
    return [sum(surface.x), sum(surface.y)];
  }

  // The section through `at`, as the ends of its line inside the picture, pixels.
  function sectionEnds(surface, at, angle) {
    const [du, dv] = [Math.cos(angle), -Math.sin(angle)];
    let [from, to] = [-Infinity, Infinity];
    for (const [start, way, last] of [[at[0], du, surface.cols - 1], [at[1], dv, surface.rows - 1]]) {
      if (Math.abs(way) < 1e-9) continue;
      const ends = [-start / way, (last - start) / way].sort((a, b) => a - b);
      from = Math.max(from, ends[0]);
      to = Math.min(to, ends[1]);
    }
    return [[at[0] + from * du, at[1] + from * dv], [at[0] + to * du, at[1] + to * dv]];
  }

  // Distance along the section in mm and value at the nearest pixels; NaN where there is none.
  function profileOf(surface, layer, ends) {
    const [[u0, v0], [u1, v1]] = ends;
    const count = Math.max(1, Math.round(Math.max(Math.abs(u1 - u0), Math.abs(v1 - v0)))) + 1;
    const start = placeAt(surface, u0, v0, surface.z_middle), end = placeAt(surface, u1, v1, surface.z_middle);
    const length = Math.hypot(end[0] - start[0], end[1] - start[1]) || 1;
    const way = [(end[0] - start[0]) / length, (end[1] - start[1]) / length];
    const points = [];
    for (let k = 0; k < count; k++) {
      const t = count > 1 ? k / (count - 1) : 0;
      const u = Math.round(u0 + t * (u1 - u0)), v = Math.round(v0 + t * (v1 - v0));
      const i = v * surface.cols + u, z = valueAt(surface.layers[0], i);
      const [x, y] = placeAt(surface, u, v, Number.isNaN(z) ? surface.z_middle : z);
      points.push([(x - start[0]) * way[0] + (y - start[1]) * way[1], valueAt(layer, i)]);
    }
    return points;
  }

  // 3D ---------------------------------------------------------------------------------------------------------------

  function programOf(gl) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    const at = new Proxy({}, { get: (known, name) => (known[name] ??= gl.getUniformLocation(program, name)) });
    gl.uniform1i(at.heights, 0);
    gl.uniform1i(at.colours, 1);
    gl.uniform1i(at.palette, 2);
    gl.uniform3fv(at.sectionColour, SECTION_COLOUR);
    gl.enable(gl.DEPTH_TEST);
    gl.bindVertexArray(gl.createVertexArray());
    return at;
  }

  function upload(gl, unit, filter, ...image) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(gl.getParameter(gl.TEXTURE_BINDING_2D));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    gl.texImage2D(gl.TEXTURE_2D, 0, ...image);
  }

  const product = (a, b) => { // 4 x 4, columns one after the other
    const c = new Array(16).fill(0);
    for (let i = 0; i < 16; i++) for (let k = 0; k < 4; k++) c[i] += a[4 * k + (i % 4)] * b[4 * (i >> 2) + k];
    return c;
  };

  function viewMatrix(camera, radius, aspect) {
    const f = 1 / Math.tan(0.22), distance = 3.9 / camera.zoom / Math.min(1, aspect), [near, far] = [0.05, 200];
    const [cy, sy, ct, st] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.tilt), Math.sin(camera.tilt)];
    const [a, b] = [(near + far) / (near - far), (2 * near * far) / (near - far)];
    const lens = [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, a, -1, 0, 0, b, 0];
    const back = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, camera.x, camera.y, -distance, 1];
    const tilted = [1, 0, 0, 0, 0, ct, -st, 0, 0, st, ct, 0, 0, 0, 0, 1];
    const turned = [cy / radius, sy / radius, 0, 0, -sy / radius, cy / radius, 0, 0, 0, 0, 1 / radius, 0, 0, 0, 0, 1];
    return product(lens, product(back, product(tilted, turned)));
  }

  // Profile ----------------------------------------------------------------------------------------------------------

  const svg = (name, attributes, text) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    return element;
  };

  function ticks(low, high, wanted) {
    const rough = (high - low) / wanted || 1, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k++) {
      found.push([k * step, (k * step).toFixed(digits).replace(/^-(?=0(\.0*)?$)/, "").replace("-", "−")]);
    }
    return found;
  }

  function plot(target, points, unit) {
    const width = Math.max(260, target.clientWidth), height = Math.max(160, target.clientHeight);
    const [left, right, top, bottom] = [62, 12, 10, 42];
    target.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const finite = points.filter((point) => !Number.isNaN(point[1]));
    const values = finite.map((point) => point[1]);
    let [low, high] = finite.length ? [Math.min(...values), Math.max(...values)] : [0, 1];
    const room = 0.06 * (high - low) || 1e-3;
    [low, high] = [low - room, high + room];
    const length = Math.max(...points.map((point) => point[0])) || 1;
    const sx = (width - left - right) / length, sy = -(height - top - bottom) / (high - low);
    const tx = left, ty = top - sy * high;
    const parts = [];
    for (const [s, label] of ticks(0, length, width / 90)) {
      const x = tx + sx * s;
      parts.push(svg("line", { x1: x, x2: x, y1: top, y2: height - bottom, class: "grid" }));
      parts.push(svg("text", { x, y: height - bottom + 16, "text-anchor": "middle" }, label));
    }
    for (const [z, label] of ticks(low, high, height / 45)) {
      const y = ty + sy * z;
      parts.push(svg("line", { x1: left, x2: width - right, y1: y, y2: y, class: "grid" }));
      parts.push(svg("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, label));
    }
    const middle = (left + width - right) / 2;
    parts.push(svg("text", { x: middle, y: height - 6, "text-anchor": "middle" }, "along the section (mm)"));
    const turn = `translate(13 ${(top + height - bottom) / 2}) rotate(-90)`;
    parts.push(svg("text", { transform: turn, "text-anchor": "middle" }, unit));
    let drawn = "", pen = false;
    for (const [s, z] of points) { // in mm and the layer's unit: the matrix brings them onto the page
      if (Number.isNaN(z)) pen = false;
      else {
        drawn += `${pen ? "L" : "M"}${s.toFixed(5)} ${z.toFixed(5)}`;
        pen = true;
      }
    }
    const matrix = `matrix(${sx} 0 0 ${sy} ${tx} ${ty})`;
    parts.push(svg("path", { d: drawn, class: "curve", transform: matrix, "vector-effect": "non-scaling-stroke" }));
    target.replaceChildren(...parts);
  }

  // The viewer -------------------------------------------------------------------------------------------------------

  let palettes = {};

  function start() {
    const box = byId("viewer");
    if (!box) return;
    palettes = JSON.parse(byId("palettes").textContent);
    const carriers = [...document.querySelectorAll("script.surface")];
    const space = byId("space"), map = byId("map"), profile = byId("profile"), bar = byId("bar");
    const choose = byId("surface"), layers = byId("layer"), stretch = byId("stretch"), direction = byId("direction");
    const gl = space.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    const at = gl && programOf(gl);
    byId("no-webgl").hidden = Boolean(gl);
    const known = new Map();
    let surface, layer, picture, section, camera = { ...START }, stride = 1, moved = -1e9, pending = 0, moving = 1, whole = 0, points = [];

    const exaggeration = () => 10 ** Number(stretch.value);
    const number = (value, digits) => value.toFixed(digits).replace("-", "−");

    for (const [k, carrier] of carriers.entries()) {
      choose.append(new Option(carrier.dataset.name, k));
    }

    async function show(k) {
      if (!known.has(k)) known.set(k, JSON.parse(carriers[k].textContent));
      const wanted = await decoded(known.get(k));
      if (Number(choose.value) !== k) return;
      surface = wanted;
      const before = layers.value;
      layers.replaceChildren(...surface.layers.map((each) => new Option(each.name, each.name)));
      if (surface.layers.some((each) => each.name === before)) layers.value = before;
      byId("note").textContent = surface.note;
      stretch.value = Math.log10(surface.exaggeration);
      section = { at: [(surface.cols - 1) / 2, (surface.rows - 1) / 2], angle: (Number(direction.value) * Math.PI) / 180 };
      section.at = section.at.map(Math.round);
      map.width = surface.cols;
      map.height = surface.rows;
      map.style.maxWidth = `${(31 * surface.cols) / surface.rows}rem`; // no higher than the view beside it
      if (gl) {
        const shape = [surface.cols, surface.rows, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT];
        upload(gl, 0, gl.NEAREST, gl.R16UI, ...shape, surface.layers[0].codes);
        const z = surface.layers[0];
        gl.uniform2i(at.size, surface.cols, surface.rows);
        gl.uniform1fv(at.x, surface.x);
        gl.uniform1fv(at.y, surface.y);
        gl.uniform4f(at.scale, z.zero, z.step, surface.z_middle, surface.z_half);
        gl.uniform4fv(at.across, surface.across);
        const [a, b, c, d] = surface.across;
        gl.uniform1f(at.pixelsPerMm, Math.sqrt(Math.abs(a * d - b * c)));
        gl.uniform3fv(at.centre, surface.centre);
      }
      colour();
      if (gl) moving = strideFor(timed());
    }

    function colour() {
      layer = surface.layers.find((each) => each.name === layers.value);
      if (gl) {
        const shape = [surface.cols, surface.rows, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT];
        upload(gl, 1, gl.NEAREST, gl.R16UI, ...shape, layer.codes);
        upload(gl, 2, gl.LINEAR, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, layer.rgba);
        gl.uniform4f(at.colourScale, layer.zero, layer.step, layer.low, layer.high);
      }
      const context = bar.getContext("2d");
      bar.width = 256;
      bar.height = 1;
      context.putImageData(new ImageData(new Uint8ClampedArray(layer.rgba), 256, 1), 0, 0);
      byId("low").textContent = number(layer.low, layer.digits);
      byId("high").textContent = `${number(layer.high, layer.digits)} ${layer.unit}`;
      picture = pictureOf(surface, layer);
      draw();
    }

    function pictureOf(of, by) {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [of.cols, of.rows];
      const image = new ImageData(of.cols, of.rows), pixels = new Uint32Array(image.data.buffer);
      const factor = 255 / (by.high - by.low);
      for (let i = 0; i < pixels.length; i++) {
        const code = by.codes[i];
        if (!code) continue;
        const share = Math.round(factor * (by.zero + by.step * (code - 1) - by.low));
        pixels[i] = by.lookup[share < 0 ? 0 : share > 255 ? 255 : share];
      }
      canvas.getContext("2d").putImageData(image, 0, 0);
      return canvas;
    }

    function draw() {
      drawMap();
      drawSection();
      redraw();
    }

    function drawMap() {
      const context = map.getContext("2d");
      context.clearRect(0, 0, map.width, map.height);
      context.drawImage(picture, 0, 0);
      const ends = sectionEnds(surface, section.at, section.angle);
      const unit = map.width / Math.max(1, map.clientWidth);
      for (const [style, width] of [["#fff", 3.5], ["#e6007d", 1.8]]) {
        context.strokeStyle = style;
        context.lineWidth = width * unit;
        context.beginPath();
        context.moveTo(...ends[0]);
        context.lineTo(...ends[1]);
        context.stroke();
        context.beginPath();
        context.arc(...section.at, 5 * unit, 0, 2 * Math.PI);
        context.stroke();
      }
    }

    function drawSection() {
      const ends = sectionEnds(surface, section.at, section.angle);
      points = profileOf(surface, layer, ends);
      plot(profile, points, `${layer.name} (${layer.unit})`);
      const i = section.at[1] * surface.cols + section.at[0], z = valueAt(surface.layers[0], i);
      const [x, y] = placeAt(surface, ...section.at, Number.isNaN(z) ? surface.z_middle : z);
      const turn = Math.round((section.angle * 180) / Math.PI);
      const where = `Section at ${turn}° through column ${surface.col0 + surface.pixel_step * section.at[0]}, row ` +
        `${surface.row0 + surface.pixel_step * section.at[1]}: x ${number(x, 3)} mm, y ${number(y, 3)} mm`;
      const values = surface.layers.map((each) => [each, valueAt(each, i)]).filter(([, value]) => !Number.isNaN(value));
      const told = values.map(([each, value]) => `${each.name} ${number(value, each.digits + 1)} ${each.unit}`);
      byId("where").textContent = [where, ...(told.length ? told : ["no point here"])].join(", ");
    }

    function setSection(u, v) {
      const clamp = (value, count) => Math.min(count - 1, Math.max(0, Math.round(value)));
      section.at = [clamp(u, surface.cols), clamp(v, surface.rows)];
      draw();
    }

    function paint(each, picking) {
      const [width, height] = [space.width, space.height];
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      if (picking) gl.clearColor(1, 1, 1, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const [nu, nv] = [Math.sin(section.angle), Math.cos(section.angle)];
      gl.uniform3f(at.section, nu, nv, -nu * section.at[0] - nv * section.at[1]);
      gl.uniform1i(at.picking, picking ? 1 : 0);
      gl.uniform1i(at.stride, each);
      gl.uniform1f(at.exaggeration, exaggeration());
      gl.uniformMatrix4fv(at.view, false, viewMatrix(camera, surface.radius, width / height));
      const strips = Math.ceil((surface.rows - 1) / each), along = Math.ceil((surface.cols - 1) / each) + 1;
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 2 * along, strips);
    }

    function redraw() {
      byId("times").textContent = `× ${exaggeration() < 10 ? exaggeration().toFixed(1) : Math.round(exaggeration())}`;
      if (!gl || pending || !surface) return;
      pending = requestAnimationFrame(() => {
        pending = 0;
        const ratio = Math.min(2, window.devicePixelRatio || 1);
        const size = [Math.round(space.clientWidth * ratio), Math.round(space.clientHeight * ratio)];
        if (space.width !== size[0] || space.height !== size[1]) [space.width, space.height] = size;
        const rest = Math.max(STILL_MS, Math.min(whole, 1000));
        const still = performance.now() - moved >= rest;
        stride = still ? 1 : moving;
        paint(stride, false);
        space.dataset.stride = stride;
        if (!still) setTimeout(redraw, rest + 20);
      });
    }

    // How long all points take to be drawn, ms: reading a pixel waits for them.
    function timed() {
      const before = performance.now();
      paint(1, false);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      return (whole = performance.now() - before);
    }

    const strideFor = (took) => {
      const coarsest = Math.max(1, Math.floor(Math.min(surface.rows, surface.cols) / 60));
      return Math.min(coarsest, Math.max(1, Math.ceil(Math.sqrt(took / FRAME_MS))));
    };

    function move() { // the view changes: fewer points as long as it does, so few that it stays fluid
      moved = performance.now();
      redraw();
    }

    function picked(x, y) {
      const [width, height] = [space.width, space.height];
      const target = gl.createFramebuffer(), parts = [gl.RGBA8, gl.DEPTH_COMPONENT16].map((format, k) => {
        const part = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, part);
        gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        const place = k ? gl.DEPTH_ATTACHMENT : gl.COLOR_ATTACHMENT0;
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, part);
        return part;
      });
      paint(1, true);
      const rgba = new Uint8Array(4);
      const [px, py] = [(x * width) / space.clientWidth, height - 1 - (y * height) / space.clientHeight];
      gl.readPixels(Math.round(px), Math.round(py), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.deleteFramebuffer(target);
      parts.forEach((part) => gl.deleteRenderbuffer(part));
      const [u, v] = [rgba[0] + 256 * rgba[2], rgba[1] + 256 * rgba[3]];
      return u < surface.cols && v < surface.rows ? [u, v] : null;
    }

    // Pointers: one turns (with shift, moves), two zoom; a click sets the section.
    const held = new Map();
    let far = 0, apart = 0;
    space.addEventListener("pointerdown", (event) => {
      held.set(event.pointerId, [event.offsetX, event.offsetY]);
      space.setPointerCapture(event.pointerId);
      if (held.size === 1) far = 0;
      apart = 0;
    });
    space.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.offsetX - before[0], event.offsetY - before[1]];
      far += Math.abs(dx) + Math.abs(dy);
      held.set(event.pointerId, [event.offsetX, event.offsetY]);
      if (held.size === 2) {
        const [a, b] = [...held.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (apart) camera.zoom = Math.min(30, Math.max(0.3, (camera.zoom * now) / apart));
        apart = now;
      } else if (event.shiftKey || event.buttons === 2) {
        camera.x += (2.2 * dx) / space.clientHeight / camera.zoom;
        camera.y -= (2.2 * dy) / space.clientHeight / camera.zoom;
      } else if (far > 4) {
        camera.yaw += 0.008 * dx;
        camera.tilt = Math.min(Math.PI / 2, Math.max(0, camera.tilt - 0.008 * dy));
      }
      move();
    });
    const released = (event) => {
      const mine = held.delete(event.pointerId);
      if (mine && event.type === "pointerup" && far <= 4 && gl && surface) {
        const found = picked(event.offsetX, event.offsetY);
        if (found) setSection(...found);
        else redraw();
      }
    };
    space.addEventListener("pointerup", released);
    space.addEventListener("pointercancel", released);
    space.addEventListener("contextmenu", (event) => event.preventDefault());
    space.addEventListener("wheel", (event) => {
      if (document.activeElement !== space) return; // the page scrolls until the view has been clicked
      event.preventDefault();
      camera.zoom = Math.min(30, Math.max(0.3, camera.zoom * Math.exp(-0.0015 * event.deltaY)));
      move();
    }, { passive: false });
    space.addEventListener("keydown", (event) => {
      const step = 0.08, keys = {
        ArrowLeft: () => (camera.yaw -= step),
        ArrowRight: () => (camera.yaw += step),
        ArrowUp: () => (camera.tilt = Math.max(0, camera.tilt - step)),
        ArrowDown: () => (camera.tilt = Math.min(Math.PI / 2, camera.tilt + step)),
        "+": () => (camera.zoom = Math.min(30, camera.zoom * 1.15)),
        "-": () => (camera.zoom = Math.max(0.3, camera.zoom / 1.15)),
        0: () => (camera = { ...START }),
      };
      if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
      move();
    });

    map.addEventListener("click", (event) => {
      const box = map.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      setSection((x / box.width) * map.width - 0.5, (y / box.height) * map.height - 0.5);
    });
    map.addEventListener("keydown", (event) => {
      const step = event.shiftKey ? 20 : 1, [u, v] = section.at;
      const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (!(event.key in ways)) return;
      event.preventDefault();
      setSection(u + step * ways[event.key][0], v + step * ways[event.key][1]);
    });

    choose.addEventListener("change", () => show(Number(choose.value)));
    layers.addEventListener("change", colour);
    stretch.addEventListener("input", move);
    direction.addEventListener("input", () => {
      section.angle = (Number(direction.value) * Math.PI) / 180;
      draw();
    });
    byId("from-above").addEventListener("click", () => {
      camera = { ...START, yaw: 0, tilt: 0 };
      redraw();
    });
    byId("reset").addEventListener("click", () => {
      camera = { ...START };
      stretch.value = Math.log10(surface.exaggeration);
      redraw();
    });
    byId("save").addEventListener("click", () => { // for other programs: points as before, separated by commas
      const rows = points.filter(([, value]) => !Number.isNaN(value)).map((row) => row.map((x) => x.toFixed(5)).join(","));
      const link = document.createElement("a");
      const text = [`along the section (mm),${layer.name} (${layer.unit})`, ...rows, ""].join("\n");
      link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
      link.download = "section.csv";
      link.click();
      URL.revokeObjectURL(link.href);
    });
    new ResizeObserver(() => surface && draw()).observe(box);
    show(Number(choose.value)).then(() => (box.dataset.ready = "yes"));
  }

  // Tables ----------------------------------------------------------------------------------------------------------

  for (const search of document.querySelectorAll("input.rows")) {
    const block = search.closest("p"), table = block.nextElementSibling;
    const rows = [...table.querySelectorAll("tbody tr:not(.group)")];
    search.addEventListener("input", () => {
      const words = search.value.toLowerCase().split(/\s+/);
      const texts = rows.map((row) => row.textContent.toLowerCase());
      const found = texts.map((text) => words.every((word) => text.includes(word)));
      rows.forEach((row, k) => (row.hidden = !found[k]));
      for (const group of table.querySelectorAll("tr.group")) {
        group.hidden = !group.parentElement.querySelector("tr:not(.group):not([hidden])");
      }
      block.querySelector("output").textContent = `${found.filter(Boolean).length} of ${rows.length}`;
    });
  }

  start();
})();
