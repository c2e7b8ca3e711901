// The motion player. What the data mean stands in player.py.
import {
  AnimationClip, BufferAttribute, BufferGeometry, CircleGeometry, GLTFExporter, Group, InstancedMesh, Matrix4, Mesh,
  MeshBasicMaterial, OrbitControls, PerspectiveCamera, Quaternion, QuaternionKeyframeTrack, RingGeometry, Spherical, Vector3,
  VectorKeyframeTrack,
} from "three";
import { Bodies, Figure, Sticks, bodyGeometry, bodyMaterial, paintBody, plainCapsules } from "body";
import { readBvh } from "bvh";
import { Stage } from "scene";

const data = JSON.parse(document.getElementById("player-data").textContent);
const byId = (id) => document.getElementById(id);
const embedded = window.parent !== window;
const HOLD = 0.7; // seconds to rest on the last frame before it starts again
const HEIGHT = 0.88; // metres above the floor that the camera looks at
const FARTHEST = 42; // metres, from where a person has a twelfth of the height: of a large crowd one sees the middle first
const FILL = { height: 2.35, width: 1.9 }; // metres around one person
const CROWD = 12; // more than so many need not be drawn as well
const LARGEST = 50e6; // bytes of a file that is dropped here
const colors = {};
const characters = []; // of all scenes
let panels = [];
let numFrames = data.frames;

// ---------------------------------------------------------------- data

async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Undo the byte planes and the differences; the answer lies frame by frame.
function readTrack(bytes, offset, channels, Numbers) {
  const count = channels * data.frames;
  const size = Numbers.BYTES_PER_ELEMENT;
  const track = new Numbers(count);
  let place = 0;
  for (let channel = 0; channel < channels; channel += 1) {
    let value = 0;
    for (let frame = 0; frame < data.frames; frame += 1, place += 1) {
      let step = 0;
      for (let plane = 0; plane < size; plane += 1) step |= bytes[offset + plane * count + place] << (8 * plane);
      value = (value + step) | 0;
      track[frame * channels + channel] = value; // wraps to the type's range
    }
  }
  return { track, next: offset + count * size };
}

// Rotation vectors become quaternions.
function quaternions(track) {
  const turns = new Float32Array(track.length / 3 * 4);
  for (let k = 0; k < track.length / 3; k += 1) {
    const [x, y, z] = track.subarray(3 * k, 3 * k + 3);
    const angle = Math.hypot(x, y, z) / data.turns;
    const share = angle ? Math.sin(angle / 2) / (angle * data.turns) : 0;
    turns.set([x * share, y * share, z * share, Math.cos(angle / 2)], 4 * k);
  }
  return turns;
}

function unpack(bytes) {
  let offset = 0;
  const take = (channels, Numbers) => {
    const { track, next } = readTrack(bytes, offset, channels, Numbers);
    offset = next;
    return track;
  };
  const metres = (track) => Float32Array.from(track, (value) => 0.001 * value);
  for (const scene of data.scenes) {
    for (const character of scene.characters) {
      const skeleton = data.skeletons[character.skeleton];
      character.frames = data.frames;
      character.root = metres(take(3, Int32Array));
      character.turns = quaternions(take(3 * skeleton.names.length, Int16Array));
      character.touch = character.contacts ? take(1, Uint8Array) : null;
      character.target = character.path ? metres(take(2, Int32Array)) : null;
    }
  }
  if (offset !== bytes.length) throw new Error("the motion data are damaged");
}

// ---------------------------------------------------------------- characters

const rootNow = [0, 0, 0];
let turnsNow = new Float32Array(0);

// Put a character's bones where they are at a time, in frames.
function pose(character, time) {
  const last = character.frames - 1;
  const frame = Math.min(Math.floor(time), last);
  const next = Math.min(frame + 1, last);
  const share = Math.min(time, last) - frame;
  const joints = character.figure.bones.length;
  if (turnsNow.length !== 4 * joints) turnsNow = new Float32Array(4 * joints);
  for (let axis = 0; axis < 3; axis += 1) {
    const value = character.root[3 * frame + axis];
    rootNow[axis] = value + share * (character.root[3 * next + axis] - value);
  }
  const [one, other] = [4 * joints * frame, 4 * joints * next];
  for (let k = 0; k < 4 * joints; k += 4) {
    Quaternion.slerpFlat(turnsNow, k, character.turns, one + k, character.turns, other + k, share);
  }
  character.figure.pose(rootNow, turnsNow);
}

// A flat band over the floor through points [x, z, x, z, ...]; dashed, if a length is given.
function ribbon(points, width, height, dash = 0) {
  const count = points.length / 2;
  const corners = new Float32Array(6 * count);
  const faces = [];
  let walked = 0;
  for (let k = 0; k < count; k += 1) {
    const [a, b] = [Math.max(k - 1, 0), Math.min(k + 1, count - 1)];
    const dx = points[2 * b] - points[2 * a];
    const dz = points[2 * b + 1] - points[2 * a + 1];
    const scale = 0.5 * width / Math.max(Math.hypot(dx, dz), 1e-6);
    corners.set([points[2 * k] + dz * scale, height, points[2 * k + 1] - dx * scale,
      points[2 * k] - dz * scale, height, points[2 * k + 1] + dx * scale], 6 * k);
    if (k === 0) continue;
    walked += Math.hypot(points[2 * k] - points[2 * k - 2], points[2 * k + 1] - points[2 * k - 1]);
    const [left, right] = [2 * k - 2, 2 * k];
    if (!dash || walked % dash < 0.6 * dash) faces.push(left, right, left + 1, left + 1, right, right + 1);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(corners, 3));
  geometry.setIndex(faces);
  return geometry;
}

