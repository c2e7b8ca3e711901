// Three figures of the notebook beside the paper that a reader moves. docs/live.py brings the numbers and puts this into the
// page, docs/live.html has the parts. Numbers stand in <data> elements, whose value has all digits.
import { Matrix4, Quaternion, Vector3 } from "three";
import { Figure, bodyGeometry, bodyMaterial, paintBody } from "body";
import { FPS, jointPositions, normalNumbers, orthonormalise, sampleRound } from "motion";
import { Network } from "network";
import { Stage } from "scene";
import uPlot from "uplot";

const LOWEST = 0.01, HIGHEST = 128, PARTICLES = 500, REACH = 3.2, PAUSE = 15;
const phone = innerWidth < 768, still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const tone = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--live-${name}`).trim();
const repaint = new Set(); // what is drawn again when the page turns dark or light
new MutationObserver(() => repaint.forEach((draw) => draw())).observe(document.documentElement, { attributeFilter: ["data-theme"] });

// ------------------------------------------------------------------------------------------------------------- the pieces

// Set numbers of a figure; digits behind the point, or if negative all that count.
function say(figure, numbers) {
  for (const [name, value] of Object.entries(numbers)) {
    const element = figure.querySelector(`#${name}`), { digits } = element.dataset;
    element.value = value;
    element.textContent = digits < 0 ? Number(value.toPrecision(-digits)) : value.toFixed(digits);
  }
}

// Run for the newest value; what comes in meanwhile replaces what waits.
function latest(run) {
  let busy = false, next = null;
  return async function go(...given) {
    next = given;
    if (busy) return;
    for (busy = true; next;) {
      [given, next] = [next, null];
      await run(...given);
    }
    busy = false;
  };
}

// A plot as wide as its element, in the page's colours; `series` are colours, `reach` the ends of an axis or a function.
function chart(element, height, { x, y, series, marks = false, draw = [], data }) {
  const font = "12px system-ui, sans-serif", line = { stroke: () => tone("line"), width: 1 };
  const powers = { splits: () => [0.01, 0.1, 1, 10, 100], values: (_, places) => places.map((place) => place ?? "") };
  const axis = ({ label, log }, size) => ({ label, size, font, labelFont: font, labelSize: 20, stroke: () => tone("text"), grid: line, ticks: { ...line, size: 4 }, ...(log && powers) });
  const scale = ({ log, reach }) => ({ time: false, distr: log ? 3 : 1, range: typeof reach === "function" ? reach : () => reach });
  const none = () => null, points = { show: marks, size: 9, width: 1, stroke: () => tone("page") };
  const plot = new uPlot({
    width: Math.max(200, element.clientWidth), height, pxAlign: false, padding: [10, 14, 0, 0], legend: { show: false }, hooks: { draw },
    scales: { x: scale(x), y: scale(y) }, axes: [axis(x, 34), axis(y, 46)],
    cursor: { y: false, points: { size: 11 }, drag: { x: false, y: false }, bind: { mousemove: none, mousedown: none, mouseleave: none, mouseenter: none } },
    series: [{}, ...series.map((color) => ({ stroke: () => tone(color), width: 2, spanGaps: !marks, points: { ...points, fill: () => tone(color) } }))],
  }, data, element);
  new ResizeObserver(() => plot.setSize({ width: element.clientWidth, height })).observe(element);
  repaint.add(() => plot.redraw(false));
  return plot;
}

const mark = (plot, x) => plot.setCursor({ left: plot.valToPos(x, "x"), top: 0 });

// A mouse or finger that pulls over a plot: pull(x, y) in the plot's units.
function pulled(plot, pull) {
  const { over } = plot, go = (event) => {
    const box = over.getBoundingClientRect();
    if (over.hasPointerCapture(event.pointerId)) pull(plot.posToVal(event.clientX - box.left, "x"), plot.posToVal(event.clientY - box.top, "y"));
  };
  over.classList.add("pulled");
  over.addEventListener("pointerdown", (event) => { over.setPointerCapture(event.pointerId); go(event); });
  over.addEventListener("pointermove", go);
}

