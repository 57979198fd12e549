"use strict";
// A loading in a page: Meshcat's viewer in the middle, and around it a timeline and histories that follow it.
// Frames and names are those of the Python side; lengths in m, times in s.

const CAMERAS = ["side", "driver", "top", "bucket", "free"];
const SPEEDS = [0.25, 0.5, 1, 2, 4];
const LINE_COLORS = ["#1f2730", "#d2600a", "#1f6fb2"];
const MODES = ["approach", "s0 to s1", "s1 to s2", "s2 to s3", "s3 to s4", "after s4", "aborted"];
const FULL = 32767;

// ---- data ----

async function decompress(id) {
  const text = atob(document.getElementById(id).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** Return what `pack` (packing.py) stored: values, and flat arrays, column after column. */
async function unpack(id) {
  const types = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int16: Int16Array, int32: Int32Array, float32: Float32Array,
    float64: Float64Array };
  const buffer = await decompress(id);
  const size = Number(new DataView(buffer).getBigUint64(0, true));
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)));
  const arrays = {};
  for (const [name, place] of Object.entries(head.arrays))
    arrays[name] = new types[place.type](buffer, 8 + size + place.offset, place.count);
  return { ...head.values, ...arrays };
}

/** Write the pose at a frame (any number, also between two) of a track of keyframes into q [x y z w] and p. */
function readPose(start, frames, poses, track, frame, unit, q, p) {
  const n = frames.length;
  let low = start[track], high = start[track + 1] - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (frames[middle] <= frame) low = middle; else high = middle;
  }
  if (frame >= frames[high]) low = high;
  const span = frames[high] - frames[low];
  const share = span > 0 ? Math.min(Math.max((frame - frames[low]) / span, 0), 1) : 0;
  q.set(poses[n + low], poses[2 * n + low], poses[3 * n + low], poses[low]).normalize();
  if (share > 0) {
    readPose.other.set(poses[n + high], poses[2 * n + high], poses[3 * n + high], poses[high]).normalize();
    q.slerp(readPose.other, share);
  }
  const at = (k) => (poses[(4 + k) * n + low] + share * (poses[(4 + k) * n + high] - poses[(4 + k) * n + low])) * unit;
  p.set(at(0), at(1), at(2));
}

// ---- the scene ----

class Scene {
  constructor(element, run) {
    this.run = run;
    this.element = element;
    this.cut = -Infinity;
    this.camera = "side";
    const viewer = (this.viewer = new MeshCat.Viewer(element, false));
    viewer.gui.domElement.remove();
    viewer.animator.update = () => {};
    viewer.renderer.shadowMap.type = THREE.PCFShadowMap;
    for (const name of ["Grid", "Axes", "Lights"]) viewer.scene_tree.find([name]).object.visible = false;
    viewer.set_property(["Background", "<object>"], "top_color", [0.93, 0.95, 0.97]);
    viewer.set_property(["Background", "<object>"], "bottom_color", [0.74, 0.76, 0.79]);
    viewer.camera.fov = 38;
    viewer.camera.near = 0.2;
    viewer.camera.far = 400;
    this.root = viewer.scene_tree.find(["drakerock"]).object;
    this.addLights();
    this.addSite();
    this.addRocks();
    this.addMachine();
    this.addPaths();
    viewer.controls.addEventListener("start", () => { if (this.onDrag) this.onDrag(); });
    new ResizeObserver(() => { viewer.set_3d_pane_size(); this.placeCamera(); }).observe(element);
    viewer.set_3d_pane_size();
  }