const overFloor = (layer) => new MeshBasicMaterial(
  { side: 2, polygonOffset: true, polygonOffsetFactor: -1 - layer, polygonOffsetUnits: -layer });
const geometries = new Map();

// Give a character its bones, body, target path and trail in a panel.
function enter(character, panel) {
  const skeleton = data.skeletons[character.skeleton];
  const key = `${character.skeleton} ${character.color}`;
  if (!geometries.has(key)) geometries.set(key, { geometry: bodyGeometry(skeleton), color: character.color });
  const { geometry } = geometries.get(key);
  paintBody(geometry, colors, character.color);
  const material = character.ghost ? ghostMaterial : fleshMaterial;
  character.figure = Object.assign(new Figure(skeleton, geometry, material), { color: character.color });
  character.panel = panel;
  const { scene } = panel.view;
  if (character.ghost || !panel.many) scene.add(character.figure.mesh); // those of a crowd are drawn together
  if (character.ghost) {
    character.figure.mesh.castShadow = false;
    return;
  }
  const wide = panel.many ? 0.015 : 0.03;
  const walked = [];
  for (let frame = 0; frame < character.frames; frame += 1) {
    walked.push(character.root[3 * frame], character.root[3 * frame + 2]);
  }
  character.trail = new Mesh(ribbon(walked, wide, 0.004), overFloor(1));
  character.trail.frustumCulled = false;
  scene.add(character.trail);
  if (character.target) {
    character.asked = new Mesh(ribbon(character.target, wide, 0.003, panel.many ? 0 : 0.25), overFloor(0));
    scene.add(character.asked);
    character.goal = new Mesh(new RingGeometry(0.1, 0.125, 32).rotateX(-Math.PI / 2), overFloor(2));
    if (!panel.many) scene.add(character.goal);
  }
}

const fleshMaterial = bodyMaterial();
const ghostMaterial = bodyMaterial({ transparent: true, opacity: 0.32, depthWrite: false });

const real = (panel) => panel.scene.characters.filter((one) => !one.ghost);

// Sticks and contact marks of a panel, and the bodies of a crowd, made anew when somebody enters.
function gather(panel) {
  const { scene } = panel.view;
  if (panel.sticks) scene.remove(panel.sticks.rods, panel.sticks.heads, panel.marks);
  if (panel.bodies) scene.remove(panel.bodies.group);
  panel.bodies = panel.many ? new Bodies(real(panel).map(({ figure }) => figure)) : null;
  if (panel.bodies) scene.add(panel.bodies.group);
  panel.sticks = new Sticks(real(panel).map(({ figure }) => figure), panel.many ? 0.03 : 0.022, panel.many);
  panel.marks = new InstancedMesh(new CircleGeometry(0.085, panel.many ? 8 : 24).rotateX(-Math.PI / 2), overFloor(3), 2 * real(panel).length);
  panel.marks.frustumCulled = false;
  scene.add(panel.sticks.rods, panel.sticks.heads, panel.marks);
}

const blank = new Matrix4().makeScale(0, 0, 0);
const spot = new Matrix4();
const place = new Vector3();

function markContacts(panel, frame) {
  real(panel).forEach((character, k) => {
    const { toes } = data.skeletons[character.skeleton];
    for (let foot = 0; foot < 2; foot += 1) {
      const down = character.touch && toes && character.touch[Math.min(frame, character.frames - 1)] & (1 << foot);
      if (down) {
        character.figure.joint(toes[foot], place);
        spot.makeTranslation(place.x, 0.006, place.z);
      }
      panel.marks.setMatrixAt(2 * k + foot, down ? spot : blank);
    }
  });
  panel.marks.instanceMatrix.needsUpdate = true;
}

function readColors() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["left", "right", "middle", "flesh", "contact", "target", "trail", "panel", "floor", "grid"]) {
    colors[name] = style.getPropertyValue("--" + name).trim();
  }
  colors.dark = matchMedia("(prefers-color-scheme: dark)").matches;
  for (const { geometry, color } of geometries.values()) paintBody(geometry, colors, color);
  for (const panel of panels) {
    panel.view.paint(colors);
    panel.sticks.paint(colors);
    panel.bodies?.paint(colors);
    panel.marks.material.color.set(colors.contact);
    for (const { trail, asked, goal, color } of panel.scene.characters) {
      if (trail) trail.material.color.set(color || colors.trail);
      if (asked) asked.material.color.set(colors.target);
      if (goal) goal.material.color.set(colors.target);
    }
  }
}

// ---------------------------------------------------------------- the camera

