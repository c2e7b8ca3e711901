// The page around the worker: what the player wishes, when a new window is asked for, and the picture.
import * as THREE from "three";
import { Bodies } from "body";
import { FPS, jointPositions, pose } from "motion";
import { Network } from "network";

const HOP = 8, BLEND = 4, MOST = 32, RECORDED = 1800;

// ------------------------------------------------------------------------------------------------------------- the wishes

// Keys, mouse, touch and gamepad, as one wish: {speed: 0 to 1.6 times the usual, direction: radians}.
export class Wishes {
  constructor(canvas, view) {
    this.held = new Set();
    this.view = view; // {around: azimuth of the camera, onGround(event): [x, z], leader(): [x, z]}
    this.stick = null; // of a finger: where it began and where it is
    this.pointed = null; // of a mouse: a place on the ground
    this.taken = false; // whether anybody has steered yet
    const typing = (event) => event.target.closest?.("select, input, summary, button") && !event.code.startsWith("Key");
    addEventListener("keydown", (event) => {
      if (typing(event) || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.code.startsWith("Arrow")) event.preventDefault();
      this.held.add(event.code);
    });
    addEventListener("keyup", (event) => this.held.delete(event.code));
    addEventListener("blur", () => this.held.clear());
    canvas.addEventListener("pointerdown", (event) => {
      document.activeElement?.blur?.();
      canvas.setPointerCapture(event.pointerId);
      if (event.pointerType === "touch") this.stick = { from: [event.clientX, event.clientY], to: [event.clientX, event.clientY] };
      else this.pointed = view.onGround(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (this.stick && event.pointerType === "touch") this.stick.to = [event.clientX, event.clientY];
      else if (this.pointed) this.pointed = view.onGround(event) ?? this.pointed;
    });
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, () => { this.stick = this.pointed = null; });
  }

  // Right and forward on the screen, each -1 to 1, and whether to hurry.
  axes() {
    const any = (...codes) => (codes.some((code) => this.held.has(code)) ? 1 : 0);
    let right = any("ArrowRight", "KeyD") - any("ArrowLeft", "KeyA");
    let ahead = any("ArrowUp", "KeyW") - any("ArrowDown", "KeyS");
    let fast = any("ShiftLeft", "ShiftRight"), around = any("KeyE") - any("KeyQ");
    if (this.stick) {
      const [x, y] = this.stick.to.map((value, i) => (value - this.stick.from[i]) / 60), far = Math.max(1, Math.hypot(x, y));
      if (Math.hypot(x, y) > 0.15) [right, ahead] = [x / far, -y / far];
    }
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad?.connected) continue;
      if (Math.hypot(pad.axes[0], pad.axes[1]) > 0.2) [right, ahead] = [pad.axes[0], -pad.axes[1]];
      if (Math.abs(pad.axes[2] ?? 0) > 0.2) around = pad.axes[2];
      if (pad.buttons[7]?.pressed || pad.buttons[0]?.pressed) fast = 1;
    }
    return { right, ahead, fast, around };
  }

  now() {
    const { right, ahead, fast } = this.axes();
    const size = Math.min(1, Math.hypot(right, ahead)), hurry = fast ? 1.4 : 1;
    if (size > 0) {
      this.taken = true;
      const { around } = this.view; // the camera stands there, and looks the other way
      const x = -ahead * Math.sin(around) + right * Math.cos(around), z = -ahead * Math.cos(around) - right * Math.sin(around);
      return { speed: size * hurry, direction: Math.atan2(x, z) };
    }
    if (this.pointed) {
      this.taken = true;
      const from = this.view.leader(), x = this.pointed[0] - from[0], z = this.pointed[1] - from[1], far = Math.hypot(x, z);
      return { speed: far < 0.3 ? 0 : Math.min(1, far) * hurry, direction: Math.atan2(x, z) };
    }
    return { speed: 0, direction: 0 };
  }
}

