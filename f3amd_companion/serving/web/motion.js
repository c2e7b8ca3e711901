// Sampling, kinematics, conditions and feet of a character that is steered: tests/steering_oracle.py and tests/feet_oracle.py
// once more, for pages.
// Metres, radians, +Y up; a frame is root x, y, z, then six numbers a joint (two columns of its rotation). Arrays are flat,
// Float64Array, frame after frame. tests/test_steer_page.py holds these functions to Python's, to 1e-4.

export const FPS = 30;
const STIFFNESS = 24, MAX_TURN = 2.4, SPEED_SECONDS = 0.35;

export const wrapAngle = (angle) => angle - 2 * Math.PI * Math.floor((angle + Math.PI) / (2 * Math.PI));

// ------------------------------------------------------------------------------------------------- what is to be followed

// Move a target {x, z, heading, turning, speed} on under a wish {speed, direction}: {target, path}, path rows x, z, heading.
export function moveTarget(target, wish, frames) {
  let { x, z, heading, turning, speed } = target;
  const step = 1 / FPS, share = 1 - Math.exp(-step / SPEED_SECONDS), path = new Float64Array(3 * frames);
  for (let k = 0; k < frames; k++) {
    const away = wish.speed > 0 ? wrapAngle(wish.direction - heading) : 0;
    turning += step * (STIFFNESS * away - 2 * Math.sqrt(STIFFNESS) * turning);
    turning = Math.min(Math.max(turning, -MAX_TURN), MAX_TURN);
    heading += step * turning;
    speed += share * (wish.speed * Math.max(0.3, Math.cos(away)) - speed); // who turns round slows down for it
    x += step * speed * Math.sin(heading);
    z += step * speed * Math.cos(heading);
    path.set([x, z, heading], 3 * k);
  }
  return { target: { x, z, heading, turning, speed }, path };
}

// The path condition, [T, 8]: from where the character is (originX, originZ), bent back to the target's line over the window.
export function pathCondition(path, target, originX, originZ, pathScale) {
  const frames = path.length / 3, condition = new Float64Array(8 * frames);
  for (let k = 0; k < frames; k++) {
    const share = (k + 1) / frames, [x, z, yaw] = path.subarray(3 * k, 3 * k + 3);
    const alongX = x - target.x + share * (target.x - originX), alongZ = z - target.z + share * (target.z - originZ);
    condition.set([alongX / pathScale, alongZ / pathScale, Math.cos(yaw), 0, -Math.sin(yaw), 0, 1, 0], 8 * k);
  }
  return condition;
}

// ---------------------------------------------------------------------------------------------------------------- sampling

// Standard normal numbers from a seed: mulberry32, then Box and Muller's transform.
export function normalNumbers(seed) {
  let state = seed >>> 0;
  const uniform = () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return (((t ^ (t >>> 14)) >>> 0) + 0.5) / 4294967296;
  };
  return (count) => Float32Array.from({ length: count },
    () => Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform()));
}

// Walk from noise down the levels sigmas [N + 1] by DDIM; denoise(x, sigma) gives x0_hat, both Float32Array.
export async function sampleRound(denoise, noise, sigmas) {
  let x = Float32Array.from(noise, (value) => sigmas[0] * value);
  for (let k = 0; k + 1 < sigmas.length; k++) {
    const clean = await denoise(x, sigmas[k]), keep = sigmas[k + 1] / sigmas[k];
    x = x.map((value, i) => clean[i] + keep * (value - clean[i]));
  }
  return x;
}

// -------------------------------------------------------------------------------------------------------------- rotations

// Gram-Schmidt on six numbers at `at`: the three columns of a rotation.
function columns(values, at) {
  const unit = (a, b, c) => {
    const length = Math.sqrt(a * a + b * b + c * c + 1e-16);
    return [a / length, b / length, c / length];
  };
  const x = unit(values[at], values[at + 1], values[at + 2]);
  const along = x[0] * values[at + 3] + x[1] * values[at + 4] + x[2] * values[at + 5];
  const y = unit(values[at + 3] - along * x[0], values[at + 4] - along * x[1], values[at + 5] - along * x[2]);
  return [x, y, [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]];
}