const eye = new PerspectiveCamera(30, 1, 0.05, 600); // one for all panels: what is compared is seen alike
const stageElement = byId("stage");
const offset = new Vector3();
const round = new Spherical();
let controls = null;
let base = 1; // metres to what is looked at, at zoom 1
let following = data.follow;
let above = false;
let sideBefore = null; // where the camera stood until it went up

function whereFrom() {
  offset.copy(eye.position).sub(controls.target);
  return round.setFromVector3(offset);
}

function standAt(around, elevation, zoom) {
  const polar = Math.min(Math.max(Math.PI / 2 - elevation, controls.minPolarAngle), controls.maxPolarAngle);
  offset.setFromSpherical(round.set(base / Math.min(Math.max(zoom, 0.2), 20), polar, around));
  eye.position.copy(controls.target).add(offset);
  controls.update();
  request();
}

function view() {
  const { radius, phi, theta } = whereFrom();
  const { x, z } = controls.target;
  return { around: theta, elevation: Math.PI / 2 - phi, zoom: base / radius, panX: x, panZ: z, follow: following, top: above };
}

const zoomBy = (factor) => { const now = view(); standAt(now.around, now.elevation, now.zoom * factor); };

function orbit(around, elevation) {
  const now = view();
  if (elevation && above) setTop(false);
  standAt(now.around + around, now.elevation + elevation, now.zoom);
}

// A tenth of the panel to the reader's right, or ahead over the floor.
function moveView(right, forward) {
  const { around, zoom } = view();
  const step = 0.1 * FILL.height * base / (near() * zoom);
  const move = new Vector3(right * Math.cos(around) - forward * Math.sin(around), 0,
    -right * Math.sin(around) - forward * Math.cos(around)).multiplyScalar(step);
  controls.target.add(move);
  eye.position.add(move);
  controls.update();
  request();
}

// A root track smoothed over half a second, so that steps do not shake the camera.
function smoothRoot(character) {
  const { root, frames } = character;
  const half = Math.max(1, Math.round(0.25 * data.fps));
  let track = Float32Array.from({ length: 2 * frames }, (_, k) => root[3 * (k >> 1) + 2 * (k & 1)]);
  for (let pass = 0; pass < 2; pass += 1) {
    const before = track;
    track = before.map((_, place) => {
      let sum = 0;
      for (let k = -half; k <= half; k += 1) {
        sum += before[2 * Math.min(Math.max((place >> 1) + k, 0), frames - 1) + (place & 1)];
      }
      return sum / (2 * half + 1);
    });
  }
  return track;
}

function boundsOf(panel) {
  const box = [Infinity, -Infinity, Infinity, -Infinity];
  const places = []; // twice a second
  const stretch = (x, z, frame) => {
    if (frame % 15 === 0) places.push([x, z]);
    [box[0], box[1]] = [Math.min(box[0], x), Math.max(box[1], x)];
    [box[2], box[3]] = [Math.min(box[2], z), Math.max(box[3], z)];
  };
  for (const { root, target } of panel.scene.characters) {
    for (let k = 0; k < root.length; k += 3) stretch(root[k], root[k + 2], k / 3);
    for (let k = 0; target && k < target.length; k += 2) stretch(target[k], target[k + 1], k / 2);
  }
  panel.middle = new Vector3((box[0] + box[1]) / 2, HEIGHT, (box[2] + box[3]) / 2);
  panel.reach = Math.hypot(box[1] - box[0], box[3] - box[2]) / 2;
  panel.corners = places.flatMap(([x, z]) =>
    [-0.4, 0.4].flatMap((side) => [0, 1.8].map((y) => new Vector3(x + side, y, z + side))));
}

// From where one person fills the smallest panel.
function near() {
  const half = Math.tan(Math.PI / 12);
  const tall = FILL.height / 2 / half;
  return Math.max(tall, ...panels.map(({ view: { camera } }) => FILL.width / 2 / half / camera.aspect));
}

function allSeen(panel, distance) {
  panel.view.aim(panel.middle, whereFrom() && offset.setLength(distance));
  const top = 1 - 2.2 * panel.caption / Math.max(panel.view.box[3], 1);
  return panel.corners.every((corner) => {
    const seen = place.copy(corner).project(panel.view.camera);
    return seen.z < 1 && Math.abs(seen.x) < 0.96 && seen.y > -0.96 && seen.y < Math.max(top, 0.4);
  });
}

function fitDistance() {
  const { around, elevation, zoom } = view();
  base = near();
  if (!following) {
    for (const panel of panels) while (base < FARTHEST && !allSeen(panel, base)) base *= 1.05;
  }
  for (const panel of panels) {
    const reach = following ? 4 : panel.reach + 2;
    panel.view.light(Math.min(Math.max(reach, 3), 14));
    panel.view.floor.material.uniforms.step.value = gridStep();
  }
  controls.minDistance = base / 20;
  controls.maxDistance = 5 * base;
  standAt(around, elevation, zoom);
}

const gridStep = () => (!following && panels.some((panel) => panel.reach > 14) ? 5 : 1);

const goal = new Vector3();