  addLights() {
    const { low, high } = this.run.focus;
    const middle = low.map((v, k) => 0.5 * (v + high[k]));
    const reach = 0.6 * Math.hypot(...low.map((v, k) => high[k] - v));
    const sun = new THREE.DirectionalLight(0xffffff, 2.6);
    sun.position.set(middle[0] - 0.35 * reach, middle[1] - 0.9 * reach, middle[2] + 1.6 * reach);
    sun.target.position.set(...middle);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    Object.assign(sun.shadow.camera, { left: -1.25 * reach, right: 1.25 * reach, top: 1.25 * reach, bottom: -1.25 * reach,
      near: 0.1, far: 5 * reach });
    sun.shadow.bias = -0.0006;
    sun.shadow.normalBias = 0.03;
    this.root.add(sun, sun.target, new THREE.HemisphereLight(0xffffff, 0xb5ada2, 3.4));
  }

  add(geometry, color, options = {}) {
    const mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color, ...options }));
    mesh.receiveShadow = true;
    this.root.add(mesh);
    return mesh;
  }

  addSite() {
    const site = this.run.site, half = 0.5 * site.drift_width;
    const quad = (a, b, c, d) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.Float32BufferAttribute([...a, ...b, ...c, ...d], 3));
      geometry.setIndex([0, 1, 2, 0, 2, 3]);
      geometry.computeVertexNormals();
      return geometry;
    };
    const { start, end, roof } = site, side = THREE.DoubleSide;
    const wall = (y, to) => quad([start, y, 0], [to, y, 0], [to, y, roof], [start, y, roof]);
    this.add(quad([start, -half, 0], [end, -half, 0], [end, half, 0], [start, half, 0]), 0x6b655e, { side });
    this.add(wall(half, end), 0x98948e, { side });
    this.add(quad([end, -half, 0], [end, half, 0], [end, half, roof], [end, -half, roof]), 0x86827c, { side });
    this.wall = this.add(wall(-half, end), 0x98948e, { side, transparent: true, opacity: 0, depthWrite: false });
    this.wall.visible = false;
    // A metre from mark to mark, ten at the long ones.
    const marks = [];
    for (let x = Math.ceil(start); x <= end; ++x) marks.push(x, -half, 0.01, x, -half + (x % 5 ? 0.15 : 0.4), 0.01);
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.Float32BufferAttribute(marks, 3));
    this.root.add(new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ color: 0xe8e4dd })));
    const brow = new THREE.BufferGeometry();
    brow.setAttribute("position", new THREE.Float32BufferAttribute(site.brow.flat(), 3));
    this.root.add(new THREE.Line(brow, new THREE.LineBasicMaterial({ color: 0x3a3835 })));
  }

  addRocks() {
    const run = this.run, n = run.rock_shape.length;
    this.place = new Array(n);
    this.matrices = new Float32Array(16 * n);
    this.instances = run.rock_shapes.map((shape, k) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.Float32BufferAttribute(shape.vertices.flat(), 3));
      geometry.setIndex(shape.triangles.flat());
      const count = run.rock_shape.reduce((sum, s) => sum + (s === k), 0);
      const material = new THREE.MeshLambertMaterial({ color: 0xffffff, flatShading: true });
      const mesh = new THREE.InstancedMesh(geometry, material, Math.max(count, 1));
      mesh.count = 0;
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false;
      this.root.add(mesh);
      return mesh;
    });
    const color = new THREE.Color();
    // The nearest to the side's eye first: what they hide is then not shaded.
    const order = [...Array(n).keys()].sort((a, b) => run.rock_rest[5 * n + a] - run.rock_rest[5 * n + b]);
    for (const rock of order) {
      const mesh = this.instances[run.rock_shape[rock]];
      this.place[rock] = mesh.count++;
      const rgb = [0, 1, 2].map((k) => run.rock_color[k * n + rock] / 255);
      mesh.setColorAt(this.place[rock], color.setRGB(...rgb, THREE.SRGBColorSpace));
    }
    this.drawRocks([...Array(n).keys()], 0);
  }

  /** Place rocks as they are at a frame; those nearer than the cut are left out. */
  drawRocks(rocks, frame) {
    const run = this.run, n = run.rock_shape.length, unit = run.unit;
    const q = new THREE.Quaternion(), p = new THREE.Vector3(), scale = new THREE.Vector3(), matrix = new THREE.Matrix4();
    for (const rock of rocks) {
      const track = run.track_of_rock[rock];
      if (track >= 0) readPose(run.rock_start, run.rock_frame, run.rock_pose, track, frame, unit, q, p);
      else {
        const X = run.rock_rest;
        q.set(X[n + rock], X[2 * n + rock], X[3 * n + rock], X[rock]).normalize();
        p.set(X[4 * n + rock] * unit, X[5 * n + rock] * unit, X[6 * n + rock] * unit);
      }
      scale.setScalar(p.y < this.cut ? 0 : run.rock_size[rock]);
      this.instances[run.rock_shape[rock]].setMatrixAt(this.place[rock], matrix.compose(p, q, scale));
    }
    for (const mesh of this.instances) mesh.instanceMatrix.needsUpdate = true;
  }

  addMachine() {
    this.bodies = this.run.bodies.map(() => new THREE.Group());
    this.root.add(...this.bodies);
    for (const visual of this.run.visuals) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.Float32BufferAttribute(visual.vertices, 3));
      geometry.setIndex(visual.triangles);
      const [r, g, b, a] = visual.rgba;
      const material = new THREE.MeshLambertMaterial({ color: new THREE.Color().setRGB(r, g, b, THREE.SRGBColorSpace),
        flatShading: true, side: THREE.DoubleSide, transparent: a < 1, opacity: a });
      const mesh = new THREE.Mesh(geometry, material);
      mesh.castShadow = mesh.receiveShadow = true;
      this.bodies[visual.body].add(mesh);
    }
    // The front unit's own extent, in its frame: the driver's place is derived from it.
    const front = this.bodies[Math.max(this.run.bodies.indexOf("front_unit"), 0)];
    this.box = new THREE.Box3().setFromObject(front);
    this.front = front;
    this.bucket = this.bodies[Math.max(this.run.bodies.indexOf("bucket"), 0)];
  }

  /** A path [x y z x y z ...] as a line of some pixels' width that shows through rocks. */
  addLine(points, color, width) {
    const geometry = new MeshCat.LineGeometry();
    geometry.setPositions(points);
    const material = new MeshCat.LineMaterial({ color, linewidth: width, depthTest: false, transparent: true });
    const line = new MeshCat.Line2(geometry, material);
    line.renderOrder = 5;
    line.frustumCulled = false;
    line.onBeforeRender = (renderer) => renderer.getSize(material.resolution);
    this.root.add(line);
    return line;
  }

  addPaths() {
    const { planned, actual } = this.run;
    this.marks = [];
    if (planned && planned.length >= 6) {
      this.addLine(planned, 0x1f6fb2, 4);
      for (const [name, ...point] of this.run.waypoints) {
        const label = document.createElement("div");
        label.className = "mark";
        label.textContent = name;
        this.element.append(label);
        this.marks.push([label, new THREE.Vector3(...point)]);
      }
    }
    this.actual = actual && actual.length >= 6 ? this.addLine(actual, 0xff7a1a, 3) : null;
    if (this.actual) this.actual.renderOrder = 6;
  }

  /** Show the scene at a time. */
  show(time) {
    const run = this.run;
    const frame = this.frame = findPlace(run.times, time);
    const q = new THREE.Quaternion(), p = new THREE.Vector3();
    this.bodies.forEach((body, b) => {
      readPose(run.body_start, run.body_frame, run.body_pose, b, frame, run.unit, q, p);
      body.position.copy(p);
      body.quaternion.copy(q);
    });
    this.drawRocks(run.moving, frame);
    if (this.actual) {
      const passed = run.actual_times.findIndex((t) => t > time);
      this.actual.geometry.instanceCount = Math.max((passed < 0 ? run.actual_times.length : passed) - 1, 0);
    }
    this.placeCamera();
    this.viewer.set_dirty();
  }

  setWall(opacity) {
    this.wall.material.opacity = opacity;
    this.wall.visible = opacity > 0;
    this.viewer.set_dirty();
  }

  /** Leave out rocks nearer to the side's eye than a share of the way from the near wall to the machine's middle. */
  setCut(share) {
    const half = 0.5 * this.run.site.drift_width;
    this.cut = share > 0 ? -half + share * (half + this.run.y) : -Infinity;
    this.drawRocks([...this.place.keys()], this.frame || 0);
    this.viewer.set_dirty();
  }

  setCamera(name) {
    this.camera = name;
    this.settled = false;
    this.placeCamera();
    this.viewer.set_dirty();
  }

  /** Put the camera where its name says; those of driver and bucket go with the machine. */
  placeCamera() {
    const at = (body, x, y, z) => new THREE.Vector3(x, y, z).applyQuaternion(body.quaternion).add(body.position);
    const box = this.box, height = box.max.z - box.min.z;
    if (this.camera === "driver") {
      const eye = at(this.front, box.min.x - 0.3 * height, 0.0, box.max.z + 0.35 * height);
      this.look(eye, at(this.front, box.max.x + 2.5 * height, 0.0, box.min.z));
    } else if (this.camera === "bucket") {
      const target = this.bucket.position;
      this.look(target.clone().add(new THREE.Vector3(-2.2, -6.0, 3.0)), target);
    } else if (this.camera === "top" || this.camera === "side") {
      const direction = this.camera === "top" ? [0, -0.02, 1] : [-0.08, -1, 0.2];
      this.fit(new THREE.Vector3(...direction).normalize());
    }
  }

  look(eye, target) {
    // Meshcat's camera is in a frame with y up.
    this.viewer.camera.position.set(eye.x, eye.z, -eye.y);
    this.viewer.controls.target.set(target.x, target.z, -target.y);
    this.viewer.set_dirty();
  }

  /** Look along a direction (from target to eye) from as near as shows all of the focus. */
  fit(direction) {
    const { low, high } = this.run.focus, camera = this.viewer.camera;
    const target = new THREE.Vector3(...low).add(new THREE.Vector3(...high)).multiplyScalar(0.5);
    const right = new THREE.Vector3(0, 0, 1).cross(direction).normalize();
    const up = direction.clone().cross(right);
    const tan = Math.tan(0.5 * THREE.MathUtils.degToRad(camera.fov)), aspect = camera.aspect || 1.5;
    let distance = 1;
    for (let corner = 0; corner < 8; ++corner) {
      const c = new THREE.Vector3(...[0, 1, 2].map((k) => ((corner >> k) & 1 ? high : low)[k])).sub(target);
      const across = Math.max(Math.abs(c.dot(right)) / (tan * aspect), Math.abs(c.dot(up)) / tan);
      distance = Math.max(distance, across + c.dot(direction));
    }
    this.look(target.clone().addScaledVector(direction, distance), target);
  }

  render() {
    if (!this.viewer.needs_render) return false;
    this.viewer.render();
    const width = this.element.clientWidth, height = this.element.clientHeight;
    for (const [label, point] of this.marks) {
      const p = point.clone();
      this.root.localToWorld(p);
      p.project(this.viewer.camera);
      const seen = Math.abs(p.z) <= 1 && Math.abs(p.x) <= 1 && Math.abs(p.y) <= 1;
      label.style.display = seen ? "" : "none";
      label.style.left = `${0.5 * (p.x + 1) * width}px`;
      label.style.top = `${0.5 * (1 - p.y) * height}px`;
    }
    return true;
  }
}