// Bodies side by side in one scene, each above its column; the camera goes along with the last one's root.
class Bodies {
  constructor(element, button, { skeleton, facing }, looks) {
    Object.assign(this, { element, button, looks, around: facing - Math.PI / 3, clock: 16, moves: [] });
    this.stage = new Stage(element);
    this.view = this.stage.add(element);
    this.view.camera.fov = 11; // far away, so that all are seen from one side
    this.view.floor.material.uniforms.step.value = 0.5;
    this.columns = new Set(looks.map(({ column }) => column)).size;
    const pale = { transparent: true, opacity: 0.3, depthWrite: false };
    this.figures = looks.map(({ ghost }) => new Figure(skeleton, bodyGeometry(skeleton), bodyMaterial(ghost && pale)));
    this.figures.forEach(({ mesh }, k) => { mesh.castShadow = !looks[k].ghost; });
    this.view.scene.add(...this.figures.map(({ mesh }) => mesh));
    if (this.stage.software) this.stage.castShadows(false);
    let before = 0, seen = true;
    new ResizeObserver(() => this.fit()).observe(element);
    new IntersectionObserver(([entry]) => { seen = entry.isIntersecting; }).observe(element);
    button.addEventListener("click", () => this.run(!this.running));
    this.run(!still);
    repaint.add(() => this.paint());
    this.paint();
    const loop = (now) => {
      requestAnimationFrame(loop);
      const passed = Math.min(0.1, (now - before) / 1000), frame = Math.floor(this.clock);
      before = now;
      if (!this.running || !seen || !this.moves.length) return;
      this.clock = (this.clock + passed * FPS) % (this.moves[0].length + PAUSE); // it stands still a while at the end
      if (Math.floor(this.clock) !== frame) this.draw();
    };
    requestAnimationFrame(loop);
  }

  get frame() { return Math.min(Math.floor(this.clock), this.moves[0].length - 1); }

  run(wanted) {
    this.running = wanted;
    this.button.textContent = wanted ? "Pause" : "Play";
  }

  paint() {
    const colors = Object.fromEntries(["left", "right", "flesh"].map((name) => [name, tone(name)]));
    this.figures.forEach(({ mesh }, k) => paintBody(mesh.geometry, colors, this.looks[k].color && tone(this.looks[k].color)));
    this.view.paint({ panel: tone("page"), floor: tone("floor"), grid: tone("line"), dark: document.documentElement.dataset.theme === "dark" });
    this.fit();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width) return;
    this.stage.resize();
    const half = Math.max(1.08, (0.42 * this.columns * height) / width); // metres from the middle to the top
    this.spacing = (2 * half * width) / height / this.columns;
    this.far = half / Math.tan((this.view.camera.fov * Math.PI) / 360);
    this.view.light(0.6 * this.spacing * this.columns);
    this.draw();
  }

  show(moves) { // a list of frames for each figure
    const [x, y, z] = [new Vector3(), new Vector3(), new Vector3()];
    this.moves = moves;
    this.turns = moves.map((frames) => frames.map((frame) => Array.from({ length: (frame.length - 3) / 6 }, (_, joint) => {
      x.fromArray(frame, 3 + 6 * joint);
      y.fromArray(frame, 6 + 6 * joint);
      return new Quaternion().setFromRotationMatrix(new Matrix4().makeBasis(x, y, z.crossVectors(x, y))).toArray();
    }).flat()));
    this.draw();
  }

  draw() {
    if (!this.moves.length || !this.spacing) return;
    const k = this.frame, last = this.moves.at(-1)[k], sine = Math.sin(this.around), cosine = Math.cos(this.around);
    this.figures.forEach((figure, i) => {
      const [x, y, z] = this.looks[i].pinned ? last : this.moves[i][k], away = this.spacing * (this.looks[i].column - (this.columns - 1) / 2);
      figure.pose([x + away * cosine, y, z - away * sine], this.turns[i][k]);
    });
    const offset = new Vector3(Math.cos(0.1) * sine, Math.sin(0.1), Math.cos(0.1) * cosine).multiplyScalar(this.far);
    this.view.aim(new Vector3(last[0], 0.92, last[2]), offset);
    this.stage.draw();
    this.drawn?.(k);
  }
}