function lookAt(panel, frame, share) {
  goal.copy(panel.middle);
  if (following) {
    const track = panel.follows.center || (panel.follows.center = smoothRoot(panel.follows));
    const last = panel.follows.frames - 1;
    const [one, other] = [Math.min(frame, last), Math.min(frame + 1, last)];
    goal.x = track[2 * one] + share * (track[2 * other] - track[2 * one]);
    goal.z = track[2 * one + 1] + share * (track[2 * other + 1] - track[2 * one + 1]);
  }
  goal.add(controls.target);
  whereFrom();
  panel.view.aim(goal, offset);
}

// ---------------------------------------------------------------- drawing

const stats = { draws: 0, drawMs: 0 };
const clock = { time: 0, held: 0, playing: false, speed: 1, before: 0, scrubbing: false, from: 0, to: numFrames - 1 };
const show = { body: true, names: false, ghost: true };
let stage = null;
let requested = false;

function draw() {
  const began = performance.now();
  const frame = Math.min(Math.floor(clock.time), numFrames - 1);
  const share = clock.time - frame;
  for (const panel of panels) {
    for (const character of panel.scene.characters) {
      pose(character, clock.time);
      const { figure, trail, goal: ring, target } = character;
      figure.shown = character.ghost ? show.ghost : true;
      figure.mesh.visible = character.ghost ? show.ghost : show.body;
      if (trail) trail.geometry.setDrawRange(0, 6 * Math.min(frame, character.frames - 1));
      if (target) ring.position.set(target[2 * frame], 0.005, target[2 * frame + 1]);
    }
    panel.sticks.rods.visible = panel.sticks.heads.visible = !show.body;
    if (!show.body) panel.sticks.update();
    if (panel.bodies) {
      panel.bodies.group.visible = show.body;
      if (show.body) panel.bodies.update();
    }
    markContacts(panel, frame);
    lookAt(panel, frame, share);
    panel.view.scene.updateMatrixWorld();
    nameJoints(panel);
  }
  stage.draw();
  stats.draws += 1;
  stats.drawMs += performance.now() - began;
}

function nameJoints(panel) {
  const { figure } = panel.follows;
  const { names } = figure.skeleton;
  while (panel.labels.childElementCount > (show.names ? names.length : 0)) panel.labels.lastChild.remove();
  if (!show.names) return;
  while (panel.labels.childElementCount < names.length) panel.labels.append(document.createElement("span"));
  names.forEach((name, joint) => {
    const label = panel.labels.children[joint];
    const seen = panel.view.onPanel(figure.joint(joint, place), panel.view.box[2], panel.view.box[3]);
    label.hidden = !seen;
    if (label.textContent !== name) label.textContent = name;
    if (seen) label.style.transform = `translate(${seen[0].toFixed(1)}px, ${seen[1].toFixed(1)}px)`;
  });
}

// ---------------------------------------------------------------- time

const scrub = byId("scrub");
let spoken = "";
let boundaries = [];

const windowAt = (frame) => 1 + boundaries.filter((boundary) => frame >= boundary).length;

function showTime(exact) {
  const last = numFrames - 1;
  const frame = Math.min(Math.round(clock.time), last);
  const [now, end] = [frame, last].map((value) => (value / data.fps).toFixed(1));
  if (!clock.scrubbing) scrub.value = String(frame);
  byId("clock").textContent = `${now} / ${end} s, frame ${frame + 1} / ${numFrames}`;
  let text = `${now} of ${end} seconds`;
  if (boundaries.length) text += `, window ${windowAt(frame)} of ${boundaries.length + 1}`;
  if (exact) text += `, frame ${frame + 1} of ${numFrames}`;
  if (text !== spoken) {
    spoken = text;
    scrub.setAttribute("aria-valuetext", text);
  }
}

function tick(now) {
  requested = false;
  if (clock.playing) {
    const passed = Math.max(Math.min((now - clock.before) / 1000, 0.25), 0) * clock.speed;
    clock.before = now;
    if (!clock.scrubbing) {
      clock.time += passed * data.fps;
      if (clock.time >= clock.to) {
        clock.time = clock.to;
        clock.held += passed;
        if (clock.held > HOLD || clock.to < numFrames - 1) seekTo(clock.from);
      }
    }
  }
  draw();
  showTime(!clock.playing);
  if (clock.playing) request();
}

function request() {
  if (requested || !stage) return;
  requested = true;
  requestAnimationFrame(tick);
}

function seekTo(frame) {
  clock.time = Math.min(Math.max(Math.round(frame), 0), numFrames - 1);
  clock.held = 0;
}

const seek = (frame) => { seekTo(frame); request(); };

function setPlaying(playing) {
  if (playing && clock.time >= clock.to) seekTo(clock.from);
  if (!playing) clock.time = Math.round(clock.time); // rest on a frame, not between two
  clock.playing = playing && numFrames > 1;
  clock.before = performance.now();
  byId("play").setAttribute("aria-label", clock.playing ? "Pause" : "Play");
  document.body.classList.toggle("playing", clock.playing);
  request();
}

const stepBy = (frames) => { setPlaying(false); seek(clock.time + frames); };