/** Return where a value is among rising ones, as a number of steps, also between two. */
function findPlace(values, value) {
  if (value <= values[0]) return 0;
  let low = 0, high = values.length - 1;
  if (value >= values[high]) return high;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (values[middle] <= value) low = middle; else high = middle;
  }
  return low + (value - values[low]) / (values[high] - values[low]);
}

// ---- histories ----

const SVG = "http://www.w3.org/2000/svg";
function draw(parent, tag, attributes, text) {
  const item = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) item.setAttribute(name, value);
  if (text) item.textContent = text;
  parent.append(item);
  return item;
}

/** One quantity over time, of one run or of two, with its value now. */
class Chart {
  constructor(panel, runs, index, duration, seek) {
    this.runs = runs;
    this.index = index;
    this.duration = duration;
    const history = runs[0].histories[index];
    this.element = document.createElement("section");
    this.element.className = "chart";
    this.element.dataset.key = history.key;
    const head = document.createElement("h2");
    head.innerHTML = `<span></span><small></small>`;
    head.firstChild.textContent = history.label;
    head.lastChild.textContent = history.unit;
    this.values = document.createElement("div");
    this.values.className = "values";
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", "0 0 300 74");
    svg.setAttribute("preserveAspectRatio", "none");
    this.element.append(head, this.values, svg);
    panel.append(this.element);
    this.fields = [];
    this.addCurves(svg, history);
    this.cursor = draw(svg, "line", { y1: 0, y2: 74, stroke: "#b00020", "stroke-width": 1.2, "vector-effect": "non-scaling-stroke" });
    svg.addEventListener("pointerdown", (event) => {
      const area = svg.getBoundingClientRect();
      seek(((event.clientX - area.left) / area.width) * duration);
    });
  }