const timesVector = (m, v) => [0, 1, 2].map((row) => m[0][row] * v[0] + m[1][row] * v[1] + m[2][row] * v[2]);
const times = (a, b) => b.map((column) => timesVector(a, column));
const transposed = (m) => [0, 1, 2].map((k) => m.map((column) => column[k]));

function matrixFromVector(v) {
  const angle = Math.hypot(...v);
  if (angle < 1e-12) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const [x, y, z] = v.map((value) => value / angle), s = Math.sin(angle), c = Math.cos(angle), d = 1 - c;
  return [[c + x * x * d, y * x * d + z * s, z * x * d - y * s], [x * y * d - z * s, c + y * y * d, z * y * d + x * s],
    [x * z * d + y * s, y * z * d - x * s, c + z * z * d]];
}

function vectorFromMatrix([a, b, c]) {
  const axis = [b[2] - c[1], c[0] - a[2], a[1] - b[0]]; // twice the sine times the axis
  const sine = Math.hypot(...axis), angle = Math.atan2(sine, a[0] + b[1] + c[2] - 1);
  if (sine > 1e-6 || angle < 1) return axis.map((value) => value * (sine > 1e-12 ? angle / sine : 0.5));
  // Half a turn: the axis is the longest column of the rotation plus one.
  const longest = [[a[0] + 1, a[1], a[2]], [b[0], b[1] + 1, b[2]], [c[0], c[1], c[2] + 1]]
    .sort((p, q) => Math.hypot(...q) - Math.hypot(...p))[0];
  return longest.map((value) => (angle * value) / Math.hypot(...longest));
}

export function orthonormalise(frame) {
  const clean = Float64Array.from(frame);
  for (let at = 3; at < clean.length; at += 6) {
    const [x, y] = columns(clean, at);
    clean.set([...x, ...y], at);
  }
  return clean;
}

// ---------------------------------------------------------------------------------------------------------- inertialisation

// An offset and its velocity, as they die away over `frames`: the quintic of rollout/blending.py at u.
function dyingWeights(k, frames) {
  const u = (k + 0.5) / frames, cube = u * u * u;
  return [1 + cube * (-10 + u * (15 - 6 * u)), frames * (u + cube * (-6 + u * (8 - 3 * u)))];
}

// What has to be added after a seam. `earlier` are the last three values before it, newest first; `later` the first three
// after it; between(a, b) is the step from a to b, add(step, value) takes it.
function seamOffset(earlier, later, between, add) {
  const [left, leftBefore] = [between(earlier[1], earlier[0]), between(earlier[2], earlier[1])];
  const [right, rightBefore] = [between(later[1], later[0]), between(later[2], later[1])];
  const half = (step) => step.map((value) => 0.5 * value);
  const offset = between(add(half(right), later[0]), add(half(left), earlier[0]));
  const velocity = left.map((value, i) => 2 * value - leftBefore[i] + 2 * right[i] - rightBefore[i]);
  return (k, frames) => {
    const [value, slope] = dyingWeights(k, frames);
    return offset.map((number, i) => value * number + slope * velocity[i]);
  };
}

// Inertialise the first `frames` frames of a window after its history; both lists of frames. A new list comes back.
export function blendSeam(history, window, frames) {
  if (frames === 0) return window;
  const blended = window.map((frame) => Float64Array.from(frame));
  const earlier = [1, 2, 3].map((k) => history[history.length - k]), later = window.slice(0, 3);
  const minus = (a, b) => b.map((value, i) => value - a[i]), plus = (a, b) => a.map((value, i) => value + b[i]);
  const root = (frame) => Array.from(frame.subarray(0, 3));
  const offset = seamOffset(earlier.map(root), later.map(root), minus, plus);
  for (let k = 0; k < frames; k++) blended[k].set(plus(offset(k, frames), root(window[k])), 0);
  const between = (a, b) => vectorFromMatrix(times(b, transposed(a))), add = (step, m) => times(matrixFromVector(step), m);
  for (let at = 3; at < window[0].length; at += 6) {
    const turns = (frame) => columns(frame, at);
    const turn = seamOffset(earlier.map(turns), later.map(turns), between, add);
    for (let k = 0; k < frames; k++) {
      const [x, y] = add(turn(k, frames), turns(window[k]));
      blended[k].set([...x, ...y], at);
    }
  }
  return blended;
}