const speeds = Array.from(byId("speed").options, (option) => Number(option.value));

function setSpeed(speed) {
  clock.speed = speed;
  byId("speed").value = String(speed);
}

function faster(by) {
  setSpeed(speeds[Math.min(Math.max(speeds.indexOf(clock.speed) + by, 0), speeds.length - 1)]);
}

// Play from one frame to another only.
function setLoop(from, to) {
  [clock.from, clock.to] = [Math.min(from, to), Math.max(from, to)];
  if (clock.from === clock.to) [clock.from, clock.to] = [0, numFrames - 1];
  byId("loop-all").disabled = clock.from === 0 && clock.to === numFrames - 1;
  drawTimeline();
  request();
}

// When whose feet stand, under the scrubber: left above, right below, and what is looped.
function drawTimeline() {
  const canvas = byId("timeline");
  const { width, height } = canvas.getBoundingClientRect();
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [Math.max(1, width * ratio), Math.max(1, height * ratio)];
  const context = canvas.getContext("2d");
  const { touch, frames } = panels[0].follows;
  const wide = canvas.width / Math.max(numFrames - 1, 1);
  for (let frame = 0; touch && frame < frames; frame += 1) {
    for (const [foot, side] of [[0, "left"], [1, "right"]]) {
      if (!(touch[frame] & (1 << foot))) continue;
      context.fillStyle = colors[side];
      context.fillRect((frame - 0.5) * wide, (0.1 + 0.5 * foot) * canvas.height, wide + 0.5, 0.35 * canvas.height);
    }
  }
  byId("looped").style.left = `${100 * clock.from / Math.max(numFrames - 1, 1)}%`;
  byId("looped").style.right = `${100 - 100 * clock.to / Math.max(numFrames - 1, 1)}%`;
}

// ---------------------------------------------------------------- what is shown

const press = (id, on) => byId(id).setAttribute("aria-pressed", String(on));

// From above, +Z is up the page and +X to the left, as in the film strips' plans.
function setTop(top) {
  const now = view();
  if (top === above) return;
  above = top;
  press("top", top);
  controls.minPolarAngle = top ? 0 : 0.02;
  if (top) sideBefore = now;
  const [around, elevation] = top ? [Math.PI, 1.5707] : [sideBefore.around, sideBefore.elevation];
  standAt(around, elevation, now.zoom);
  fitDistance();
}

function setFollow(follow) {
  following = follow;
  eye.position.sub(controls.target);
  controls.target.set(0, 0, 0);
  press("follow", follow);
  byId("grid-key").textContent = `grid ${gridStep()} m`;
  fitDistance();
}

function followPerson(character) {
  character.panel.follows = character;
  byId("person").value = String(characters.indexOf(character));
  drawTimeline();
  setFollow(true);
}

function setBody(body) {
  show.body = body;
  press("sticks", !body);
  say("");
  request();
}

function setNames(names) {
  show.names = names;
  press("names", names);
  request();
}

function setGhost(ghost) {
  show.ghost = ghost;
  press("ghost", ghost);
  request();
}

function resetView() {
  if (above) setTop(false);
  standAt(data.around, panels.some((panel) => panel.many || real(panel).length > 3) ? 0.5 : 0.24, 1);
  setFollow(data.follow);
  standAt(data.around, view().elevation, 1);
}

// Columns that leave the panels as large as they can be.
function arrange() {
  const box = stageElement.getBoundingClientRect();
  let [best, most] = [1, 0];
  for (let columns = 1; columns <= panels.length; columns += 1) {
    const rows = Math.ceil(panels.length / columns);
    const size = Math.min(box.width / columns / FILL.width, (box.height / rows - 44) / FILL.height);
    if (size > most * 1.02) [best, most] = [columns, size];
  }
  stageElement.style.gridTemplateColumns = `repeat(${best}, minmax(0, 1fr))`;
  stageElement.style.gridAutoRows = "minmax(0, 1fr)";
}

function measure() {
  arrange();
  stage.resize();
  const tallest = Math.max(...panels.map(({ element }) => element.querySelector("figcaption").offsetHeight));
  for (const panel of panels) panel.caption = tallest;
  fitDistance();
  drawTimeline();
  draw(); // at once: a resized canvas is blank
}

// What is too slow here goes: first shadows, then bodies. One person keeps a body as long as can be; of a crowd nobody
// gets one where there is no graphics card.
function chooseBody() {
  const crowd = characters.length > CROWD;
  const back = "The button Sticks brings bodies back.";
  if (crowd && stage.software) {
    stage.castShadows(false);
    setBody(false);
    say(`Drawn as sticks: this browser draws without a graphics card, too slowly for ${characters.length} bodies. ${back}`);
    return;
  }
  show.body = true;
  draw();
  stats.bodyMs = stage.cost();
  if (stats.bodyMs <= (crowd ? 1000 / 60 : 50)) return;
  stage.castShadows(false);
  stats.bodyMs = stage.cost();
  if (stats.bodyMs <= (crowd ? 1000 / 60 : 250)) {
    say("Drawn without shadows, which would take too long here.");
    return;
  }
  setBody(false);
  say(`Drawn as sticks: a picture with bodies takes ${stats.bodyMs.toFixed(0)} ms here. ${back}`);
}

