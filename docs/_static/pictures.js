// Pictures that are worked out while one moves them, of docs/pictures.md. What draws stands last; the rest are functions
// of numbers, which tests/web compares with Python. Levels are noise levels; data are Gaussians on a line.
"use strict";
(() => {
  const sum = (values) => values.reduce((total, value) => total + value, 0);
  const mean = (values) => sum(values) / values.length;
  const even = (from, to, steps) => Array.from({ length: steps + 1 }, (_, k) => from + ((to - from) * k) / (steps || 1));
  const geometric = (from, to, steps) => even(Math.log(from), Math.log(to), steps).map(Math.exp);
  const pair = { means: [-1, 1], width: 0.3 };
  const crowd = { means: [-1, 1], width: 0.5 };
  const told = { means: [1], width: 0.5 };

  // Of equally likely Gaussians of one width: density, and the exact clean estimate.
  const parts = ({ means, width }, x, sigma) => {
    const variance = width ** 2 + sigma ** 2;
    const logs = means.map((m) => -((x - m) ** 2) / (2 * variance));
    const top = Math.max(...logs);
    return { variance, top, shares: logs.map((log) => Math.exp(log - top)) };
  };
  const logDensity = (data, x, sigma) => {
    const { variance, top, shares } = parts(data, x, sigma);
    return top + Math.log(mean(shares)) - 0.5 * Math.log(2 * Math.PI * variance);
  };
  const denoiser = (data) => (x, sigma) => {
    const { variance, shares } = parts(data, x, sigma);
    const centre = sum(shares.map((share, k) => share * data.means[k])) / sum(shares);
    return x + (sigma ** 2 / variance) * (centre - x);
  };
  const guided = (conditional, free, w) => (x, sigma) => free(x, sigma) + w * (conditional(x, sigma) - free(x, sigma));

  const euler = (D, x, sigma, lower) => D(x, sigma) + (lower / sigma) * (x - D(x, sigma));
  const heun = (D, x, sigma, lower) => {
    const slope = (x - D(x, sigma)) / sigma;
    const there = x + (lower - sigma) * slope;
    return x + ((lower - sigma) * (slope + (there - D(there, lower)) / lower)) / 2;
  };
  // Runge and Kutta's step of order 4 in log sigma, where the flow is dx = x - D.
  const exact = (D, x, sigma, lower) => {
    const h = Math.log(lower / sigma), middle = Math.sqrt(sigma * lower);
    const slope = (y, level) => y - D(y, level);
    const a = slope(x, sigma), b = slope(x + (h / 2) * a, middle), c = slope(x + (h / 2) * b, middle);
    return x + (h / 6) * (a + 2 * b + 2 * c + slope(x + h * c, lower));
  };
  const walk = (step, D, x, levels) =>
    levels.slice(1).reduce((states, lower, k) => [...states, step(D, states[k], levels[k], lower)], [x]);
  const end = (step, D, x, levels) => levels.slice(1).reduce((state, lower, k) => step(D, state, levels[k], lower), x);
  const flow = (D, x, sigma, lower) => end(exact, D, x, geometric(sigma, lower, 1 + Math.ceil(40 * Math.log(sigma / lower))));

  // Normal numbers of a seed: mulberry32, then Box and Muller.
  const normals = (seed, count) => {
    let state = seed * 7919 + 1;
    const uniform = () => {
      state = (state + 0x6d2b79f5) | 0;
      let t = Math.imul(state ^ (state >>> 15), 1 | state);
      t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
      return (((t ^ (t >>> 14)) >>> 0) + 0.5) / 4294967296;
    };
    return Array.from({ length: count }, () => Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform()));
  };

  const round = (value, digits = 2) => value.toFixed(digits).replace("-", "\u2212");
  const TOP = 80, BOTTOM = 0.01, WALKERS = 300, STEPS = 200;

  const pictures = {
    step: {
      sliders: { noise: ["noise σ", -1, 1, 0.05, 0.2, (v) => round(10 ** v)],
                 place: ["place x, in its own spread", -2, 2, 0.05, 0.6, round],
                 left: ["noise left σ′/σ", 0.05, 0.95, 0.05, 0.25, round],
                 way: ["way", 0, 1, 1, 0, (v) => ["Euler (DDIM)", "Heun"][v]] },
      axes: { x: [1.06, -0.1], names: ["share of the noise that is left", "x"] },
      compute({ noise, place, left, way }) {
        const D = denoiser(pair), sigma = 10 ** noise, lower = left * sigma;
        const x = place * Math.hypot(1, pair.width, sigma);
        const shares = geometric(1, 0.02, 60);
        const path = walk((D, y, s, l) => flow(D, y, s, l), D, x, shares.map((share) => share * sigma));
        const guess = D(x, sigma), first = euler(D, x, sigma, lower);
        const landed = way ? heun(D, x, sigma, lower) : first, right = flow(D, x, sigma, lower);
        const lines = { "exact flow": shares.map((share, k) => [share, path[k]]), "to the guess D": [[1, x], [0, guess]] };
        if (way) lines["to the second guess"] = [[left, first], [0, D(first, lower)]];
        Object.assign(lines, { "the step": [[1, x], [left, landed]], exact: [[left, right]] });
        return { lines, says: `D = ${round(guess)}, x′ = ${round(landed)}, off by ${round(landed - right, 3)}` };
      },
    },
    paths: {
      sliders: { strength: ["fresh noise λ", 0, 2, 0.1, 1, (v) => round(v, 1)], seed: ["random draw", 1, 9, 1, 1, String] },
      axes: { x: [40, 0.02], log: true, y: [-3, 3], names: ["noise level σ", "x, in its own spread"] },
      compute({ strength, seed }) {
        const levels = geometric(40, 0.1, STEPS), D = denoiser(pair), noise = normals(seed, WALKERS * (STEPS + 1));
        const walked = Array.from({ length: WALKERS }, (_, n) => {
          const states = [40 * noise[n]];
          for (let k = 0; k < STEPS; k++) {
            const sigma = levels[k], lower = levels[k + 1], pull = (D(states[k], sigma) - states[k]) / sigma;
            const fresh = strength * Math.sqrt(sigma ** 2 - lower ** 2) * noise[WALKERS * (k + 1) + n];
            states.push(states[k] + (1 + strength ** 2) * (sigma - lower) * pull + fresh);
          }
          return states;
        });
        const ends = walked.map((states) => states[STEPS]), centre = mean(ends);
        const spread = Math.sqrt(mean(ends.map((x) => (x - centre) ** 2)));
        const own = (x, sigma) => x / Math.hypot(1, pair.width, sigma);
        const density = even(-3, 3, 120).map((x) => [0.1 * 0.25 ** Math.exp(logDensity(pair, x, 0.1)), own(x, 0.1)]);
        const lines = Object.fromEntries(walked.slice(0, 25).map((states, n) => [n, states.map((x, k) => [levels[k], own(x, levels[k])])]));
        return { lines: { ...lines, "density at the end, exact": density },
                 says: `spread of ${WALKERS} ends ${round(spread)} (exact ${round(Math.sqrt(1.1))})` };
      },
    },
    guidance: {
      sliders: { w: ["scale w", 0, 8, 0.25, 3, round] },
      axes: { x: [-3.5, 5], y: [0, 2.2], names: ["x", "density"] },
      compute({ w }) {
        const D = guided(denoiser(told), denoiser(crowd), w), levels = geometric(TOP, BOTTOM, 120);
        const starts = even(-4, 4, 160), ends = starts.map((z) => end(heun, D, TOP * z, levels));
        // On a line the flow keeps the order of points: the density is that of noise over the stretching.
        const cloud = starts.slice(1, -1).map((z, k) => [ends[k + 1], (Math.exp(-z * z / 2) / Math.sqrt(2 * Math.PI)
          * (starts[k + 2] - starts[k])) / (ends[k + 2] - ends[k])]);
        const xs = even(-3.5, 5, 340), cell = xs[1] - xs[0];
        const tilt = xs.map((x) => Math.exp((1 - w) * logDensity(crowd, x, 0) + w * logDensity(told, x, 0)));
        const total = cell * sum(tilt), curve = (data) => xs.map((x) => [x, Math.exp(logDensity(data, x, 0))]);
        const centre = (cell / total) * sum(tilt.map((t, k) => t * xs[k]));
        const weights = starts.map((z) => Math.exp(-z * z / 2)), reached = sum(weights.map((q, k) => q * ends[k])) / sum(weights);
        return { lines: { "the crowd": curve(crowd), "the condition": curve(told),
                          "tilted, what w asks for": xs.map((x, k) => [x, tilt[k] / total]), "what the flow gives": cloud },
                 says: `mean asked for ${round(centre)}, reached ${round(reached)}` };
      },
    },
    phases: {
      sliders: { count: ["jumps", 1, 8, 1, 3, String], gap: ["edges that do not meet, by", 0, 0.5, 0.05, 0, (v) => `${Math.round(100 * v)} %`] },
      axes: { x: [80, 0.01], log: true, y: [-3, 3], names: ["noise level σ", "x, in its own spread"] },
      compute({ count, gap }) {
        const D = denoiser(pair), fine = geometric(TOP, BOTTOM, 80), edges = geometric(TOP, BOTTOM, count);
        const own = (x, sigma) => [sigma, x / Math.hypot(1, sigma)];
        const lines = {}, off = { jumps: [], guesses: [] };
        even(-1.75, 1.75, 7).forEach((z, n) => {
          const path = walk(flow, D, TOP * z, fine);
          const jumps = walk((D, x, sigma, lower) => flow(D, x, Math.max(sigma * (1 - gap), lower), lower), D, TOP * z, edges);
          const guesses = walk(euler, D, TOP * z, edges);
          const put = (name, states, levels) => (lines[`${name} ${n}`] = states.map((x, k) => own(x, levels[k])));
          put("path", path, fine), put("guess", guesses, edges), put("jump", jumps, edges);
          off.jumps.push(Math.abs(jumps[count] - path[80])), off.guesses.push(Math.abs(guesses[count] - path[80]));
        });
        return { lines, says: `ends off by ${round(mean(off.jumps), 3)} after exact jumps, ${round(mean(off.guesses), 3)} after DDIM` };
      },
    },
  };
  globalThis.pictures = Object.assign(pictures, { normals });

  // Drawing: what begins like a key looks like its value; the rest is thin and blue.
  const LOOKS = { "exact flow": "#8A8A8A 2", "to the guess": "#D6604D 1 4", "to the second": "#F1A340 1 4", "the step": "#542788 3", exact: "#1A1A1A 0", density: "#1A1A1A 2",
                  "the crowd": "#8A8A8A 1.5", "the condition": "#92C5DE 2", tilted: "#1A1A1A 2", "what the flow": "#542788 2.5",
                  path: "#8A8A8A 1", guess: "#D6604D 1.2 4", jump: "#542788 2" };
  const WIDTH = 640, HEIGHT = 300, LEFT = 58, RIGHT = 20, BELOW = 40;
  const svg = (name, attributes, text = "") => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, value));
    element.textContent = text;
    return element;
  };
  const draw = (board, { axes }, { lines }) => {
    const ys = Object.values(lines).flat().map(([, y]) => y);
    const [low, high] = axes.y || [Math.min(...ys) - 0.2, Math.max(...ys) + 0.6], shown = axes.log ? Math.log : (x) => x;
    const across = (x) => LEFT + ((WIDTH - LEFT - RIGHT) * (shown(x) - shown(axes.x[0]))) / (shown(axes.x[1]) - shown(axes.x[0]));
    const up = (y) => HEIGHT - BELOW - ((HEIGHT - BELOW - 8) * (Math.min(Math.max(y, low - 1), high + 1) - low)) / (high - low);
    const words = (x, y, text, anchor = "middle") => svg("text", { x, y, "text-anchor": anchor, "font-size": 12 }, text);
    const [from, to] = [...axes.x].sort((a, b) => a - b), ticks = axes.log ? [0.01, 0.1, 1, 10] : to - from < 2 ? [0, 0.5, 1] : even(-3, 5, 8);
    board.replaceChildren();
    ticks.filter((x) => x >= from && x <= to).forEach((x) => board.append(words(across(x), HEIGHT - BELOW + 15, x)));
    const every = high - low > 2.5 ? 1 : 0.25, first = every * Math.ceil(low / every), last = every * Math.floor(high / every);
    even(first, last, (last - first) / every).forEach((y) => board.append(words(LEFT - 4, up(y) + 4, round(y, every < 1 ? 2 : 0), "end")));
    board.append(words((LEFT + WIDTH) / 2, HEIGHT - 6, axes.names[0]), svg("text", { transform: `translate(14 ${HEIGHT / 2 - 15}) rotate(-90)`,
      "text-anchor": "middle", "font-size": 12 }, axes.names[1]));
    const inside = { x: LEFT, y: 8, width: WIDTH - LEFT - RIGHT, height: HEIGHT - BELOW - 8 };
    const area = svg("svg", { ...inside, viewBox: Object.values(inside).join(" ") }); // nothing is drawn outside of it
    board.append(svg("rect", { ...inside, fill: "none", stroke: "#8A8A8A" }), area);
    let row = 0;
    Object.entries(lines).forEach(([name, points]) => {
      const look = Object.keys(LOOKS).find((key) => name.startsWith(key)), [stroke, width, dash] = (LOOKS[look] || "#2166AC 0.7").split(" ");
      const places = points.map(([x, y]) => [across(x), up(y)]);
      area.append(svg("polyline", { points: places.join(" "), fill: "none", stroke, "stroke-width": width, "stroke-dasharray": dash || "none" }));
      if (["the step", "exact", "jump"].includes(look)) places.forEach(([cx, cy]) => area.append(svg("circle", { cx, cy, r: 3.5, fill: stroke })));
      if (name.length > 5 && !/ \d$/.test(name)) {
        const y = 24 + 16 * row++;
        board.append(svg("line", { x1: WIDTH - 212, x2: WIDTH - 194, y1: y - 4, y2: y - 4, stroke, "stroke-width": width, "stroke-dasharray": dash || "none" }),
          words(WIDTH - 188, y, name, "start"));
      }
    });
  };
  globalThis.document?.querySelectorAll("figure[data-picture]").forEach((figure) => {
    const picture = pictures[figure.dataset.picture], values = {};
    const board = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" }), says = document.createElement("figcaption");
    says.setAttribute("aria-live", "polite");
    const renew = () => {
      const made = picture.compute(values);
      draw(board, picture, made);
      says.textContent = made.says;
    };
    Object.entries(picture.sliders).forEach(([name, [text, min, max, step, value, shown]]) => {
      const label = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
      Object.assign(input, { type: "range", min, max, step, value, autocomplete: "off", name });
      input.oninput = () => {
        values[name] = Number(input.value);
        output.textContent = shown(values[name]);
        input.setAttribute("aria-valuetext", output.textContent);
        if (Object.keys(values).length === Object.keys(picture.sliders).length) renew();
      };
      label.append(`${text} `, input, output);
      figure.append(label);
      input.oninput();
    });
    figure.append(board, says);
  });
})();