  addCurves(svg, history) {
    const curves = this.runs.flatMap((run, r) => run.histories[this.index].lines.map((name, k) => ({ run, r, k, name })));
    const all = curves.flatMap(({ run, name }) => Array.from(run[`line_${name}`]).filter(Number.isFinite));
    const limit = history.limit;
    // A single spike must not flatten the rest: the 99.9th percentile of what is shown.
    all.sort((a, b) => a - b);
    const pick = (share) => all.length ? all[Math.round(share * (all.length - 1))] : 0;
    let low = Math.min(0, pick(0.001)), high = Math.max(pick(0.999), limit ? limit[1] : 0, 1e-9);
    high += 0.06 * (high - low);
    const x = (t) => (300 * t) / this.duration, y = (v) => 73 - (72 * (Math.min(Math.max(v, low), high) - low)) / (high - low);
    const fixed = { fill: "none", "vector-effect": "non-scaling-stroke" };
    draw(svg, "line", { ...fixed, x1: 0, x2: 300, y1: y(0), y2: y(0), stroke: "#c3cad1", "stroke-width": 1 });
    for (const [r, run] of this.runs.entries())
      for (const [name, time] of run.ticks)
        draw(svg, "line", { ...fixed, x1: x(time), x2: x(time), y1: 0, y2: 74, stroke: "#c3cad1", "stroke-width": 1,
          "stroke-dasharray": r ? "5 3" : "2 2" });
    if (limit)
      draw(svg, "line", { ...fixed, x1: 0, x2: 300, y1: y(limit[1]), y2: y(limit[1]), stroke: "#b00020", "stroke-width": 1,
        "stroke-dasharray": "5 3" });
    for (const { run, r, k, name } of curves) {
      const values = run[`line_${name}`];
      let path = "";
      for (let i = 0; i < values.length; i += 2) // every other step: 20 ms
        if (Number.isFinite(values[i])) path += `${path ? "L" : "M"}${x(run.step_times[i]).toFixed(2)} ${y(values[i]).toFixed(2)}`;
      draw(svg, "path", { ...fixed, d: path || "M0 0", stroke: LINE_COLORS[k], "stroke-width": 1.4,
        ...(r ? { "stroke-dasharray": "5 3", opacity: 0.85 } : {}) });
      const field = document.createElement("span");
      field.innerHTML = `<span></span> <b></b>`;
      field.firstChild.textContent = this.runs.length > 1 ? `${"AB"[r]} ${name}` : name;
      field.firstChild.style.color = LINE_COLORS[k];
      if (r) field.firstChild.className = "dash";
      field.lastChild.dataset.value = this.runs.length > 1 ? `${"AB"[r]}.${name}` : name;
      this.fields.push([field.lastChild, run, name]);
      this.values.append(field);
    }
    if (history.key === "load") for (const [r, run] of this.runs.entries()) this.addShares(run, r);
    if (limit) {
      const field = document.createElement("span");
      field.textContent = `- - ${limit[0]} ${limit[1]}`;
      field.style.color = "#b00020";
      this.values.append(field);
    }
  }