// -------------------------------------------------------------------------------------------------------------- kinematics

// Joints, then tips, of a frame, and the joints' global rotations. A skeleton has parents, offsets, end_sites [[joint, offset]].
export function pose(skeleton, frame) {
  const joints = skeleton.parents.length, points = new Float64Array(3 * (joints + skeleton.end_sites.length)), turned = [];
  for (let joint = 0; joint < joints; joint++) {
    const parent = skeleton.parents[joint], own = columns(frame, 3 + 6 * joint);
    if (parent < 0) {
      turned.push(own);
      points.set(frame.subarray(0, 3), 0);
      continue;
    }
    const step = timesVector(turned[parent], skeleton.offsets[joint]);
    turned.push(times(turned[parent], own));
    points.set(step.map((value, i) => points[3 * parent + i] + value), 3 * joint);
  }
  skeleton.end_sites.forEach(([joint, offset], tip) => {
    const step = timesVector(turned[joint], offset);
    points.set(step.map((value, i) => points[3 * joint + i] + value), 3 * (joints + tip));
  });
  return { points, turned };
}

// Float64Array of 3 numbers a point, joints and then tips.
export const jointPositions = (skeleton, frame) => pose(skeleton, frame).points;

// -------------------------------------------------------------------------------------------------------- feet that stand

const RUN_OUT = 30, LET_GO = 12, PAUSE = 6, SLACK = 0.02, FARTHEST = 0.25, STRAIGHT = 0.985;

const add = (a, b) => a.map((value, i) => value + b[i]), subtract = (a, b) => a.map((value, i) => value - b[i]);
const scale = (a, factor) => a.map((value) => factor * value), dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scale(a, 1 / Math.max(Math.hypot(...a), 1e-12));

function shortestTurn(first, second) {
  const axis = cross(first, second);
  return matrixFromVector(scale(unit(axis), Math.atan2(Math.hypot(...axis), dot(first, second))));
}

// The axis of a knee's bend, as the thigh sees it; `across` goes from the right hip to the left one.
function kneeAxis(hip, knee, ankle, thighTurn, across) {
  const axis = cross(unit(subtract(knee, hip)), unit(subtract(ankle, knee)));
  return timesVector(transposed(thighTurn), add(axis, scale(across, 1e-3)));
}

// How long the line from hip to ankle may become: it yields from the first length on, to the second.
function legReach(hip, knee, ankle) {
  const length = Math.hypot(...subtract(knee, hip)) + Math.hypot(...subtract(ankle, knee));
  const before = Math.hypot(...subtract(ankle, hip));
  return [STRAIGHT, 0.9995].map((share) => Math.max(before, share * length));
}

// Rotations, to multiply from the left to those of thigh and shank, that bring the ankle to the end of `line` from the hip.
function bendLeg(hip, knee, ankle, usual, line, [near, far]) {
  const down = subtract(knee, hip), on = subtract(ankle, knee), thigh = unit(down), shank = unit(on);
  const upper = Math.hypot(...down), lower = Math.hypot(...on), wished = Math.hypot(...line), room = Math.max(far - near, 1e-9);
  const length = Math.min(wished, near) - room * Math.expm1(-Math.max(wished - near, 0) / room);
  const cosine = (length ** 2 - upper ** 2 - lower ** 2) / (2 * upper * lower);
  const angle = Math.acos(Math.min(Math.max(cosine, -1), 1));
  let axis = cross(thigh, shank);
  axis = add(axis, scale(usual, Math.max(0.03 - dot(axis, usual), 0)));
  axis = unit(subtract(axis, scale(thigh, dot(axis, thigh))));
  const bent = add(scale(thigh, Math.cos(angle)), scale(cross(axis, thigh), Math.sin(angle)));
  const hipTurn = shortestTurn(unit(add(scale(thigh, upper), scale(bent, lower))), unit(line));
  return [hipTurn, times(hipTurn, shortestTurn(shank, bent))];
}