// ---------------------------------------------------------------- files in and out

// A BVH file becomes a character of the first panel.
function takeBvh(bytes, name) {
  const { root, turns, frames, said, ...read } = readBvh(bytes, data.fps);
  const known = data.skeletons.find(({ names }) => names.join() === read.names.join());
  const { capsules, head, toes } = known || { capsules: plainCapsules(read), head: null, toes: null };
  const skeleton = data.skeletons.push({ ...read, capsules, head, toes }) - 1;
  const character = { skeleton, color: null, name, frames, touch: null, target: null, root, turns };
  // Beside where the first one starts, each a metre further.
  const [first] = panels[0].scene.characters;
  panels[0].guests = (panels[0].guests || 0) + 1;
  const shift = [0, 2].map((axis) => first.root[axis] - character.root[axis] + (axis ? 0 : panels[0].guests));
  for (let k = 0; k < character.root.length; k += 3) {
    character.root[k] += shift[0];
    character.root[k + 2] += shift[1];
  }
  panels[0].scene.characters.push(character);
  characters.push(character);
  const whole = clock.to === numFrames - 1;
  numFrames = Math.max(numFrames, frames);
  scrub.max = String(numFrames - 1);
  enter(character, panels[0]);
  gather(panels[0]);
  boundsOf(panels[0]);
  readColors();
  listPeople();
  setLoop(clock.from, whole ? numFrames - 1 : clock.to);
  fitDistance();
  said.unshift(`${name}: ${read.names.length} joints, ${frames} frames at ${+data.fps.toFixed(2)} a second`);
  if (!known) said.push("another skeleton than the page's, so its body is a plain one");
  say(`${said.join("; ")}.`);
}

function say(text) {
  byId("notice").textContent = text;
  byId("notice").hidden = !text;
}

async function takeFile(file) {
  try {
    if (!/\.bvh$/i.test(file.name)) throw new Error("only BVH files can be dropped here");
    if (file.size > LARGEST) throw new Error(`it has ${Math.ceil(file.size / 1e6)} MB, and this page takes ${LARGEST / 1e6} at most`);
    takeBvh(new Uint8Array(await file.arrayBuffer()), file.name.replace(/\.bvh$/i, ""));
  } catch (error) {
    say(`${file.name} cannot be shown: ${error.message}.`);
  }
}

// ZXY angles, in degrees, of a quaternion: R = Rz Rx Ry.
function degreesOf(turns, k) {
  const [x, y, z, w] = turns.subarray(k, k + 4);
  const sine = Math.min(Math.max(2 * (y * z + w * x), -1), 1);
  return [Math.atan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)), Math.asin(sine),
    Math.atan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))].map((angle) => angle * 180 / Math.PI);
}

function bvhText(character) {
  const { names, parents, offsets, bones } = data.skeletons[character.skeleton];
  const lines = ["HIERARCHY"];
  const order = [];
  const number = (value) => value.toFixed(6);
  const add = (joint, depth) => {
    order.push(joint);
    const [outer, inner] = ["\t".repeat(depth), "\t".repeat(depth + 1)];
    lines.push(`${outer}${depth ? "JOINT" : "ROOT"} ${names[joint]}`, `${outer}{`,
      `${inner}OFFSET ${offsets[joint].map((value) => number(100 * value)).join(" ")}`,
      `${inner}CHANNELS ${depth ? 3 : "6 Xposition Yposition Zposition"} Zrotation Xrotation Yrotation`);
    const children = names.map((_, child) => child).filter((child) => parents[child] === joint);
    children.forEach((child) => add(child, depth + 1));
    if (!children.length) {
      const [, end] = bones.find(([from]) => from === joint) || [joint, [0, 0, 0]];
      lines.push(`${inner}End Site`, `${inner}{`, `${inner}\tOFFSET ${end.map((value) => number(100 * value)).join(" ")}`,
        `${inner}}`);
    }
    lines.push(`${outer}}`);
  };
  add(0, 0);
  lines.push("MOTION", `Frames: ${character.frames}`, `Frame Time: ${(1 / data.fps).toFixed(8)}`);
  for (let frame = 0; frame < character.frames; frame += 1) {
    const row = [0, 1, 2].map((axis) => 100 * character.root[3 * frame + axis]);
    for (const joint of order) row.push(...degreesOf(character.turns, 4 * (frame * names.length + joint)));
    lines.push(row.map(number).join(" "));
  }
  return lines.join("\n") + "\n";
}