// --------------------------------------------------------------------------------------------------------- 1: noise level

async function noise(figure, { data, arrays, network }) {
  const [scene, axes, slider, button] = [".scene", ".plot", "input", ".pause"].map((name) => figure.querySelector(name));
  const bodies = new Bodies(scene, button, data, [{ column: 0, color: "grey", pinned: true }, { column: 1 }, { column: 2, color: "clean" }]);
  const level = (place) => LOWEST * (HIGHEST / LOWEST) ** (place / 100), clean = network.frames(arrays.x0), truth = network.joints(clean);
  const guessed = async (sigma) => {
    const noisy = arrays.x0.map((value, i) => value + sigma * arrays.noise[i]);
    const guess = await network.sample(noisy.map((value) => value / sigma), [sigma, 0]);
    return [noisy, guess].map(network.frames);
  };
  const off = (frames) => network.apart(network.joints(frames), truth);
  const [places, means] = data.measured, measured = (sigma) => { // between notebook 04's levels, along the logarithm
    const k = Math.max(1, places.findIndex((place) => place >= sigma * (1 - 1e-9)));
    return means[k - 1] + (means[k] - means[k - 1]) * Math.log(sigma / places[k - 1]) / Math.log(places[k] / places[k - 1]);
  };
  const plot = chart(axes, phone ? 190 : 230, {
    x: { label: "noise level σ", log: true, reach: [LOWEST, HIGHEST] }, y: { label: "from clean (cm)", reach: [0, 1.6] },
    series: ["mean", "guess"], data: [places, means, means.map(() => null)],
  });
  const own = new Map(), curve = () => {
    const known = [...own].sort(([a], [b]) => a - b);
    plot.setData([known.map(([sigma]) => sigma), known.map(([sigma]) => measured(sigma)), known.map(([, distance]) => distance)]);
    mark(plot, level(slider.value));
  };
  const go = latest(async () => {
    const sigma = level(slider.value), [noisy, guess] = await guessed(sigma);
    own.set(sigma, off(guess));
    say(figure, { sigma, "noisy-cm": off(noisy), "guess-cm": own.get(sigma), "mean-cm": measured(sigma) });
    slider.setAttribute("aria-valuetext", `σ ${sigma.toPrecision(3)}, the guess is ${own.get(sigma).toFixed(2)} cm off`);
    bodies.show([noisy, guess, clean]);
    curve();
  });
  slider.addEventListener("input", go);
  pulled(plot, (sigma) => {
    slider.value = (100 * Math.log(sigma / LOWEST)) / Math.log(HIGHEST / LOWEST);
    go();
  });
  await go();
  for (let place = 0; place <= 100; place += 5) own.set(level(place), off((await guessed(level(place)))[1]));
  curve();
}

// -------------------------------------------------------------------------------------------------- 2: eight steps or one