  /** The load also as a share of the payload, and as fill factor. */
  addShares(run, r) {
    const place = this.runs.length > 1 ? `${"AB"[r]}.` : "";
    const limit = run.histories[this.index].limit;
    const shares = [["fill factor", "fill_factor", run.fill_per_t, 2]];
    if (limit) shares.unshift(["% of payload", "payload_share", 100 / limit[1], 0]);
    for (const [label, key, factor, digits] of shares) {
      const field = document.createElement("span");
      field.innerHTML = place || key === "fill_factor" ? `<span></span> <b></b>` : `<b></b> <span></span>`;
      field.querySelector("span").textContent = (place ? `${"AB"[r]} ` : "") + label;
      const value = field.querySelector("b");
      value.dataset.value = place + key;
      this.fields.push([value, run, "load", factor, digits]);
      this.values.append(field);
    }
  }

  show(time) {
    const x = (300 * time) / this.duration;
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    for (const [field, run, name, factor = 1, digits = null] of this.fields) {
      const step = Math.min(Math.round(findPlace(run.step_times, time)), run.step_times.length - 1);
      const value = factor === null ? NaN : run[`line_${name}`][step] * factor;
      const places = digits ?? (run.histories[this.index].unit === "m/s" || name === "load" ? 2 : 0);
      field.textContent = Number.isFinite(value) ? value.toFixed(places).replace(/^-(0(\.0*)?)$/, "$1") : "–";
    }
  }
}