// What is kept of the frames before, after a history whose feet stay as they are. legs: hip, knee, ankle, toe of left and right.
export function startFeet(skeleton, legs, history) {
  const toes = history.map((frame) => {
    const { points } = pose(skeleton, frame);
    return legs.map((leg) => Array.from(points.subarray(3 * leg[3], 3 * leg[3] + 3)));
  });
  const both = (make) => [0, 1].map(make), none = () => [0, 0, 0];
  let feet = {
    floor: Math.min(...toes.flat().map((toe) => toe[1])), locking: false, usual: 0, carries: both(() => false),
    pause: both(() => 0), anchor: both((k) => [toes[0][k][0], toes[0][k][2]]), shown: toes[0], pace: both(none), off: both(none),
    offPace: both(none), toe: toes[0], calm: both(() => 0), lowest: both((k) => toes[0][k][1]), axis: both(none),
  };
  for (const frame of history) ({ feet } = lockFrame(skeleton, legs, feet, frame, false));
  return feet;
}

// Settle the feet of one frame: {feet, frame}. What each step is for stands in tests/feet_oracle.py.
export function lockFrame(skeleton, legs, feet, frame, locking) {
  const { points, turned } = pose(skeleton, frame), both = (make) => [0, 1].map(make);
  const joints = legs.map((leg) => leg.map((joint) => Array.from(points.subarray(3 * joint, 3 * joint + 3))));
  const toe = joints.map((leg) => leg[3]);

  const velocity = both((k) => scale(subtract(toe[k], feet.toe[k]), FPS));
  const calm = both((k) => feet.calm[k] + 0.7 * (Math.hypot(velocity[k][0], velocity[k][2]) - feet.calm[k]));
  const usual = feet.usual + (Math.min(...calm) - feet.usual) / FPS;
  const lowest = both((k) => Math.min(toe[k][1], feet.lowest[k] + 0.03 / FPS));
  const above = both((k) => Math.max(toe[k][1] - Math.min(lowest[k], feet.floor + 0.04), 0));
  const unrest = both((k) => above[k] / 0.03 + calm[k] / Math.max(3 * usual, 0.45));
  const pause = both((k) => Math.max(feet.pause[k] - 1, 0));
  const carries = both((k) => {
    const [sure, share, height] = feet.carries[k] ? [1.0, 0.8, 0.08] : [0.8, 0.6, 0.06];
    return locking && pause[k] === 0 && (unrest[k] < sure || (unrest[k] < share * unrest[1 - k] && above[k] < height));
  });

  const kept = { floor: feet.floor, locking, usual, carries, pause, toe, calm, lowest, anchor: [], shown: [], pace: [], off: [], offPace: [], axis: [] };
  const settled = Float64Array.from(frame), across = subtract(joints[0][0], joints[1][0]);
  for (let k = 0; k < 2; k++) {
    const [hip, knee, ankle] = joints[k], [upper, lower, heel] = legs[k];
    const foot = subtract(toe[k], ankle), level = feet.floor + Math.max(foot[1], 0), reach = legReach(hip, knee, ankle);
    const going = add(feet.shown[k], scale(feet.pace[k], 1 / FPS));
    const anchor = carries[k] && !feet.carries[k]
      ? [going[0] + feet.pace[k][0] / RUN_OUT, going[2] + feet.pace[k][2] / RUN_OUT] : feet.anchor[k];
    const stand = [anchor[0], level, anchor[1]];
    if (carries[k]) {
      const away = Math.hypot(anchor[0] - toe[k][0], anchor[1] - toe[k][2]);
      if (away > FARTHEST || Math.hypot(...subtract(subtract(stand, foot), hip)) > reach[1] + SLACK) {
        carries[k] = false;
        pause[k] = PAUSE;
      }
    }
    const goal = carries[k] ? stand : [toe[k][0], locking ? Math.max(toe[k][1], level) : toe[k][1], toe[k][2]];
    const rate = carries[k] ? RUN_OUT : LET_GO, fade = Math.exp(-rate / FPS);
    const push = scale(add(feet.offPace[k], scale(feet.off[k], rate)), 1 / FPS);
    let off = scale(add(feet.off[k], push), fade), offPace = scale(subtract(feet.offPace[k], scale(push, rate)), fade);
    if (carries[k] !== feet.carries[k] || locking !== feet.locking) {
      off = subtract(going, goal);
      offPace = carries[k] ? feet.pace[k] : subtract(feet.pace[k], velocity[k]);
    }
    const shown = add(goal, off);
    if (locking) shown[1] = Math.max(shown[1], level);

    const axis = add(scale(feet.axis[k], 0.97), kneeAxis(hip, knee, ankle, turned[upper], across));
    const line = subtract(subtract(shown, foot), hip);
    const [thigh, shank] = bendLeg(hip, knee, ankle, timesVector(turned[upper], unit(axis)), line, reach);
    const frames = [turned[skeleton.parents[upper]], times(thigh, turned[upper]), times(shank, turned[lower]), turned[heel]];
    [upper, lower, heel].forEach((joint, i) => {
      const [x, y] = times(transposed(frames[i]), frames[i + 1]);
      settled.set([...x, ...y], 3 + 6 * joint);
    });
    const own = { anchor, shown, pace: scale(subtract(shown, feet.shown[k]), FPS), off, offPace, axis };
    for (const [name, value] of Object.entries(own)) kept[name][k] = value;
  }
  return { feet: kept, frame: settled };
}

