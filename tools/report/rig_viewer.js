// The rig in the page: reads the GLB that the page carries, poses it by sliders, draws it.
// Nothing is fetched and nothing is needed beside WebGL 2. Lengths are millimetres.
"use strict";
(() => {
  const root = document.querySelector(".rigview");
  if (!root) return;
  const one = (selector) => root.querySelector(selector);
  const all = (selector) => [...root.querySelectorAll(selector)];

  const VIEWS = { 5120: Int8Array, 5122: Int16Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
  const LARGEST = { 5120: 127, 5122: 32767, 5123: 65535 };
  const WIDTH = { SCALAR: 1, VEC3: 3 };
  function bytesOf(address) {
    return Uint8Array.from(atob(address.slice(address.indexOf(",") + 1)), (c) => c.charCodeAt(0));
  }

  function readGlb(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    if (view.getUint32(0, true) !== 0x46546c67) throw new Error("the rig in this page is damaged");
    const size = view.getUint32(12, true);
    const text = new TextDecoder().decode(bytes.subarray(20, 20 + size));
    return { ...JSON.parse(text), bytes: bytes.subarray(28 + size) };
  }

  function raw(file, viewIndex, kind, count, width) {
    const from = file.bytes.byteOffset + file.bufferViews[viewIndex].byteOffset;
    const Numbers = VIEWS[kind], length = count * width * Numbers.BYTES_PER_ELEMENT;
    return new Numbers(file.bytes.buffer.slice(from, from + length));
  }

  function scaled(numbers, accessor, scale) {
    const by = scale / (accessor.normalized ? LARGEST[accessor.componentType] : 1);
    return Float32Array.from(numbers, (value) => value * by);
  }

  function dense(file, index, scale = 1) {
    const a = file.accessors[index];
    return scaled(raw(file, a.bufferView, a.componentType, a.count, WIDTH[a.type]), a, scale);
  }

  function sparse(file, index, scale) {  // the rows that a morph target moves, and how far
    const a = file.accessors[index];
    if (!a.sparse) return { rows: new Uint16Array(0), offsets: new Float32Array(0) };
    const { count, indices, values } = a.sparse;
    const rows = raw(file, indices.bufferView, indices.componentType, count, 1);
    const offsets = raw(file, values.bufferView, a.componentType, count, 3);
    return { rows, offsets: scaled(offsets, a, scale) };
  }

  function readRig(link) {
    const file = readGlb(bytesOf(link.href));
    const mesh = file.meshes[0], primitive = mesh.primitives[0];
    const scale = 1000 * file.nodes[0].scale[0];
    const sampler = file.animations && file.animations[0].samplers[0];
    return {
      names: mesh.extras.targetNames || [],
      quads: mesh.extras.quads,
      neutral: dense(file, primitive.attributes.POSITION, scale),
      triangles: Uint32Array.from(dense(file, primitive.indices)),
      targets: (primitive.targets || []).map((t) => sparse(file, t.POSITION, scale)),
      times: sampler ? dense(file, sampler.input) : new Float32Array(0),
      weights: sampler ? dense(file, sampler.output) : new Float32Array(0),
    };
  }

  function add(out, target, weight) {
    const { rows, offsets } = target;
    for (let i = 0, k = 0; i < rows.length; i++) {
      const at = 3 * rows[i];
      out[at] += weight * offsets[k++];
      out[at + 1] += weight * offsets[k++];
      out[at + 2] += weight * offsets[k++];
    }
  }

  function posed(neutral, targetSets, weights, out) {
    out.set(neutral);
    weights.forEach((weight, b) => {
      if (weight !== 0) for (const targets of targetSets) add(out, targets[b], weight);
    });
    return out;
  }

  function normalsOf(points, triangles, out) {
    out.fill(0);
    for (let t = 0; t < triangles.length; t += 3) {
      const a = 3 * triangles[t], b = 3 * triangles[t + 1], c = 3 * triangles[t + 2];
      const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1];
      const uz = points[b + 2] - points[a + 2], vx = points[c] - points[a];
      const vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      for (const at of [a, b, c]) { out[at] += x; out[at + 1] += y; out[at + 2] += z; }
    }
    return out;
  }

  function outward(points, normals, centre) {  // 1, or -1 where polygons are wound the other way
    let sum = 0;
    for (let i = 0; i < points.length; i++) sum += normals[i] * (points[i] - centre[i % 3]);
    return sum < 0 ? -1 : 1;
  }

  function edgesOf(triangles, quads) {  // each once, without the diagonals of quads
    const count = triangles.length / 3, keys = new Set();
    for (let t = 0; t < count; t++) {
      for (let k = 0; k < 3; k++) {
        if ((t < quads && k === 2) || (t >= count - quads && k === 0)) continue;
        const a = triangles[3 * t + k], b = triangles[3 * t + (k + 1) % 3];
        keys.add(Math.min(a, b) * 0x4000000 + Math.max(a, b));
      }
    }
    return Uint32Array.from([...keys].flatMap((key) => [Math.floor(key / 0x4000000), key % 0x4000000]));
  }

  function distances(a, b, out) {  // gives the largest
    for (let v = 0, k = 0; v < out.length; v++, k += 3)
      out[v] = Math.hypot(a[k] - b[k], a[k + 1] - b[k + 1], a[k + 2] - b[k + 2]);
    return out.reduce((most, value) => Math.max(most, value), 0);
  }

  const VERTEX = `#version 300 es
    in vec3 point; in vec3 normal; in float level;
    uniform mat3 turn; uniform vec3 target, eye; uniform vec2 focal, depth;
    out vec3 facing; out float shade;
    void main() {
      vec3 seen = turn * (point - target) - eye;
      facing = turn * normal;
      shade = level;
      gl_Position = vec4(focal * seen.xy, (-(depth.y + depth.x) * seen.z - 2.0 * depth.y * depth.x)
        / (depth.y - depth.x), -seen.z);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 facing; in float shade; out vec4 colour;
    uniform vec3 ramp[5]; uniform float side; uniform int mode;
    const vec3 SKIN = vec3(0.80, 0.74, 0.70);
    vec3 ramped(float x) {
      float place = clamp(x, 0.0, 1.0) * 4.0;
      int low = min(int(place), 3);
      return mix(ramp[low], ramp[low + 1], place - float(low));
    }
    void main() {
      if (mode == 2) { colour = vec4(0.12, 0.15, 0.2, 1.0); return; }
      vec3 n = normalize(facing) * side;
      bool inside = n.z < -0.2;
      if (n.z < 0.0) n = -n;
      float light = 0.16 + 0.62 * max(dot(n, normalize(vec3(-0.55, 0.65, 0.6))), 0.0)
        + 0.30 * max(dot(n, normalize(vec3(0.75, 0.1, 0.55))), 0.0)
        + 0.10 * max(dot(n, normalize(vec3(0.2, -0.9, 0.2))), 0.0);
      vec3 albedo = mode == 1 ? ramped(shade) : SKIN;
      vec3 lit = pow(albedo * light, vec3(1.0 / 1.35));
      colour = vec4(inside ? 0.35 * lit : lit, 1.0);
    }`;

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    ["point", "normal", "level"].forEach((name, at) => gl.bindAttribLocation(made, at, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  function painter(gl, rig, ramp) {
    const made = program(gl);
    const place = (name) => gl.getUniformLocation(made, name);
    const buffers = [3, 3, 1].map((width, at) => {  // points, normals, levels
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, width, gl.FLOAT, false, 0, 0);
      return buffer;
    });
    const lists = [rig.triangles, edgesOf(rig.triangles, rig.quads)];
    const indices = lists.map((list) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, list, gl.STATIC_DRAW);
      return buffer;
    });
    gl.useProgram(made);
    gl.uniform3fv(place("ramp"), ramp.flat().map((value) => value / 255));
    gl.enable(gl.DEPTH_TEST);
    gl.polygonOffset(1, 1);
    const fill = (at, numbers) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[at]);
      gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.DYNAMIC_DRAW);
    };
    const draw = (camera, look) => {
      const { width, height } = gl.canvas;
      gl.viewport(0, 0, width, height);
      gl.clearColor(0.965, 0.972, 0.98, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const small = Math.min(width, height);
      const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw);
      const cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
      gl.uniformMatrix3fv(place("turn"), false, [cy, -sy * sp, sy * cp, 0, cp, sp, -sy, -cy * sp, cy * cp]);
      gl.uniform3fv(place("target"), camera.target);
      gl.uniform3f(place("eye"), camera.right, camera.up, camera.away);
      gl.uniform2f(place("focal"), 4 * small / width, 4 * small / height);
      gl.uniform2f(place("depth"), Math.max(1, camera.away - camera.reach), camera.away + camera.reach);
      gl.uniform1f(place("side"), look.side);
      gl.uniform1i(place("mode"), look.coloured ? 1 : 0);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices[0]);
      gl.drawElements(gl.TRIANGLES, lists[0].length, gl.UNSIGNED_INT, 0);
      gl.disable(gl.POLYGON_OFFSET_FILL);
      if (!look.wires) return;
      gl.uniform1i(place("mode"), 2);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices[1]);
      gl.drawElements(gl.LINES, lists[1].length, gl.UNSIGNED_INT, 0);
    };
    return { fill, draw };
  }

  function orbit(canvas, camera, home, changed) {
    const fingers = new Map();
    const spread = ([a, b]) => Math.hypot(a.x - b.x, a.y - b.y);
    const zoom = (factor) => {
      camera.away = Math.min(Math.max(camera.away * factor, 0.15 * home.away), 5 * home.away);
      changed();
    };
    const turn = (x, y) => {
      camera.yaw += x;
      camera.pitch = Math.min(Math.max(camera.pitch + y, -1.5), 1.5);
      changed();
    };
    const goHome = () => { Object.assign(camera, home); changed(); };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? spread([...fingers.values()]) : 0;
      const x = event.clientX - last.x, y = event.clientY - last.y;
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (fingers.size === 2) zoom(before / Math.max(spread([...fingers.values()]), 1));
      if (fingers.size === 2 || event.shiftKey || event.buttons & 6) {
        const mm = camera.away / (2 * Math.min(canvas.clientWidth, canvas.clientHeight));  // of one pixel
        camera.right -= x * mm / fingers.size;  // half of it for each of two fingers
        camera.up += y * mm / fingers.size;
        changed();
      } else turn(-0.008 * x, 0.008 * y);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;  // the page scrolls on until one clicks here
      event.preventDefault();
      zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", goHome);
    const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    canvas.addEventListener("keydown", (event) => {
      if (keys[event.key]) turn(...keys[event.key]);
      else if (event.key === "+") zoom(0.9);
      else if (event.key === "-") zoom(1.1);
      else if (event.key === "Home") goHome();
      else return;
      event.preventDefault();
    });
    all("[data-yaw]").forEach((button) => button.addEventListener("click", () => {
      Object.assign(camera, home, { yaw: Number(button.dataset.yaw) });
      changed();
    }));
  }

  function sliderPanel(weights, changed) {
    const sliders = all("[data-shape]");
    const show = () => sliders.forEach((slider) => {
      const weight = weights[Number(slider.dataset.shape)];
      slider.value = weight;
      const row = slider.closest(".shape");
      row.classList.toggle("on", weight > 0.005);
      row.querySelector("output").textContent = weight.toFixed(2);
    });
    const set = (b, weight) => { weights[b] = weight; show(); changed(); };
    sliders.forEach((slider) => {
      const b = Number(slider.dataset.shape);
      slider.addEventListener("input", () => set(b, Number(slider.value)));
      slider.closest(".shape").querySelector("button").addEventListener("click", () => set(b, weights[b] > 0.005 ? 0 : 1));
    });
    one("[data-reset]").addEventListener("click", () => { weights.fill(0); show(); changed(); });
    one("[type=search]").addEventListener("input", (event) => {
      const wanted = event.target.value.trim().toLowerCase();
      all(".shape").forEach((row) => { row.hidden = !row.title.toLowerCase().includes(wanted); });
      all(".group").forEach((group) => { group.hidden = !group.querySelector(".shape:not([hidden])"); });
    });
    show();
    return show;
  }

  function player(rig, weights, labels, shown) {
    const scrubber = one("[data-frame]"), button = one("[data-play]"), label = one("[data-label]");
    const count = rig.times.length, shapes = rig.names.length;
    let playing = false;
    if (!count) return;
    const show = (frame) => {
      for (let b = 0; b < shapes; b++) weights[b] = rig.weights[frame * shapes + b];
      scrubber.value = frame;
      label.textContent = labels[frame];
      shown();
    };
    const step = (began, from) => requestAnimationFrame((now) => {
      if (!playing) return;
      const past = rig.times[from] + Math.max(0, now - began) / 1000;
      let frame = from;
      while (frame + 1 < count && rig.times[frame + 1] <= past) frame++;
      show(frame);
      if (frame + 1 < count) step(began, from);
      else step(now + 500, 0);
    });
    const press = (goes) => { playing = goes; button.textContent = goes ? "pause" : "play"; };
    scrubber.addEventListener("input", () => { press(false); show(Number(scrubber.value)); });
    button.addEventListener("click", () => {
      press(!playing);
      if (playing) step(performance.now(), Number(scrubber.value) % count);
    });
  }

  function start() {
    const canvas = one("canvas");
    const gl = canvas.getContext("webgl2", { antialias: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    const config = JSON.parse(one("[data-config]").textContent);
    const rig = readRig(one("a[data-rig]"));
    const link = one("[data-change]"), change = link ? readRig({ href: link.textContent }) : null;
    const weights = new Float32Array(rig.names.length);
    const points = rig.neutral.slice(), other = rig.neutral.slice();
    const normals = new Float32Array(points.length), levels = new Float32Array(points.length / 3);
    const paint = painter(gl, rig, config.ramp);
    const side = outward(points, normalsOf(points, rig.triangles, normals), config.centre);
    const home = { yaw: 0.25, pitch: 0, right: 0, up: 0, target: config.centre,
      away: 4.4 * config.half, reach: config.reach };
    const camera = { ...home };
    let stale = true, waiting = false;  // the shape, and a drawing that is asked for
    const draw = () => {
      waiting = false;
      const size = Math.min(window.devicePixelRatio || 1, 2);
      canvas.width = Math.max(1, Math.round(canvas.clientWidth * size));
      canvas.height = Math.max(1, Math.round(canvas.clientHeight * size));
      const colour = one("[data-colour]").value;
      if (stale) {
        stale = false;
        const old = one("[data-which]").value === "before" && change;
        const oldSets = change ? [rig.targets, change.targets] : [rig.targets];
        const neutral = old ? change.neutral : rig.neutral;
        posed(neutral, old ? oldSets : [rig.targets], weights, points);
        if (colour === "change" && change) {
          if (old) posed(rig.neutral, [rig.targets], weights, other);
          else posed(change.neutral, oldSets, weights, other);
        }
        const most = distances(points, colour === "change" ? other : neutral, levels);
        const top = colour === "change" ? config.changeMm : config.displacementMm;
        for (let v = 0; v < levels.length; v++) levels[v] /= top;
        one("[data-top]").textContent = `${top} mm`;
        one("[data-most]").textContent = `largest: ${most.toFixed(2)} mm`;
        one(".legend").hidden = colour === "none";
        [points, normalsOf(points, rig.triangles, normals), levels].forEach((n, at) => paint.fill(at, n));
      }
      paint.draw(camera, { side, coloured: colour !== "none", wires: one("[data-wires]").checked });
    };
    const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
    const reshape = () => { stale = true; redraw(); };
    const show = sliderPanel(weights, reshape);
    player(rig, weights, config.labels, () => { show(); reshape(); });
    orbit(canvas, camera, home, redraw);
    all("[data-which], [data-colour], [data-wires]").forEach((c) => c.addEventListener("change", reshape));
    new ResizeObserver(redraw).observe(canvas);
    one("a[data-rig]").addEventListener("click", (event) => {  // long addresses fail as downloads
      const blob = new Blob([bytesOf(event.target.href)], { type: "model/gltf-binary" });
      const href = URL.createObjectURL(blob), download = event.target.download;
      Object.assign(document.createElement("a"), { href, download }).click();
      event.preventDefault();
    });
    root.rigview = { rig, weights, points, levels, camera, draw };  // for whoever looks inside
    draw();
    root.dataset.state = "ready";
  }

  try {
    start();
  } catch (error) {
    root.dataset.state = "failed";
    one(".sorry").textContent = `No 3D view: ${error.message}. The rest of the page does not need it.`;
    one(".sorry").hidden = false;
    one(".live").hidden = true;
  }
})();
