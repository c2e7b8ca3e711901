// BVH files that are dropped on the page, by the rules of f3amd_lib/motion/bvh.py and plausible.py: tests/test_page_bvh.py holds
// both to one table of cases.
import { Quaternion, Vector3 } from "three";

const UNITS = { "centimetres": 0.01, "metres": 1, "millimetres": 0.001, "inches": 0.0254, "CMU's unit": 0.0254 / 0.45 };
const RATES = [24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 150, 200, 240];
const AXES = [new Vector3(1, 0, 0), new Vector3(0, 1, 0), new Vector3(0, 0, 1)];
const SIDE = new RegExp("([Ll]eft|LEFT|[Rr]ight|RIGHT|(?<![A-Za-z])[LRlr](?:(?![A-Za-z0-9])|" +
  "(?=[A-Z][A-Za-z])(?!OOT|OWER|IB|UMBAR)))(?!.*:)"); // motion/anatomy.py says why
const LIMB = /leg|thigh|knee|foot|ankle|arm|hand|wrist|elbow/i;
const NO_JOINT = /twist|roll|nub|_end$|effector|ik|pole/i;

const sideOf = (name) => ({ l: "left", r: "right" })[(name.match(SIDE) || [""])[0].charAt(0).toLowerCase()] || "middle";

// ------------------------------------------------------------------------------------------------------------- the text

const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
const WORD = /\s*([{}]|[^\s{}]+)/y;
const NAMED = /[ \t]+([^\n{}]+)\s*\{/y;
const STATEMENTS = {
  "HIERARCHY": /(?:)/y, "ROOT": NAMED, "JOINT": NAMED, "OFFSET": /\s+(\S+)\s+(\S+)\s+(\S+)/y, "}": /(?:)/y,
  "CHANNELS": /\s+(\d+)((?:\s+[xyz](?:position|rotation)\b)*)/iy,
  "END": /[^\n{}]*\s*\{\s*OFFSET\s+(\S+)\s+(\S+)\s+(\S+)\s*\}/iy,
};

function decoded(bytes) {
  if (bytes.includes(0)) throw new Error("it holds zero bytes: save it as UTF-8 text");
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(bytes);
  } catch {
    return new TextDecoder("latin1").decode(bytes);
  }
}