// ---------------------------------------------------------------------------------------------------------------- characters

// World frames [H] of a stored pose whose last root lies at the origin, turned and moved.
export function placedPose(pose, x, z, yaw) {
  const c = Math.cos(yaw), s = Math.sin(yaw), last = pose[pose.length - 1];
  return pose.map((frame) => {
    const placed = Float64Array.from(frame);
    placed[0] -= last[0];
    placed[2] -= last[2];
    for (const at of [0, 3, 6]) {
      const [a, b] = [placed[at], placed[at + 2]];
      placed[at] = c * a + s * b;
      placed[at + 2] = c * b - s * a;
    }
    placed[0] += x;
    placed[2] += z;
    return placed;
  });
}

// A character under way: {history: list of H frames, target}.
export function startCharacter(pose, x, z, yaw) {
  const history = placedPose(pose, x, z, yaw), last = history[history.length - 1];
  const speed = (FPS * Math.hypot(last[0] - history[0][0], last[2] - history[0][2])) / (history.length - 1);
  return { history, target: { x: last[0], z: last[2], heading: yaw, turning: 0, speed } };
}

// Make the next `hop` frames of all characters in one round. card: normaliser, inputs' sizes; wishes: one a character;
// denoise(x, sigma, condition) with condition {history, path, style}, flat Float32Arrays of the batch. Returns per character
// {frames, window, path, history}: what to show, the whole window, the line ahead, and the history that it was made from.
export async function advance(card, characters, wishes, styles, denoise, noise, sigmas, hop, blendFrames) {
  const { mean, deviation, path_scale: pathScale } = card.normaliser, channels = mean.length, batch = characters.length;
  const window = card.window, kept = characters[0].history.length;
  const condition = {
    history: new Float32Array(batch * kept * channels),
    path: new Float32Array(batch * window * 8),
    style: Float32Array.from(styles.flatMap((weights) => Array.from(weights))),
  };
  const paths = characters.map(({ history, target }, b) => {
    const { path } = moveTarget(target, wishes[b], window), last = history[kept - 1];
    history.forEach((frame, h) => frame.forEach((value, c) => {
      const moved = value - (c === 0 ? last[0] : c === 2 ? last[2] : 0);
      condition.history[(b * kept + h) * channels + c] = (moved - mean[c]) / deviation[c];
    }));
    condition.path.set(pathCondition(path, target, last[0], last[2], pathScale), b * window * 8);
    return path;
  });
  const clean = await sampleRound((x, sigma) => denoise(x, sigma, condition), noise, sigmas);
  return characters.map((character, b) => {
    const { history } = character, last = history[kept - 1], made = [];
    for (let k = 0; k < window; k++) {
      const at = (b * window + k) * channels;
      const frame = Float64Array.from(clean.subarray(at, at + channels), (value, c) => value * deviation[c] + mean[c]);
      frame[0] += last[0];
      frame[2] += last[2];
      made.push(orthonormalise(frame));
    }
    const frames = blendSeam(history, made, blendFrames).slice(0, hop);
    character.history = [...history, ...frames].slice(-kept);
    character.target = moveTarget(character.target, wishes[b], hop).target;
    return { frames, window: made, path: paths[b], history };
  });
}