// ------------------------------------------------------------------------------------------------------------- the picture

class Picture {
  constructor(canvas, data) {
    this.data = data;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.sharpness = Math.min(devicePixelRatio, 2);
    this.renderer.setPixelRatio(this.sharpness);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.1, 80);
    this.around = Math.PI; // behind somebody who faces +Z
    this.center = new THREE.Vector3();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9a948a, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(2, 5, -3);
    this.scene.add(sun);
    const many = (geometry, material, count) => {
      const mesh = new THREE.InstancedMesh(geometry, material, count);
      mesh.frustumCulled = false;
      mesh.count = 0;
      mesh.setColorAt(0, new THREE.Color());
      this.scene.add(mesh);
      return mesh;
    };
    const ghost = (opacity) => new THREE.MeshBasicMaterial({ transparent: true, opacity, depthWrite: false });
    const cylinder = new THREE.CylinderGeometry(1, 1, 1, 10), bones = data.bones.length;
    const disc = new THREE.CircleGeometry(1, 20).rotateX(-Math.PI / 2);
    this.shadows = many(disc, ghost(0.16), MOST);
    this.dots = many(disc, ghost(0.75), MOST * 8);
    this.ghosts = many(cylinder, ghost(0.3), 12 * bones);
    this.seams = many(new THREE.RingGeometry(0.06, 0.085, 24).rotateX(-Math.PI / 2), ghost(0.9), 40);
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.paint());
    this.paint();
  }

  paint() {
    const back = this.dark.matches ? 0x15181c : 0xf3f1ec, line = this.dark.matches ? 0x3a4048 : 0xc9c4ba;
    this.scene.background = new THREE.Color(back);
    this.scene.fog = new THREE.Fog(back, 14, 36);
    if (this.grid) this.scene.remove(this.grid);
    const tile = Object.assign(document.createElement("canvas"), { width: 256, height: 256 }), pen = tile.getContext("2d");
    pen.fillStyle = this.scene.background.getStyle();
    pen.fillRect(0, 0, 256, 256);
    pen.strokeStyle = new THREE.Color(line).getStyle();
    pen.lineWidth = 4;
    pen.strokeRect(0, 0, 256, 256);
    const map = new THREE.CanvasTexture(tile);
    Object.assign(map, { wrapS: THREE.RepeatWrapping, wrapT: THREE.RepeatWrapping, colorSpace: THREE.SRGBColorSpace, anisotropy: 8 });
    map.repeat.set(80, 80);
    this.grid = new THREE.Mesh(new THREE.PlaneGeometry(80, 80).rotateX(-Math.PI / 2), new THREE.MeshBasicMaterial({ map }));
    this.scene.add(this.grid);
    const { left, right, middle } = this.data.colors;
    this.colors = { left, right, middle, flesh: "#aab3bf" };
    if (this.dark.matches) Object.assign(this.colors, { right: "#6fa6e6", middle: "#c9c9c9", flesh: "#98a2b0" });
    this.bodies?.paint(this.colors);
    this.shade = new THREE.Color(this.dark.matches ? 0x000000 : 0x2a2620);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    if (this.width === width && this.height === height) return;
    [this.width, this.height] = [width, height];
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.fov = width < height ? 55 : 40;
    // Beside the panel, or above it.
    this.camera.setViewOffset(width, height, width > 600 ? -0.1 * width : 0, width > 600 ? 0 : 0.22 * height, width, height);
    this.camera.updateProjectionMatrix();
  }

  // Fewer pixels, for whoever draws without a graphics card; false if there are few already.
  coarser() {
    if (this.sharpness <= 0.5) return false;
    this.sharpness = Math.max(0.5, this.sharpness / 1.5);
    this.renderer.setPixelRatio(this.sharpness);
    this.width = undefined; // so that `resize` sets the canvas anew
    return true;
  }

  look(x, z, count, quick) {
    this.center.lerp(new THREE.Vector3(x, 0.8, z), quick);
    const far = count === 1 ? 4.6 : count === 8 ? 9.5 : 15;
    this.far = this.far === undefined ? far : this.far + 0.08 * (far - this.far);
    const level = 0.92 * this.far, height = 0.42 * this.far;
    this.camera.position.set(this.center.x + level * Math.sin(this.around), this.center.y + height,
      this.center.z + level * Math.cos(this.around));
    this.camera.lookAt(this.center);
    this.grid.position.set(Math.round(this.center.x), 0, Math.round(this.center.z));
  }

  onGround(event) {
    const box = this.renderer.domElement.getBoundingClientRect();
    const at = new THREE.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.camera);
    const hit = ray.ray.intersectPlane(new THREE.Plane(new THREE.Vector3(0, 1, 0), 0), new THREE.Vector3());
    return hit && [hit.x, hit.z];
  }

  begin() {
    for (const mesh of [this.shadows, this.dots, this.ghosts, this.seams]) mesh.count = 0;
  }

  place(mesh, position, scale, color, turn) {
    const { matrix, still } = Picture;
    mesh.setMatrixAt(mesh.count, matrix.compose(position, turn ?? still, scale));
    mesh.setColorAt(mesh.count++, color);
  }

  stick(mesh, a, b, thick, color) {
    const along = b.clone().sub(a), length = along.length();
    if (length < 1e-4) return;
    const turn = new THREE.Quaternion().setFromUnitVectors(Picture.up, along.divideScalar(length));
    this.place(mesh, a.clone().add(b).multiplyScalar(0.5), new THREE.Vector3(thick, length, thick), color, turn);
  }

  point(points, k) {
    return new THREE.Vector3(points[3 * k], points[3 * k + 1], points[3 * k + 2]);
  }

  // Bodies of so many characters, of which body.js needs where the bones are.
  people(count) {
    if (this.figures?.length === count) return;
    if (this.bodies) this.scene.remove(this.bodies.group);
    this.figures = Array.from({ length: count }, (_, k) => ({
      skeleton: this.data.body, color: k ? this.data.tints[k] : null,
      bones: this.data.body.parents.map(() => ({ matrixWorld: new THREE.Matrix4() })),
    }));
    this.bodies = new Bodies(this.figures);
    this.bodies.paint(this.colors);
    this.scene.add(this.bodies.group);
  }

  // Character k between two frames.
  body(k, a, b, share) {
    const { bones } = this.figures[k];
    bones.forEach(({ matrixWorld }, joint) =>
      matrixWorld.fromArray(a.places[joint].map((value, i) => value + share * (b.places[joint][i] - value))));
    const at = new THREE.Vector3().setFromMatrixPosition(bones[0].matrixWorld).setY(0.004);
    this.place(this.shadows, at, new THREE.Vector3(0.3, 1, 0.3), this.shade);
  }

  ghost(points, color) {
    for (const [parent, child] of this.data.bones)
      this.stick(this.ghosts, this.point(points, parent), this.point(points, child), 0.016, color);
  }

  dot(mesh, x, z, size, color) {
    this.place(mesh, new THREE.Vector3(x, 0.01, z), new THREE.Vector3(size, 1, size), color);
  }

  end() {
    this.bodies.update();
    for (const mesh of [this.shadows, this.dots, this.ghosts, this.seams]) {
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
    this.renderer.render(this.scene, this.camera);
  }
}
Picture.up = new THREE.Vector3(0, 1, 0);
Picture.still = new THREE.Quaternion();
Picture.matrix = new THREE.Matrix4();