// { joints, tips, count, rate, columns, values }; a joint is { name, parent, offset, moves: [[axis, column]], turns: likewise }.
function parse(given) {
  const text = given.replace(/\r+\n|\r/g, "\n").replace(/^[ \t]*(#|\/\/|;).*$/gm, "");
  const [joints, tips, open, values] = [[], [], [], []];
  let [columns, place] = [0, 0];
  const fail = (what, at = place) => { throw new Error(`line ${text.slice(0, at).split("\n").length}: ${what}`); };
  const take = (pattern) => {
    pattern.lastIndex = place;
    const found = pattern.exec(text);
    if (found) place = pattern.lastIndex;
    return found;
  };
  const number = (word) => {
    const value = NUMBER.test(word) ? Number(word) : NaN;
    if (Math.abs(value) <= 1e8) return value;
    return fail(`"${word.slice(0, 40)}" is no finite number${/\d,\d/.test(word) ? "; write decimal points, not commas" : ""}`);
  };
  const vector = (words) => new Vector3(...words.slice(1, 4).map(number));

  if (!/^\s*HIERARCHY/i.test(text)) throw new Error("it does not begin with HIERARCHY, as BVH files do");
  for (;;) {
    const [, word] = take(WORD) || fail("the file ends without a MOTION line");
    const [keyword, at] = [word.toUpperCase(), place];
    if (keyword === "MOTION") break;
    const found = STATEMENTS[keyword] && take(STATEMENTS[keyword]);
    if (!found) fail(`"${word.slice(0, 40)}", or what follows it, is not expected here`);
    const joint = open[open.length - 1];
    if (keyword === "HIERARCHY") continue;
    if (keyword === "ROOT" && joints.length) fail("a second ROOT: a file holds one character, so split it", at);
    if (keyword !== "ROOT" && !joint) fail(`"${word}" stands outside of the ROOT's braces`);
    if (keyword === "ROOT" || keyword === "JOINT") {
      const name = found[1].trim().replace(/\s+/g, " ");
      if (joints.some((other) => other.name === name)) fail(`the joint name "${name}" is taken: rename one`, at);
      joints.push({ name, parent: joint, offset: new Vector3(), moves: [], turns: [] });
      open.push(joints[joints.length - 1]);
    } else if (keyword === "}") open.pop();
    else if (keyword === "OFFSET") joint.offset = vector(found);
    else if (keyword === "END") tips.push({ joint, offset: vector(found) });
    else {
      const labels = found[2].toLowerCase().split(/\s+/).slice(1);
      if (labels.length !== Number(found[1])) fail(`CHANNELS says ${found[1]} and lists ${labels.length}`);
      for (const label of labels) joint[label.endsWith("rotation") ? "turns" : "moves"].push(["xyz".indexOf(label[0]), columns++]);
    }
  }
  if (open.length) fail("MOTION starts, but a '{' is still open");
  if (!columns) fail("no joint has a channel");

  const [, told] = take(/\s*Frames\s*:?\s*(\S+)/iy) || fail("a line like 'Frames: 120' must follow");
  const count = number(told);
  if (!(Number.isInteger(count) && count > 0)) fail(`Frames: is ${told}, but must be a whole number above 0`);
  const [, seconds] = take(/\s*Frame\s*Time\s*:?\s*(\S+)/iy) || fail("a line like 'Frame Time: 0.0333333' must follow");
  if (!(number(seconds) >= 1e-5 && seconds <= 1)) fail("Frame Time: must be a positive number of seconds, 1 at most");
  for (let word = take(WORD); word; word = take(WORD)) {
    if (values.length === count * columns && !NUMBER.test(word[1])) break; // a note
    values.push(number(word[1]));
  }
  const rows = values.length / columns;
  if (rows !== count) throw new Error(`Frames: says ${count}, but ${+rows.toFixed(2)} rows of numbers follow`);
  return { joints, tips, count, rate: rateOf(seconds), columns, values };
}

// A rounded frame time stands for the usual rate that is written so: .033 is 30 frames a second.
function rateOf(word) {
  const digits = Math.min((word.split(".")[1] || "").length, 20);
  const apart = (rate) => Math.abs(1 / rate - word);
  const alike = RATES.filter((rate) => digits > 1 && (1 / rate).toFixed(digits) === Number(word).toFixed(digits));
  return alike.sort((one, other) => apart(one) - apart(other))[0] || 1 / word;
}

// ------------------------------------------------------------------------------------------------------------ the person

// Both legs as [hip, knee, ankle]: of limbs alike with three joints or more, the pair nearest to the root. None may be found.
function legsOf(names, parents, rest) {
  const ways = names.map((_, joint) => [joint]); // the longest one down from each joint
  const [reach, size, depth] = [names.map(() => 0), names.map(() => 1), []];
  parents.forEach((parent) => depth.push(parent < 0 ? 0 : depth[parent] + 1));
  for (let joint = names.length - 1; joint > 0; joint -= 1) {
    const parent = parents[joint];
    const far = rest[joint].distanceTo(rest[parent]) + reach[joint];
    size[parent] += size[joint];
    if (far > reach[parent]) [reach[parent], ways[parent]] = [far, [parent, ...ways[joint]]];
  }
  const chains = ways.map((way) => way.filter((joint) => !NO_JOINT.test(names[joint])));
  const bare = (joint) => names[joint].replace(SIDE, "");
  const alike = (one, other) => parents[one] === parents[other] && (bare(one) === bare(other) ||
    (size[one] === size[other] && Math.abs(reach[one] / reach[other] - 1) < 0.05));
  const known = ([one]) => Number(ways[one].some((joint) => LIMB.test(names[joint])));
  const limbs = names.map((_, joint) => joint).filter((joint) => joint && chains[joint].length > 2);
  const [legs] = limbs.flatMap((one) => limbs.filter((other) => other > one && alike(one, other)).map((other) => [one, other]))
    .sort((a, b) => known(b) - known(a) || depth[a[0]] - depth[b[0]]);
  // Thigh and shin are the first two bones in a row of about the greatest length.
  return (legs || []).map((top) => {
    const bones = chains[top].slice(1).map((joint, k) => rest[joint].distanceTo(rest[chains[top][k]]));
    const pairs = bones.slice(1).map((bone, k) => bone + bones[k]);
    const first = pairs.map((pair) => pair > 0.85 * Math.max(...pairs)).indexOf(true);
    return chains[top].slice(first, first + 3);
  });
}

// The name of a file's unit, which makes a person's of a leg, hip to ankle.
function unitOf(leg) {
  const fits = Object.keys(UNITS).filter((unit) => leg * UNITS[unit] > 0.45 && leg * UNITS[unit] < 1.25);
  const off = (unit) => (unit === "centimetres" ? 0 : Math.abs(Math.log(leg * UNITS[unit] / 0.82)));
  if (!fits.length) throw new Error(`its legs are ${leg.toPrecision(3)} units long, a person's in no unit known here`);
  return fits.sort((one, other) => off(one) - off(other))[0];
}

// ---------------------------------------------------------------------------------------------------------------- reader

// A file's skeleton as body.js has it, and its motion at `fps`: root in metres, turns as quaternions (x, y, z, w), +Y up, both
// flat, frame after frame; what had to be assumed is in `said`.
export function readBvh(bytes, fps) {
  const { joints, tips, count, rate, columns, values } = parse(decoded(bytes));
  // Positions replace OFFSET; below the root their mean is the bone, unless all are zero.
  const placeAt = ({ offset, moves }, frame) => moves.reduce(
    (place, [axis, column]) => place.setComponent(axis, values[frame * columns + column]), offset.clone());
  const turnAt = ({ turns }, frame) => turns.reduce((turn, [axis, column]) => turn.multiply(
    new Quaternion().setFromAxisAngle(AXES[axis], values[frame * columns + column] * Math.PI / 180)), new Quaternion());
  // A first joint that moves an only child which moves as well carries it, and is no joint.
  const [root, child] = joints;
  const carries = child && root.moves.length && child.moves.length && joints.filter(({ parent }) => parent === root).length === 1;
  if (carries) joints.shift();
  const poseAt = (frame) => {
    const [place, turns] = [placeAt(joints[0], frame), joints.map((joint) => turnAt(joint, frame))];
    if (carries) {
      turns[0].premultiply(turnAt(root, frame));
      place.applyQuaternion(turnAt(root, frame)).add(placeAt(root, frame));
    }
    return { place, turns };
  };
  const every = Array.from({ length: count }, (_, frame) => frame);
  let wander = 0; // of bones that do not keep their length
  const offsets = joints.map((joint, k) => {
    if (!k) return new Vector3();
    if (!every.some((frame) => joint.moves.some(([, column]) => values[frame * columns + column]))) return joint.offset;
    const places = every.map((frame) => placeAt(joint, frame));
    const mean = places.reduce((sum, place) => sum.addScaledVector(place, 1 / count), new Vector3());
    wander = places.reduce((most, place) => Math.max(most, ...place.sub(mean).toArray().map(Math.abs)), wander);
    return mean;
  });
  const [names, parents] = [joints.map(({ name }) => name), joints.map(({ parent }) => joints.indexOf(parent))];
  const fromRoot = (turns, joint) => {
    const way = new Vector3();
    for (let at = joint; at > 0; at = parents[at]) way.add(offsets[at]).applyQuaternion(turns[parents[at]]);
    return way;
  };
  const still = names.map(() => new Quaternion());
  const rest = names.map((_, joint) => fromRoot(still, joint));
  const legs = legsOf(names, parents, rest);
  const upOf = (turns) => legs.reduce(
    (sum, [hip, , ankle]) => sum.add(fromRoot(turns, hip)).sub(fromRoot(turns, ankle)), new Vector3());

  const unit = legs.length ? unitOf(rest[legs[0][0]].distanceTo(rest[legs[0][1]]) + rest[legs[0][1]].distanceTo(rest[legs[0][2]]))
    : "centimetres";
  const scale = UNITS[unit];
  const wandered = `bones change by up to ${(1000 * wander * scale).toFixed(1)} mm`;
  if (wander * scale > 5e-3) throw new Error(`${wandered}: bake the motion to rotations before exporting`);
  const frames = Math.floor((count - 1) / rate * fps + 1e-6) + 1;
  const [moved, turned] = [new Float32Array(3 * frames), new Float32Array(4 * frames * joints.length)];
  const up = new Vector3(); // from ankles to hips, all frames together
  for (let frame = 0; frame < frames; frame += 1) {
    const time = frame / fps * rate;
    const low = Math.min(Math.floor(time + 1e-6), count - 1);
    const [share, one] = [Math.max(time - low, 0), poseAt(low)];
    const other = share > 1e-6 && low < count - 1 ? poseAt(low + 1) : one;
    up.add(upOf(one.turns));
    one.place.lerp(other.place, share).multiplyScalar(scale).toArray(moved, 3 * frame);
    one.turns.forEach((turn, joint) => turn.slerp(other.turns[joint], share).toArray(turned, 4 * (frame * joints.length + joint)));
  }
  const alongZ = ({ x, y, z }) => Math.abs(z) > Math.max(Math.abs(x), Math.abs(y));
  const zUp = alongZ(upOf(still)) && alongZ(up) && up.z > 0;
  const upright = (numbers, stride = 3) => {
    for (let k = 0; zUp && k < numbers.length; k += stride) [numbers[k + 1], numbers[k + 2]] = [numbers[k + 2], -numbers[k + 1]];
    return numbers;
  };
  const metres = (vector) => upright(vector.clone().multiplyScalar(scale).toArray());
  const bones = [...offsets.map((offset, k) => [parents[k], metres(offset), sideOf(names[k])]).slice(1),
    ...tips.map(({ joint, offset }) => [joints.indexOf(joint), metres(offset), sideOf(joint.name)])];
  return {
    names, parents, offsets: offsets.map(metres), sides: names.map(sideOf), frames,
    bones: bones.filter(([from, end]) => from >= 0 && Math.hypot(...end) > 1e-6),
    root: upright(moved), turns: upright(turned, 4),
    said: [
      ...(legs.length ? [] : ["no two legs were found, so it is read in centimetres with Y up"]),
      ...(unit === "centimetres" ? [] : [`read in ${unit}, by the length of its legs`]),
      ...(zUp ? ["read with Z up"] : []),
      ...(wander * scale > 1e-3 ? [`${wandered}, each is as long as on average`] : []),
    ],
  };
}