function glbOf(character) {
  const { names } = data.skeletons[character.skeleton];
  const seconds = Float32Array.from({ length: character.frames }, (_, frame) => frame / data.fps);
  const tracks = [new VectorKeyframeTrack(`${names[0]}.position`, seconds, character.root)];
  names.forEach((name, joint) => {
    const turns = new Float32Array(4 * character.frames);
    for (let frame = 0; frame < character.frames; frame += 1) {
      const k = 4 * (frame * names.length + joint);
      turns.set(character.turns.subarray(k, k + 4), 4 * frame);
    }
    tracks.push(new QuaternionKeyframeTrack(`${name}.quaternion`, seconds, turns));
  });
  pose(character, 0);
  // A figure of its own, in lit grey: what is on the page stays there.
  const copy = new Figure(data.skeletons[character.skeleton], character.figure.mesh.geometry, bodyMaterial());
  copy.mesh.material = fleshMaterial;
  copy.bones.forEach((bone, joint) => {
    bone.position.copy(character.figure.bones[joint].position);
    bone.quaternion.copy(character.figure.bones[joint].quaternion);
  });
  const top = new Group();
  top.add(copy.mesh);
  const clip = new AnimationClip("motion", -1, tracks);
  return new GLTFExporter().parseAsync(top, { binary: true, animations: [clip] });
}

function save(name, parts, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const chosen = () => panels[0].follows;
const fileName = (ending) => `${(chosen().name || "motion").replace(/[^\w.-]+/g, "_")}.${ending}`;
const saveBvh = () => save(fileName("bvh"), [bvhText(chosen())], "text/plain");
const saveGlb = async () => save(fileName("glb"), [await glbOf(chosen())], "model/gltf-binary");

// ---------------------------------------------------------------- hands and keys

const sheet = byId("sheet");
const keys = {
  " ": () => setPlaying(!clock.playing),
  ArrowLeft: (event) => stepBy(event.shiftKey ? -Math.round(data.fps) : -1),
  ArrowRight: (event) => stepBy(event.shiftKey ? Math.round(data.fps) : 1),
  ArrowUp: () => faster(1),
  ArrowDown: () => faster(-1),
  Home: () => seek(0),
  End: () => { setPlaying(false); seek(numFrames - 1); },
  "+": () => zoomBy(1.2),
  "=": () => zoomBy(1.2),
  "-": () => zoomBy(1 / 1.2),
  0: () => resetView(),
  a: (event) => (event.shiftKey ? moveView(-1, 0) : orbit(-0.12, 0)),
  d: (event) => (event.shiftKey ? moveView(1, 0) : orbit(0.12, 0)),
  w: (event) => (event.shiftKey ? moveView(0, 1) : orbit(0, 0.08)),
  s: (event) => (event.shiftKey ? moveView(0, -1) : orbit(0, -0.08)),
  f: () => setFollow(!following),
  t: () => setTop(!above),
  b: () => setBody(!show.body),
  n: () => setNames(!show.names),
  g: () => setGhost(!show.ghost),
  i: () => setLoop(Math.round(clock.time), clock.to),
  o: () => setLoop(clock.from, Math.round(clock.time)),
  l: () => setLoop(0, numFrames - 1),
  Escape: () => {
    if (sheet.contains(document.activeElement)) byId("keys").querySelector("summary").focus();
    byId("keys").removeAttribute("open");
  },
};

const TURN = Math.PI / 12; // of one press of a button
const presses = {
  "play": () => setPlaying(!clock.playing),
  "back": () => stepBy(-1),
  "forward": () => stepBy(1),
  "zoom-in": () => zoomBy(1.2),
  "zoom-out": () => zoomBy(1 / 1.2),
  "follow": () => setFollow(!following),
  "top": () => setTop(!above),
  "reset": resetView,
  "sticks": () => setBody(!show.body),
  "names": () => setNames(!show.names),
  "ghost": () => setGhost(!show.ghost),
  "loop-from": keys.i,
  "loop-to": keys.o,
  "loop-all": keys.l,
  "save-bvh": saveBvh,
  "save-glb": saveGlb,
  "open-bvh": () => byId("file").click(),
  "orbit-left": () => orbit(-TURN, 0),
  "orbit-right": () => orbit(TURN, 0),
  "orbit-up": () => orbit(0, TURN),
  "orbit-down": () => orbit(0, -TURN),
  "move-left": () => moveView(-1, 0),
  "move-right": () => moveView(1, 0),
  "move-forward": () => moveView(0, 1),
  "move-back": () => moveView(0, -1),
  "turn": () => unfold("turn", "pad"),
  "more": () => unfold("more", "extras"),
};

function unfold(button, part) {
  const open = byId(button).getAttribute("aria-expanded") !== "true";
  byId(button).setAttribute("aria-expanded", String(open));
  byId(part).hidden = !open;
}

// Whoever stands nearest to where the page was touched.
function personAt(panel, x, y) {
  let [found, least] = [null, 60];
  for (const character of real(panel)) {
    const seen = panel.view.onPanel(character.figure.joint(0, place), panel.view.box[2], panel.view.box[3]);
    const away = seen ? Math.hypot(seen[0] - x, seen[1] - y) : Infinity;
    if (away < least) [found, least] = [character, away];
  }
  return found;
}

function listPeople() {
  const list = byId("person");
  const people = characters.filter((one) => !one.ghost);
  list.replaceChildren(...people.map((character, k) => {
    const option = document.createElement("option");
    [option.value, option.textContent] = [String(characters.indexOf(character)), `${k + 1} ${character.name || ""}`];
    return option;
  }));
  byId("people").hidden = people.length < 2;
}

function listen() {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const where = event.target.tagName;
    if (where === "SELECT") return; // has keys of its own
    if (event.key !== "Escape" && sheet.contains(event.target)) return; // they scroll it
    if (event.key === " " && (where === "BUTTON" || where === "SUMMARY")) return;
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act(event);
  });
  for (const [name, act] of Object.entries(presses)) byId(name).addEventListener("click", act);
  byId("speed").addEventListener("change", (event) => setSpeed(Number(event.target.value)));
  byId("person").addEventListener("change", (event) => followPerson(characters[Number(event.target.value)]));
  byId("file").addEventListener("change", (event) => { [...event.target.files].forEach(takeFile); event.target.value = ""; });
  scrub.addEventListener("pointerdown", () => { clock.scrubbing = true; });
  for (const name of ["pointerup", "pointercancel", "change"]) {
    scrub.addEventListener(name, () => { clock.scrubbing = false; });
  }
  scrub.addEventListener("input", () => seek(Number(scrub.value)));
  for (const name of ["dragover", "drop"]) {
    document.addEventListener(name, (event) => {
      event.preventDefault();
      if (name === "drop") [...event.dataTransfer.files].forEach(takeFile);
    });
  }
  stageElement.addEventListener("dblclick", (event) => {
    for (const panel of panels) {
      const box = panel.element.getBoundingClientRect();
      const person = event.clientX >= box.left && event.clientX < box.right && event.clientY >= box.top &&
        event.clientY < box.bottom && personAt(panel, event.clientX - box.left, event.clientY - box.top);
      if (person) followPerson(person);
    }
  });
  // In a notebook the wheel scrolls the notebook, until the reader has clicked in here.
  const wheel = () => { controls.enableZoom = !embedded || document.hasFocus(); };
  for (const name of ["focus", "blur"]) window.addEventListener(name, wheel);
  wheel();
  controls.addEventListener("change", request);
  controls.addEventListener("start", () => { if (above) { above = false; press("top", false); controls.minPolarAngle = 0.02; } });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColors(); drawTimeline(); request(); });
  new ResizeObserver(measure).observe(stageElement);
}