// ---------------------------------------------------------------------------------------------------------------- the game

const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];

export async function start(files) {
  const data = JSON.parse(document.getElementById("steer-data").textContent);
  const { card } = data, $ = (id) => document.getElementById(id), canvas = $("view");
  const picture = new Picture(canvas, data), network = new Network(URL.createObjectURL(new Blob([files.worker], { type: "text/javascript" })));
  const styleOf = (name) => card.styles.indexOf(name);
  const options = { steps: document.querySelector("input[name=steps]:checked").value, count: 1, hop: HOP, made: false, locking: $("feet").checked };
  const tapes = []; // per character: its points, frame by frame; all end at the same frame
  let newest = 0, clock = 0, pending = false, last = null, seams = [], times = [], drawn = [], waits = 0, rounds = 0, record = [];
  // A frame's points, and the place of each joint as three.js writes it.
  const posed = (frame) => {
    const { points, turned } = pose(card.skeleton, frame);
    const places = turned.map((axes, k) => [...axes, points.subarray(3 * k, 3 * k + 3)].flatMap((column, i) => [...column, +(i === 3)]));
    return Object.assign(points, { places });
  };
  const frameAt = (tape, frame) => tape[Math.min(Math.max(0, tape.length - 1 - newest + frame), tape.length - 1)];
  const root = () => frameAt(tapes[0], Math.floor(clock));
  const wishes = new Wishes(canvas, {
    get around() { return picture.around; },
    onGround: (event) => picture.onGround(event),
    leader: () => [root()[0], root()[2]],
  });

  const poses = new Float32Array(files.poses.buffer);
  const { runs, instead } = await network.ask("open", {
    card, wasm: files.wasm.buffer, program: files.program, poses,
    software: location.hash === "#software-webgpu", // slower than WebAssembly: for tests
  });
  $("where").textContent = {
    webgpu: "on the graphics card, by WebGPU", software: "by WebGPU in software", wasm: "in WebAssembly on one thread",
  }[runs];
  if (instead) $("where").textContent += ` (not by WebGPU: ${instead})`;

  const ownStyle = (k) => (k === 0 ? styleOf($("first").value) : (styleOf($("first").value) + 37 * k) % card.styles.length);
  function weights(k) {
    const row = new Float32Array(card.styles.length), share = k === 0 ? +$("blend").value / 100 : 0;
    row[ownStyle(k)] += 1 - share;
    row[styleOf($("second").value)] += share;
    return row;
  }
  function pace() {
    const share = +$("blend").value / 100;
    return (1 - share) * data.paces[styleOf($("first").value)] + share * data.paces[styleOf($("second").value)];
  }

  // As many characters as are wanted: the leader, and rows behind him. Those who walk already go on.
  async function gather(seed, fresh = false) {
    const leader = fresh ? null : last?.targets?.[0], yaw = leader?.heading ?? 0, [x, z] = leader ? [leader.x, leader.z] : [0, 0];
    const across = options.count > 8 ? 8 : 4;
    const places = Array.from({ length: options.count }, (_, k) => {
      const right = k && 1.4 * (((k - 1) % across) - (across - 1) / 2), back = k && 1.5 * (1 + Math.floor((k - 1) / across));
      return {
        x: x - right * Math.cos(yaw) - back * Math.sin(yaw), z: z + right * Math.sin(yaw) - back * Math.cos(yaw), yaw,
        style: ownStyle(k),
      };
    });
    const { histories } = await network.ask("characters", { places, seed, keep: !fresh });
    tapes.length = Math.min(tapes.length, options.count);
    if (fresh) tapes.length = 0;
    for (let k = tapes.length; k < options.count; k++)
      tapes.push(histories[k].map(posed));
    times = [];
  }

  async function round(noise) {
    pending = true;
    if (tapes.length !== options.count) await gather();
    const wish = wishes.now();
    if (!wishes.taken && !data.still) Object.assign(wish, { speed: 1, direction: 1.2 * Math.sin(newest / 130) });
    const one = { speed: wish.speed * pace() * (+$("speed").value / 100), direction: wish.direction };
    last = await network.ask("round", {
      wishes: tapes.map(() => one), styles: tapes.map((_, k) => weights(k)), sigmas: card.sigmas[options.steps],
      hop: options.hop, blend: BLEND, noise, locking: options.locking,
    });
    seams.push({ frame: newest, x: last.made[0].history.at(-1)[0], z: last.made[0].history.at(-1)[2] });
    seams = seams.slice(-20);
    last.made.forEach(({ shown }, k) => {
      tapes[k].push(...shown.map(posed));
      tapes[k].splice(0, Math.max(0, tapes[k].length - 120));
    });
    newest += options.hop;
    const { x, z } = last.targets[0];
    last.made[0].frames.forEach((frame, k) => record.push({
      frame: newest - options.hop + 1 + k, points: Array.from(tapes[0].at(k - options.hop)),
      target: k === options.hop - 1 ? [x, z] : null, wish: one,
    }));
    record = record.slice(-RECORDED);
    times = [...times, last.ms].slice(-9);
    rounds++;
    // Where a round takes longer than the frames it brings, it has to bring more.
    const needed = Math.ceil(median(times) / (0.7 * 1000 * HOP / FPS));
    options.hop = times.length < 3 ? options.hop : Math.min(card.window, HOP * Math.max(1, needed));
    pending = false;
  }

  function draw() {
    picture.begin();
    picture.people(tapes.length);
    const frame = Math.floor(clock), share = clock - frame;
    tapes.forEach((tape, k) => {
      picture.body(k, frameAt(tape, frame), frameAt(tape, frame + 1), share);
    });
    if (last) {
      last.made.forEach(({ path }, k) => {
        if (k >= tapes.length) return;
        for (let at = 3; at < card.window; at += 4)
          picture.dot(picture.dots, path[3 * at], path[3 * at + 1], k === 0 ? 0.05 : 0.035, data.target);
      });
      if (options.made) {
        const { history, window } = last.made[0], points = (one) => jointPositions(card.skeleton, one);
        for (let k = 0; k < history.length; k += 3) picture.ghost(points(history[k]), data.past);
        for (let k = HOP - 1; k < window.length; k += HOP) picture.ghost(points(window[k]), k < last.made[0].frames.length ? data.taken : data.dropped);
        for (const { x, z } of seams) picture.dot(picture.seams, x, z, 1, data.seam);
      }
    }
    picture.end();
  }

  let before = performance.now();
  function loop(now) {
    requestAnimationFrame(loop);
    if (!tapes.length || timing) return;
    const passed = Math.min(0.1, (now - before) / 1000), wanted = clock + passed * FPS;
    before = now;
    if (wanted > newest) waits++;
    clock = Math.min(wanted, newest);
    const ms = times.length ? median(times) : 0, lead = Math.max(2, Math.ceil((1.3 * ms * FPS) / 1000) + 1);
    if (!pending && !frozen && newest - clock <= lead) round().catch(fail);
    picture.around -= 1.5 * passed * wishes.axes().around;
    picture.resize();
    const roots = tapes.map((tape) => frameAt(tape, Math.floor(clock)));
    const middle = (axis) => roots.reduce((sum, points) => sum + points[axis] / roots.length, 0);
    picture.look(middle(0), middle(2), tapes.length, rounds < 2 ? 1 : 1 - Math.exp(-5 * passed));
    draw();
    drawn = [...drawn, now].slice(-60);
    if (drawn.length === 12 && median(drawn.slice(1).map((at, k) => at - drawn[k])) > 50 && picture.coarser()) drawn = [];
    if (rounds && drawn.length % 10 === 0) report(ms);
  }

  function rate() {
    return drawn.length < 2 ? 0 : (1000 * (drawn.length - 1)) / (drawn.at(-1) - drawn[0]);
  }

  let reported = 0;
  function report(ms) {
    if (performance.now() - reported < 400) return;
    reported = performance.now();
    $("ms").textContent = ms < 10 ? ms.toFixed(1) : ms.toFixed(0);
    $("hop").textContent = options.hop;
    $("rate").textContent = rate() < 10 ? rate().toFixed(1) : rate().toFixed(0);
    $("coarse").textContent = picture.sharpness < Math.min(devicePixelRatio, 2) ? " (fewer pixels, to be quicker)" : "";
  }

  let frozen = false, timing = false;
  async function freeze() {
    frozen = true;
    while (pending) await new Promise((done) => setTimeout(done, 10));
  }
  function fail(error) {
    frozen = true;
    $("message").textContent = `The network does not run in this browser: ${error.message}`;
    $("message").hidden = false;
  }

  for (const input of document.querySelectorAll("input[name=steps]"))
    input.addEventListener("change", () => { options.steps = input.value; times = []; options.hop = HOP; });
  for (const input of document.querySelectorAll("input[name=count]"))
    input.addEventListener("change", () => { options.count = +input.value; options.hop = HOP; });
  $("made").addEventListener("change", () => { options.made = $("made").checked; $("legend").hidden = !options.made; });
  $("feet").addEventListener("change", () => { options.locking = $("feet").checked; });
  // Who has chosen by mouse wants to steer again: arrows would turn the choice over instead.
  $("panel").addEventListener("click", (event) => {
    if (event.detail > 0 && !event.target.closest("select, details")) setTimeout(() => canvas.focus());
  });
  $("settings").open = !matchMedia("(max-width: 600px), (max-height: 480px)").matches;
  for (const select of [$("first"), $("second")]) {
    for (const name of card.styles) select.add(new Option(name.replace(/([a-z])([A-Z])/g, "$1 $2"), name));
    select.addEventListener("change", () => canvas.focus());
  }
  [$("first").value, $("second").value] = data.first_styles;
  for (const name of ["past", "taken", "dropped", "target", "seam"]) data[name] = new THREE.Color(data.marks[name]);
  data.tints = Array.from({ length: MOST }, (_, k) => new THREE.Color().setHSL((k * 0.618) % 1, 0.25, 0.45));
  data.still = matchMedia("(prefers-reduced-motion: reduce)").matches;

  await gather(Math.floor(1e9 * Math.random()), true);
  newest = card.num_history - 1;
  clock = newest;
  requestAnimationFrame(loop);
  document.documentElement.dataset.ready = "yes";

  window.steer = {
    state: () => ({
      clock, newest, rounds, waits, hop: options.hop, ms: times.length ? median(times) : null, timed: times.length, rate: rate(),
      count: tapes.length, targets: last?.targets, around: picture.around, frozen, runs, sharpness: picture.sharpness, pictures: drawn.length,
    }),
    record: () => record,
    forget: () => { record = []; waits = 0; },
    // Milliseconds that the worker takes for one round as the game asks for it, with game and picture stopped: for those who
    // measure.
    async time(count, steps) {
      timing = true;
      await freeze();
      const places = Array.from({ length: count }, (_, k) => ({ x: 2 * k, z: 0, yaw: 0, style: ownStyle(k) }));
      await network.ask("characters", { places, keep: true });
      const wish = { speed: pace(), direction: 0 };
      return (await network.ask("round", {
        wishes: places.map(() => wish), styles: places.map((_, k) => weights(k)), sigmas: card.sigmas[steps],
        hop: HOP, blend: BLEND, locking: options.locking,
      })).ms;
    },
    // One round of given numbers from a fresh start, with the game stopped: for tests.
    async rehearse({ places, wishes: given, styles, noise, sigmas, hop, blend, locking }) {
      await freeze();
      await network.ask("characters", { places, keep: false });
      const made = [];
      for (const one of noise)
        made.push((await network.ask("round", { wishes: given, styles, sigmas, hop, blend, locking, noise: Float32Array.from(one) })).made);
      return made.map((characters) => characters.map(({ shown }) => shown.map((frame) => Array.from(frame))));
    },
  };
}