async function steps(figure, { data, arrays, network }) {
  const [scene, axes, enlarge, again, button] = [".scene", ".plot", "input", ".again", ".pause"].map((name) => figure.querySelector(name));
  const bodies = new Bodies(scene, button, data, [
    ...[0, 1, 2, 3, 4].map((column) => ({ column, color: column === 4 ? "other" : undefined })),
    ...[1, 2, 3, 4].map((column) => ({ column, color: "text", ghost: true })), { column: 0 },
  ]);
  const size = arrays.x0.length, frames = Array.from({ length: data.card.window }, (_, k) => k);
  let made = [], highest = 1.5;
  const plot = chart(axes, phone ? 190 : 230, {
    x: { label: "frame", reach: [0, frames.length - 1] }, y: { label: "from 8 steps (cm)", reach: () => [0, highest] },
    series: ["four", "two-steps", "guess", "other"], data: [frames, [], [], [], []],
  });
  bodies.drawn = (frame) => mark(plot, frame);
  const show = () => { // from the eight-step window on, so many times as far
    const times = +enlarge.value, moved = made.map((x) => network.frames(x.map((value, i) => made[0][i] + times * (value - made[0][i]))));
    say(figure, { times });
    bodies.figures.forEach(({ mesh }, k) => { mesh.visible = times > 1 || !bodies.looks[k].ghost; });
    bodies.show([...moved, ...Array(5).fill(moved[0])]);
  };
  const go = latest(async (one, other) => {
    const runs = [[8, one, 8], [4, one, 4], [2, one, 2], [1, one, 1], ["other", other, 8]], took = runs.map(() => []);
    const walk = async ([name, eps, count], k) => {
      const { clean, ms } = await network.sample(eps, data.sigmas[count]);
      made[k] = clean;
      took[k].push(ms);
      say(figure, { [`ms-${name}`]: [...took[k]].sort((a, b) => a - b)[took[k].length >> 1] });
    };
    for (const [k, run] of runs.entries()) await walk(run, k);
    const joints = made.map((x) => network.joints(network.frames(x)));
    const away = joints.slice(1).map((points) => frames.map((k) => network.apart([points[k]], [joints[0][k]])));
    runs.forEach(([name], k) => k && say(figure, { [`off-${name}`]: network.apart(joints[k], joints[0]) }));
    highest = Math.max(1.5, 1.1 * Math.max(...away.flat()));
    plot.setData([frames, ...away]);
    show();
    for (let time = 0; time < 4; time++) for (const [k, run] of runs.entries()) await walk(run, k);
  });
  let seed = 1;
  enlarge.addEventListener("input", show);
  again.addEventListener("click", () => go(normalNumbers(seed++)(size), normalNumbers(seed++)(size)));
  pulled(plot, (frame) => {
    bodies.run(false);
    bodies.clock = Math.min(Math.max(0, Math.round(frame)), frames.length - 1);
    bodies.draw();
  });
  await go(arrays.noise.subarray(0, size), arrays.noise.subarray(size));
}

// ------------------------------------------------------------------------------------------------------ 3: bend the ladder