// ---- the page ----

class Replay {
  constructor(runs) {
    this.runs = runs;
    this.duration = Math.max(...runs.map((run) => run.times[run.times.length - 1]));
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.find = (id) => document.getElementById(id);
    this.scenes = runs.map((run, k) => new Scene(this.find(`view${k}`), run));
    const panel = document.querySelector(".panel");
    this.charts = runs[0].histories.map((_, k) => new Chart(panel, runs, k, this.duration, (t) => this.seek(t)));
    this.addTicks();
    this.addControls();
    this.seek(0);
    this.tick = this.tick.bind(this);
    requestAnimationFrame(this.tick);
  }

  addTicks() {
    const area = this.find("time");
    area.max = this.duration;
    for (const [r, run] of this.runs.entries()) {
      const row = document.createElement("div");
      row.className = "ticks";
      area.before(row);
      const gap = 20 / Math.max(row.clientWidth, 200); // as wide as a name
      let last = -1;
      for (const [name, time] of run.ticks) {
        const share = time / this.duration;
        const tick = document.createElement("span");
        tick.textContent = (this.runs.length > 1 && last < 0 ? `${"AB"[r]} ` : "") + name;
        tick.title = `${name} at ${time.toFixed(2)} s`;
        tick.dataset.time = time;
        // Waypoints close in time stand beside each other.
        tick.style.left = `${100 * Math.max(share, last + gap)}%`;
        last = Math.max(share, last + gap);
        row.append(tick);
      }
      for (const [name, time] of run.events) {
        const mark = document.createElement("span");
        mark.className = "event";
        mark.title = `${name} at ${time.toFixed(2)} s`;
        mark.style.left = `${(100 * time) / this.duration}%`;
        row.append(mark);
      }
    }
    area.addEventListener("input", () => { this.setPlaying(false); this.seek(Number(area.value)); });
  }