// ---------------------------------------------------------------- start

export async function start() {
  document.documentElement.classList.toggle("bare", location.search === "?bare"); // no buttons but play and time
  unpack(await inflate(data.tracks));
  delete data.tracks;
  try {
    stage = new Stage(stageElement);
  } catch {
    throw new Error("this browser gives the page no WebGL, with which bodies are drawn");
  }
  controls = new OrbitControls(eye, stageElement);
  Object.assign(controls, { screenSpacePanning: false, maxPolarAngle: Math.PI / 2 - 0.02, minPolarAngle: 0.02 });
  if (embedded) stageElement.style.touchAction = "pan-y";
  eye.position.set(0, 0, 1);
  readColors();
  const elements = document.querySelectorAll(".panel");
  panels = data.scenes.map((scene, k) => {
    const panel = { scene, element: elements[k], view: stage.add(elements[k]), caption: 0 };
    panel.labels = elements[k].querySelector(".labels");
    panel.many = scene.characters.length > CROWD;
    panel.follows = scene.characters.find((character) => !character.ghost);
    boundsOf(panel);
    for (const character of scene.characters) enter(character, panel);
    characters.push(...scene.characters);
    gather(panel);
    return panel;
  });
  readColors();
  boundaries = [...new Set(data.scenes.flatMap((scene) => scene.boundaries))].sort((one, other) => one - other);
  scrub.max = String(numFrames - 1);
  for (const boundary of boundaries.length > 200 ? [] : boundaries) { // more would be a grey bar
    const mark = document.createElement("i");
    mark.style.left = `${100 * boundary / (numFrames - 1)}%`;
    byId("ticks").append(mark);
  }
  const there = {
    contacts: characters.some((one) => one.contacts), trail: !characters.every((one) => one.color),
    ghost: characters.some((one) => one.ghost), path: characters.some((one) => one.path),
    boundaries: boundaries.length > 0,
  };
  for (const key of document.querySelectorAll("[data-of]")) key.hidden = !there[key.dataset.of];
  byId("ghost").hidden = !there.ghost;
  listPeople();
  stage.resize();
  show.body = characters.length <= CROWD;
  resetView();
  setLoop(0, numFrames - 1);
  measure();
  chooseBody();
  listen();
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  setPlaying(data.autoplay && !still);
  // For tests, and for those who look under the bonnet.
  window.player = {
    stage, seek, setPlaying, setSpeed, setBody, setLoop, takeBvh, bvhText, glbOf, followPerson, characters,
    get view() { return view(); },
    state: () => ({
      time: clock.time, frame: Math.min(Math.floor(clock.time), numFrames - 1), numFrames, playing: clock.playing,
      speed: clock.speed, window: windowAt(clock.time), loop: [clock.from, clock.to], body: show.body, ...stats,
    }),
    position: (scene, number, frame, joint) => { // millimetres
      const character = data.scenes[scene].characters[number];
      pose(character, frame);
      request();
      return character.figure.joint(joint).toArray().map((value) => 1000 * value);
    },
  };
  document.documentElement.dataset.ready = "yes";
}