async function ladder(figure, { data: { toes } }) {
  const [bend, top, number, ...axes] = ["#bend", "#top", "#number", ".levels", ".spread", ".plane"].map((name) => figure.querySelector(name));
  const means = Float64Array.from(toes.means.flat()), { width } = toes, modes = toes.means.length, near = new Float64Array(modes);
  const half = Float64Array.from(toes.means, ([a, b]) => (a * a + b * b) / 2);
  const moments = (x, k) => { // mean and deviation of one coordinate
    const own = x.filter((_, i) => i % 2 === k), mean = own.reduce((sum, value) => sum + value) / own.length;
    return [mean, Math.sqrt(own.reduce((sum, value) => sum + (value - mean) ** 2, 0) / own.length)];
  };
  const spreadOf = (x) => Math.hypot(moments(x, 0)[1], moments(x, 1)[1]);
  const drawn = normalNumbers(7)(2 * PARTICLES), [first, second] = [moments(drawn, 0), moments(drawn, 1)];
  const eps = drawn.map((value, i) => (value - (i % 2 ? second : first)[0]) / (i % 2 ? second : first)[1]); // no chance in its spread
  figure.particles = eps;
  const denoise = (x, sigma) => { // E[x0 | x]: course notebook 01, `posterior_mean`
    const total = width * width + sigma * sigma, keep = (sigma * sigma) / total, clean = new Float32Array(x.length);
    for (let i = 0; i < x.length; i += 2) {
      let nearest = -Infinity, sum = 0, a = 0, b = 0;
      for (let k = 0; k < modes; k++) {
        near[k] = x[i] * means[2 * k] + x[i + 1] * means[2 * k + 1] - half[k];
        if (near[k] > nearest) nearest = near[k];
      }
      for (let k = 0; k < modes; k++) {
        if (nearest - near[k] > 30 * total) continue; // a share of 1e-13
        const share = Math.exp((near[k] - nearest) / total);
        sum += share;
        a += share * means[2 * k];
        b += share * means[2 * k + 1];
      }
      clean[i] = x[i] + keep * (a / sum - x[i]);
      clean[i + 1] = x[i + 1] + keep * (b / sum - x[i + 1]);
    }
    return clean;
  };
  const eq9 = (t, high, rho) => (high ** (1 / rho) + t * (LOWEST ** (1 / rho) - high ** (1 / rho))) ** rho;
  const own = spreadOf(means), highest = () => HIGHEST ** (top.value / 100);
  let states = [], sigmas = [1];
  const x = { reach: () => [-0.02 * sigmas.length, 1.02 * sigmas.length - 1] }, rungs = { x, marks: true, data: [[], []] };
  const levels = chart(axes[0], phone ? 140 : 190, { ...rungs, y: { label: "noise level σ", log: true, reach: [0.006, 250] }, series: ["guess"] });
  const spread = chart(axes[1], phone ? 130 : 170, { ...rungs, x: { ...x, label: "step" }, y: { label: "spread (%)", reach: [0, 125] }, series: ["other"] });
  const plane = chart(axes[2], phone ? 270 : 360, {
    x: { label: "left toe, x / √(1 + σ²)", reach: ({ bbox }) => [-1, 1].map((side) => (side * REACH * (bbox.width || 1)) / (bbox.height || 1)) },
    y: { label: "right toe, x / √(1 + σ²)", reach: [-REACH, REACH] }, series: [], data: [[0]],
    draw: [({ ctx, bbox, valToPos }) => {
      const [x0, y0] = [valToPos(0, "x", true), valToPos(0, "y", true)], unit = valToPos(1, "x", true) - x0, ratio = devicePixelRatio;
      const paint = (what, color, alpha, trace) => {
        Object.assign(ctx, { fillStyle: tone(color), strokeStyle: tone(color), globalAlpha: alpha, lineWidth: ratio });
        ctx.beginPath();
        trace();
        ctx[what]();
      };
      const discs = (points, radius) => points.forEach((value, i) => {
        const [a, b] = [x0 + value * unit, y0 - points[i + 1] * unit];
        if (i % 2 === 0) { ctx.moveTo(a + radius, b); ctx.arc(a, b, radius, 0, 7); }
      });
      const scales = sigmas.map((sigma) => unit / Math.sqrt(1 + sigma * sigma));
      ctx.save();
      paint("clip", "page", 1, () => ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height));
      paint("fill", "four", 0.35, () => discs(means, 2 * width * unit));
      paint("stroke", "guess", 0.22, () => eps.forEach((_, i) => i % 2 || states.forEach((x, k) =>
        ctx[k ? "lineTo" : "moveTo"](x0 + scales[k] * x[i], y0 - scales[k] * x[i + 1]))));
      paint("fill", "other", 0.9, () => discs(states.at(-1) ?? [], 1.6 * ratio));
      ctx.restore();
    }],
  });
  const go = latest(async () => {
    const began = performance.now(), rho = +bend.value, high = highest(), steps = +number.value;
    const grid = Array.from({ length: steps }, (_, k) => eq9(k / Math.max(1, steps - 1), high, rho)).concat(0), visited = [];
    const ends = await sampleRound((x, sigma) => { visited.push(x); return denoise(x, sigma); }, eps, grid);
    [states, sigmas] = [[...visited, ends], grid];
    const left = states.map((x, k) => (100 * spreadOf(x)) / Math.hypot(own, Math.SQRT2 * width, Math.SQRT2 * grid[k])), places = grid.map((_, k) => k);
    levels.setData([places, [...grid.slice(0, -1), null]]);
    spread.setData([places, left]);
    plane.redraw(false);
    await null; // the plots have drawn
    say(figure, { rho, "sigma-max": high, "num-steps": steps, spread: left.at(-1), lost: 100 - left.at(-1), "ladder-ms": performance.now() - began });
    await new Promise(requestAnimationFrame); // one picture a frame, however often a slider speaks
    figure.dataset.pictures = +(figure.dataset.pictures ?? 0) + 1;
  });
  for (const input of [bend, top, number]) input.addEventListener("input", go);
  pulled(levels, (place, sigma) => { // the first dot is the highest level; another one bends the ladder until it lies there
    const last = +number.value - 1, k = Math.min(Math.max(0, Math.round(place)), last);
    if (k === 0) top.value = (100 * Math.log(sigma)) / Math.log(HIGHEST);
    else if (k < last) bend.value = Array.from({ length: 111 }, (_, i) => 1 + i / 10).find((rho) => eq9(k / last, highest(), rho) <= sigma) ?? 12;
    go();
  });
  await go();
}