  addControls() {
    this.find("play").addEventListener("click", () => this.setPlaying(!this.playing));
    const speeds = this.find("speed");
    for (const speed of SPEEDS) speeds.add(new Option(`${speed}×`, speed, speed === 1, speed === 1));
    speeds.addEventListener("change", () => { this.speed = Number(speeds.value); });
    for (const name of CAMERAS) {
      const button = document.createElement("button");
      button.textContent = name;
      button.dataset.camera = name;
      button.addEventListener("click", () => this.setCamera(name));
      this.find("cameras").append(button);
    }
    this.find("wall").addEventListener("input", (event) => this.scenes.forEach((s) => s.setWall(Number(event.target.value))));
    this.find("cut").addEventListener("input", (event) => this.scenes.forEach((s) => s.setCut(Number(event.target.value))));
    for (const scene of this.scenes) {
      scene.onDrag = () => this.setCamera("free");
      // Two views are turned together.
      scene.viewer.controls.addEventListener("change", () => {
        if (this.camera !== "free") return;
        for (const other of this.scenes) if (other !== scene) {
          other.viewer.camera.position.copy(scene.viewer.camera.position);
          other.viewer.controls.target.copy(scene.viewer.controls.target);
          other.viewer.set_dirty();
        }
      });
    }
    this.setCamera("side");
    if (window.innerWidth <= 900) document.querySelector(".legend").open = false;
    window.addEventListener("keydown", (event) => {
      if (event.code !== "Space" || event.target.tagName === "BUTTON" || event.target.tagName === "SELECT") return;
      event.preventDefault();
      this.setPlaying(!this.playing);
    });
  }

  setCamera(name) {
    this.camera = name;
    for (const scene of this.scenes) scene.setCamera(name);
    for (const button of document.querySelectorAll("[data-camera]"))
      button.setAttribute("aria-pressed", String(button.dataset.camera === name));
  }

  setPlaying(playing) {
    if (playing && this.time >= this.duration) this.seek(0);
    this.playing = playing;
    this.last = null;
    this.find("play").textContent = playing ? "Pause" : "Play";
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    for (const scene of this.scenes) scene.show(Math.min(this.time, scene.run.times[scene.run.times.length - 1]));
    for (const chart of this.charts) chart.show(this.time);
    this.find("time").value = this.time;
    this.find("clock").textContent = `${this.time.toFixed(2)} of ${this.duration.toFixed(2)} s`;
    this.find("mode").textContent = this.runs.map((run) => {
      const step = Math.min(Math.round(findPlace(run.step_times, this.time)), run.step_times.length - 1);
      return MODES[run.modes[step]] || "";
    }).join(" | ");
  }

  tick(now) {
    requestAnimationFrame(this.tick);
    if (this.playing) {
      // A slow machine plays slower, and leaves no frame out for longer than a quarter of a second.
      const step = this.last == null ? 0 : Math.min((now - this.last) / 1000, 0.25);
      this.last = now;
      this.seek(this.time + this.speed * step);
      if (this.time >= this.duration) this.setPlaying(false);
    }
    this.render();
  }

  render() {
    let drawn = false;
    for (const scene of this.scenes) drawn = scene.render() || drawn;
    if (drawn && !this.first) this.first = performance.now();
  }
}

let THREE;
async function start() {
  try {
    const code = document.createElement("script");
    code.textContent = new TextDecoder().decode(await decompress("meshcat"));
    document.head.append(code);
    THREE = MeshCat.THREE;
    readPose.other = new THREE.Quaternion();
    const runs = [];
    for (let k = 0; document.getElementById(`run${k}`); ++k) runs.push(await unpack(`run${k}`));
    window.replay = new Replay(runs);
    window.replay.setPlaying(!location.hash.includes("still"));
  } catch (error) {
    const fault = document.createElement("div");
    fault.className = "fault";
    fault.textContent = `This page cannot be shown: ${error.message}. It needs a browser with WebGL and DecompressionStream (2023 or newer).`;
    document.body.append(fault);
    throw error;
  }
}
start();