// --------------------------------------------------------------------------------------------------------------- the page

// The network of the steer page in a worker of its own, for one window of one condition.
async function openNetwork({ card }, { history, path, style }, unpack) {
  await new Promise((done, failed) => {
    const events = { onload: done, onerror: () => failed(new Error("live_network.js did not come")) };
    document.head.append(Object.assign(document.createElement("script"), { src: "live_network.js", ...events }));
  });
  const [worker, wasm, program] = await Promise.all(["worker", "wasm", "program"].map((name) => unpack(globalThis.liveNetwork[name])));
  const { mean, deviation } = card.normaliser, joints = card.skeleton.parents.length;
  const network = new Network(URL.createObjectURL(new Blob([worker], { type: "text/javascript" })));
  await network.ask("open", { card, wasm, program: new Uint8Array(program), poses: new Float32Array(0) });
  let last = null; // one call after the other, so that none counts another's milliseconds
  return {
    sample: (noise, sigmas) => (last = Promise.resolve(last).then(() => network.ask("sample", { condition: { history, path, style }, noise, sigmas }))),
    frames: (x) => Array.from({ length: card.window }, (_, k) =>
      orthonormalise(Float64Array.from(mean, (middle, c) => (x.clean ?? x)[k * mean.length + c] * deviation[c] + middle))),
    joints: (frames) => frames.map((frame) => jointPositions(card.skeleton, frame).subarray(0, 3 * joints)),
    apart(one, other) { // mean distance of joints over frames, centimetres
      let sum = 0;
      one.forEach((points, k) => { for (let i = 0; i < points.length; i += 3) sum += Math.hypot(...[0, 1, 2].map((c) => points[i + c] - other[k][i + c])); });
      return (100 * sum) / (one.length * joints);
    },
  };
}

export async function start(files, unpack) {
  const data = JSON.parse(new TextDecoder().decode(files.data)), parts = new DOMParser().parseFromString(data.html, "text/html");
  const arrays = Object.fromEntries(Object.entries(files).filter(([name]) => name !== "data").map(([name, { buffer }]) => [name, new Float32Array(buffer)]));
  let network = null;
  document.head.append(Object.assign(document.createElement("style"), { textContent: data.style }));
  for (const link of document.querySelectorAll("p > a")) if (link.textContent === "Live on the site") link.parentElement.remove();
  const begin = async (name, make, cell) => {
    const figure = parts.getElementById(`live-${name}`), picture = cell.querySelector(".cell_output img"), shown = picture.closest("a") ?? picture;
    shown.insertAdjacentHTML("afterend", '<p class="live wait" role="status">Loading the live figure …</p>');
    const words = shown.nextElementSibling;
    try {
      if (name !== "ladder") network = await (network ??= openNetwork(data, arrays, unpack));
      (name === "ladder" ? cell.nextElementSibling : cell).after(figure);
      shown.classList.toggle("replaced", name !== "ladder");
      words.hidden = true;
      await make(figure, { data, arrays, network });
      figure.dataset.ready = "yes";
    } catch (error) { // the still picture stays
      figure.remove();
      shown.classList.remove("replaced");
      words.hidden = false;
      words.textContent = `The live figure does not run here: ${error.message}`;
    }
  };
  for (const [name, make] of Object.entries({ noise, steps, ladder })) {
    const cell = document.querySelector(`.tag_live-${name}`);
    const near = new IntersectionObserver(([{ isIntersecting }]) => {
      if (isIntersecting) begin(name, make, cell, near.disconnect());
    }, { rootMargin: "600px" });
    near.observe(cell);
  }
}
