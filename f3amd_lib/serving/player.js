// The motion player. What the data mean stands in player.py; positions are millimetres, +Y is up.
(function () {
  "use strict";

  const data = JSON.parse(document.getElementById("player-data").textContent);
  const byId = (id) => document.getElementById(id);
  const embedded = window.parent !== window;
  const numFrames = data.frames;
  const lastFrame = numFrames - 1;
  const HOLD = 0.7; // seconds to rest on the last frame before it starts again
  const NEAR = 0.1; // metres in front of the eye where drawing begins
  const FILL = { height: 2.35, width: 1.9, distance: 4.6 }; // metres around one character

  // ---------------------------------------------------------------- data

  async function inflate(text) {
    if (typeof DecompressionStream === "undefined") {
      throw new Error("this browser is too old (it lacks DecompressionStream, of 2023)");
    }
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Undo the byte planes and the differences; the answer lies frame by frame.
  function readTrack(bytes, offset, channels, Numbers) {
    const count = channels * numFrames;
    const size = Numbers.BYTES_PER_ELEMENT;
    const track = new Numbers(count);
    let place = 0;
    for (let channel = 0; channel < channels; channel += 1) {
      let value = 0;
      for (let frame = 0; frame < numFrames; frame += 1, place += 1) {
        let step = 0;
        for (let plane = 0; plane < size; plane += 1) {
          step |= bytes[offset + plane * count + place] << (8 * plane);
        }
        value = (value + step) | 0;
        track[frame * channels + channel] = value; // wraps to the type's range
      }
    }
    return { track, next: offset + count * size };
  }

  function unpack(bytes) {
    let offset = 0;
    const take = (channels, Numbers) => {
      const { track, next } = readTrack(bytes, offset, channels, Numbers);
      offset = next;
      return track;
    };
    for (const scene of data.scenes) {
      for (const character of scene.characters) {
        const skeleton = data.skeletons[character.skeleton];
        character.root = take(3, Int32Array);
        character.points = take(3 * skeleton.points, Int16Array);
        character.touch = character.contacts ? take(1, Uint8Array) : null;
        character.target = character.path ? take(2, Int32Array) : null;
      }
    }
    if (offset !== bytes.length) throw new Error("the motion data are damaged");
  }

  // ---------------------------------------------------------------- state

  const view = {
    around: data.around, elevation: 0.24, zoom: 1, panX: 0, panZ: 0,
    follow: data.follow, top: false,
  };
  const clock = { time: 0, held: 0, playing: false, speed: 1, before: 0, scrubbing: false };
  const stats = { draws: 0, drawMs: 0 };
  const colors = {};
  let panels = [];
  let requested = false;
  let crowded = false;
  let aroundBefore = 0; // of the camera, until it went up to look from above

  function readColors() {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["left", "right", "middle", "contact", "target", "trail",
      "panel", "grid", "shadow", "text", "quiet"]) {
      colors[name] = style.getPropertyValue("--" + name).trim();
    }
  }

  // ---------------------------------------------------------------- where the camera stands

  // A root track smoothed over half a second, so that steps do not shake the camera.
  function smoothCenters(characters) {
    const centers = new Float32Array(2 * numFrames);
    for (let frame = 0; frame < numFrames; frame += 1) {
      let x = 0;
      let z = 0;
      for (const { root } of characters) {
        x += root[3 * frame];
        z += root[3 * frame + 2];
      }
      centers[2 * frame] = 0.001 * x / characters.length;
      centers[2 * frame + 1] = 0.001 * z / characters.length;
    }
    const half = Math.max(1, Math.round(0.25 * data.fps));
    let from = centers;
    for (let pass = 0; pass < 2; pass += 1) {
      const into = new Float32Array(2 * numFrames);
      for (let frame = 0; frame < numFrames; frame += 1) {
        let x = 0;
        let z = 0;
        for (let k = frame - half; k <= frame + half; k += 1) {
          const near = Math.min(Math.max(k, 0), lastFrame);
          x += from[2 * near];
          z += from[2 * near + 1];
        }
        into[2 * frame] = x / (2 * half + 1);
        into[2 * frame + 1] = z / (2 * half + 1);
      }
      from = into;
    }
    return from;
  }

  function boundsOf(characters) {
    const box = [Infinity, -Infinity, Infinity, -Infinity];
    const stretch = (x, z) => {
      box[0] = Math.min(box[0], 0.001 * x);
      box[1] = Math.max(box[1], 0.001 * x);
      box[2] = Math.min(box[2], 0.001 * z);
      box[3] = Math.max(box[3], 0.001 * z);
    };
    for (const { root, target } of characters) {
      for (let frame = 0; frame < numFrames; frame += 1) {
        stretch(root[3 * frame], root[3 * frame + 2]);
        if (target) stretch(target[2 * frame], target[2 * frame + 1]);
      }
    }
    return box;
  }

  // The corners of what has to be seen when the camera does not follow: everybody, head to toe.
  function cornersOf(box) {
    const corners = [];
    for (const x of [box[0] - 0.4, box[1] + 0.4]) {
      for (const z of [box[2] - 0.4, box[3] + 0.4]) {
        for (const y of [0, 1.8]) corners.push([x, y, z]);
      }
    }
    return corners;
  }

  // The widest spread of the characters around the point that the camera follows.
  function spreadOf(characters, centers) {
    let spread = 0;
    for (const { root } of characters) {
      for (let frame = 0; frame < numFrames; frame += 1) {
        const x = 0.001 * root[3 * frame] - centers[2 * frame];
        const z = 0.001 * root[3 * frame + 2] - centers[2 * frame + 1];
        spread = Math.max(spread, x * x + z * z);
      }
    }
    return Math.sqrt(spread);
  }

  function aim(panel) {
    const { width, height } = panel;
    const eye = panel.eye;
    const elevation = view.top ? 1.5533 : view.elevation;
    const sinA = Math.sin(view.around);
    const cosA = Math.cos(view.around);
    const sinE = Math.sin(elevation);
    const cosE = Math.cos(elevation);
    eye.rx = cosA; eye.rz = -sinA;
    eye.ux = -sinA * sinE; eye.uy = cosE; eye.uz = -cosA * sinE;
    eye.tx = sinA * cosE; eye.ty = sinE; eye.tz = cosA * cosE;
    eye.focal = Math.min(height / FILL.height, width / FILL.width) * FILL.distance;
    eye.midX = width / 2 - view.zoom * panel.shiftX;
    eye.midY = height / 2 + panel.caption / 2 + view.zoom * panel.shiftY;
  }

  // Where the corners lie on the panel from a distance, as [left, right, low, high] pixels.
  function extent(panel, distance) {
    const { eye } = panel;
    const found = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [cx, cy, cz] of panel.corners) {
      const x = cx - panel.middle[0];
      const y = cy - 0.88;
      const z = cz - panel.middle[1];
      const depth = distance - (eye.tx * x + eye.ty * y + eye.tz * z);
      if (depth < NEAR) return null;
      const right = eye.focal / depth * (eye.rx * x + eye.rz * z);
      const up = eye.focal / depth * (eye.ux * x + eye.uy * y + eye.uz * z);
      found[0] = Math.min(found[0], right);
      found[1] = Math.max(found[1], right);
      found[2] = Math.min(found[2], up);
      found[3] = Math.max(found[3], up);
    }
    return found;
  }

  // One distance for all panels: what is compared is drawn in one size.
  function fitDistance() {
    let distance = FILL.distance;
    for (const panel of panels) {
      aim(panel);
      if (view.follow) {
        distance = Math.max(distance, FILL.distance * (1 + 1.1 * panel.spread));
        continue;
      }
      for (let tries = 0; tries < 100; tries += 1) {
        const found = extent(panel, distance);
        if (found && found[1] - found[0] < 0.96 * panel.width &&
            found[3] - found[2] < 0.96 * (panel.height - panel.caption)) break;
        distance *= 1.05;
      }
    }
    for (const panel of panels) {
      panel.distance = distance;
      const found = view.follow ? null : extent(panel, distance);
      panel.shiftX = found ? (found[0] + found[1]) / 2 : 0;
      panel.shiftY = found ? (found[2] + found[3]) / 2 : 0;
    }
  }

  // ---------------------------------------------------------------- drawing

  const seen = { x: new Float32Array(0), y: new Float32Array(0), depth: new Float32Array(0) };
  const limbOrder = { index: new Uint16Array(0), depth: new Float32Array(0) };
  const point = { x: 0, y: 0, depth: 0 };

  function project(eye, x, y, z) {
    const dx = x - eye.x;
    const dy = y - eye.y;
    const dz = z - eye.z;
    const depth = eye.distance - (eye.tx * dx + eye.ty * dy + eye.tz * dz);
    const scale = eye.focal / Math.max(depth, NEAR);
    point.x = eye.midX + scale * (eye.rx * dx + eye.rz * dz);
    point.y = eye.midY - scale * (eye.ux * dx + eye.uy * dy + eye.uz * dz);
    point.depth = depth;
  }

  // A straight line on the ground, cut where it passes the eye.
  function groundLine(context, eye, x0, z0, x1, z1) {
    const depthAt = (x, z) =>
      eye.distance - (eye.tx * (x - eye.x) - eye.ty * eye.y + eye.tz * (z - eye.z));
    const d0 = depthAt(x0, z0);
    const d1 = depthAt(x1, z1);
    if (d0 < NEAR && d1 < NEAR) return;
    if (d0 < NEAR || d1 < NEAR) {
      const cut = (NEAR - d0) / (d1 - d0);
      const x = x0 + cut * (x1 - x0);
      const z = z0 + cut * (z1 - z0);
      if (d0 < NEAR) { x0 = x; z0 = z; } else { x1 = x; z1 = z; }
    }
    project(eye, x0, 0, z0);
    context.moveTo(point.x, point.y);
    project(eye, x1, 0, z1);
    context.lineTo(point.x, point.y);
  }

  function drawGrid(context, panel) {
    const eye = panel.eye;
    const step = gridStep();
    const radius = Math.max(view.follow ? 4 + panel.spread : 1.5 + panel.reach, 1.6 * step);
    const centerX = eye.x;
    const centerZ = eye.z;
    context.beginPath();
    for (let x = Math.ceil((centerX - radius) / step) * step; x < centerX + radius; x += step) {
      const half = Math.sqrt(Math.max(radius * radius - (x - centerX) ** 2, 0));
      groundLine(context, eye, x, centerZ - half, x, centerZ + half);
    }
    for (let z = Math.ceil((centerZ - radius) / step) * step; z < centerZ + radius; z += step) {
      const half = Math.sqrt(Math.max(radius * radius - (z - centerZ) ** 2, 0));
      groundLine(context, eye, centerX - half, z, centerX + half, z);
    }
    context.strokeStyle = colors.grid;
    context.lineWidth = 1;
    context.stroke();
  }

  function gridStep() {
    return panels.some((panel) => (view.follow ? panel.spread : panel.reach) > 14) ? 5 : 1;
  }

  // A line over the ground through every stride-th frame, and on to the last one asked for.
  function groundTrack(context, eye, track, size, end, stride) {
    let pen = false;
    for (let frame = 0; ; frame = Math.min(frame + stride, end)) {
      project(eye, 0.001 * track[size * frame], 0, 0.001 * track[size * frame + size - 1]);
      if (point.depth < NEAR) {
        pen = false;
      } else if (pen) {
        context.lineTo(point.x, point.y);
      } else {
        context.moveTo(point.x, point.y);
        pen = true;
      }
      if (frame >= end) break;
    }
  }

  function drawGround(context, panel, frame) {
    const eye = panel.eye;
    const { characters } = panel.scene;
    const stride = Math.max(1, Math.ceil(characters.length * numFrames / 6000));
    context.lineJoin = "round";
    context.lineCap = "butt";
    context.strokeStyle = colors.target;
    context.lineWidth = crowded ? 1 : 2;
    context.beginPath();
    for (const { target } of characters) {
      if (target) groundTrack(context, eye, target, 2, lastFrame, stride);
    }
    if (!crowded) context.setLineDash([6, 4]);
    context.stroke();
    context.setLineDash([]);
    context.lineWidth = crowded ? 1.2 : 2;
    context.globalAlpha = crowded ? 0.5 : 1;
    for (const color of panel.colors) { // one stroke a colour: strokes cost more than points
      context.beginPath();
      for (const character of characters) {
        if (character.color === color) groundTrack(context, eye, character.root, 3, frame, stride);
      }
      context.strokeStyle = color || colors.trail;
      context.stroke();
    }
    context.globalAlpha = 1;
    if (crowded) return;
    context.lineWidth = 2;
    context.strokeStyle = colors.target;
    for (const { target } of characters) { // where it should be now
      if (!target) continue;
      project(eye, 0.001 * target[2 * frame], 0, 0.001 * target[2 * frame + 1]);
      if (point.depth < NEAR) continue;
      const radius = 0.11 * eye.focal / point.depth;
      context.beginPath();
      context.ellipse(point.x, point.y, radius, radius * Math.max(eye.ty, 0.12), 0, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  function projectCharacter(eye, character, frame, weight) {
    const { root, points } = character;
    const count = points.length / (3 * numFrames);
    const next = Math.min(frame + 1, lastFrame);
    const x0 = root[3 * frame] + weight * (root[3 * next] - root[3 * frame]);
    const y0 = root[3 * frame + 1] + weight * (root[3 * next + 1] - root[3 * frame + 1]);
    const z0 = root[3 * frame + 2] + weight * (root[3 * next + 2] - root[3 * frame + 2]);
    let a = 3 * count * frame;
    let b = 3 * count * next;
    for (let k = 0; k < count; k += 1, a += 3, b += 3) {
      const x = 0.001 * (x0 + points[a] + weight * (points[b] - points[a]));
      const y = 0.001 * (y0 + points[a + 1] + weight * (points[b + 1] - points[a + 1]));
      const z = 0.001 * (z0 + points[a + 2] + weight * (points[b + 2] - points[a + 2]));
      project(eye, x, y, z);
      seen.x[k] = point.x;
      seen.y[k] = point.y;
      seen.depth[k] = point.depth;
    }
    return count;
  }

  function drawShadow(context, eye, character, frame) {
    project(eye, 0.001 * character.root[3 * frame], 0, 0.001 * character.root[3 * frame + 2]);
    if (point.depth < NEAR) return;
    const radius = 0.24 * eye.focal / point.depth;
    context.moveTo(point.x + radius, point.y);
    context.ellipse(point.x, point.y, radius, radius * Math.max(eye.ty, 0.08), 0, 0, 2 * Math.PI);
  }

  // Number `count` limbs and the head in `limbOrder`, farthest first.
  function sortLimbs(limbs, headDepth) {
    let count = 0;
    const insert = (index, depth) => {
      let place = count;
      while (place > 0 && limbOrder.depth[place - 1] < depth) {
        limbOrder.depth[place] = limbOrder.depth[place - 1];
        limbOrder.index[place] = limbOrder.index[place - 1];
        place -= 1;
      }
      limbOrder.depth[place] = depth;
      limbOrder.index[place] = index;
      count += 1;
    };
    for (let k = 0; k < limbs.length; k += 1) {
      let depth = 0;
      for (const [parent, child] of limbs[k].bones) depth += seen.depth[parent] + seen.depth[child];
      insert(k, depth / (2 * limbs[k].bones.length));
    }
    if (headDepth !== null) insert(limbs.length, headDepth);
    return count;
  }

  function drawCharacter(context, eye, character, frame, weight) {
    const skeleton = data.skeletons[character.skeleton];
    const count = projectCharacter(eye, character, frame, weight);
    for (let k = 0; k < count; k += 1) if (seen.depth[k] < NEAR) return;
    const { limbs, head, toes } = skeleton;
    let headX = 0;
    let headY = 0;
    let headScale = 0;
    if (head) { // a little beyond the joint, away from the neck
      const [top, neck] = head;
      headScale = eye.focal / seen.depth[top];
      const dx = seen.x[top] - seen.x[neck];
      const dy = seen.y[top] - seen.y[neck];
      const beyond = 0.07 * headScale / Math.max(Math.hypot(dx, dy), 0.09 * headScale);
      headX = seen.x[top] + beyond * dx;
      headY = seen.y[top] + beyond * dy;
    }
    const order = sortLimbs(limbs, head ? seen.depth[head[0]] : null);
    for (let place = 0; place < order; place += 1) {
      const index = limbOrder.index[place];
      context.beginPath();
      if (index === limbs.length) {
        context.arc(headX, headY, Math.max(0.1 * headScale, 1.5), 0, 2 * Math.PI);
        context.fillStyle = character.color || colors.middle;
        context.fill();
        continue;
      }
      const { side, bones } = limbs[index];
      let end = -1;
      for (let k = 0; k < bones.length; k += 1) {
        const [parent, child] = bones[k];
        if (parent !== end) context.moveTo(seen.x[parent], seen.y[parent]);
        context.lineTo(seen.x[child], seen.y[child]);
        end = child;
      }
      const width = Math.max(0.05 * eye.focal / limbOrder.depth[place], 1.2);
      context.lineCap = width > 4 ? "round" : "butt"; // nobody sees round ends of thin lines
      context.lineJoin = width > 4 ? "round" : "bevel";
      if (!crowded) { // a rim in the panel's colour keeps crossing limbs apart
        context.strokeStyle = colors.panel;
        context.lineWidth = width + 2.5;
        context.stroke();
      }
      context.strokeStyle = side === "middle" && character.color ? character.color : colors[side];
      context.lineWidth = width;
      context.stroke();
    }
    if (!character.touch) return;
    const touching = character.touch[frame];
    for (let foot = 0; foot < 2; foot += 1) {
      if (!(touching & (1 << foot))) continue;
      const toe = toes[foot];
      const radius = Math.max(0.045 * eye.focal / seen.depth[toe], 1.2);
      context.beginPath();
      context.arc(seen.x[toe], seen.y[toe], radius, 0, 2 * Math.PI);
      context.fillStyle = colors.contact;
      context.fill();
      if (!crowded) {
        context.strokeStyle = colors.panel;
        context.lineWidth = 1.2;
        context.stroke();
      }
    }
  }

  function drawPanel(panel, frame, weight) {
    const { context, eye, scene, width, height, ratio } = panel;
    if (!width || !height) return;
    aim(panel);
    const next = Math.min(frame + 1, lastFrame);
    const { centers } = panel;
    const mix = (a, b) => a + weight * (b - a);
    eye.x = view.panX + panel.middle[0];
    eye.z = view.panZ + panel.middle[1];
    if (view.follow) {
      eye.x = view.panX + mix(centers[2 * frame], centers[2 * next]);
      eye.z = view.panZ + mix(centers[2 * frame + 1], centers[2 * next + 1]);
    }
    eye.y = 0.88;
    eye.distance = panel.distance / view.zoom;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colors.panel;
    context.fillRect(0, 0, width, height);
    drawGrid(context, panel);
    drawGround(context, panel, frame);
    context.beginPath();
    for (const character of scene.characters) drawShadow(context, eye, character, frame);
    context.fillStyle = colors.shadow;
    context.fill();
    const { order, depth } = panel;
    for (let k = 0; k < order.length; k += 1) {
      const { root } = scene.characters[k];
      depth[k] = eye.tx * root[3 * frame] + eye.tz * root[3 * frame + 2];
    }
    order.sort((one, other) => depth[one] - depth[other]); // near the eye means drawn last
    for (let k = 0; k < order.length; k += 1) {
      drawCharacter(context, eye, scene.characters[order[k]], frame, weight);
    }
  }

  function draw() {
    const began = performance.now();
    const frame = Math.min(Math.floor(clock.time), lastFrame);
    const weight = clock.time - frame;
    for (const panel of panels) drawPanel(panel, frame, weight);
    stats.draws += 1;
    stats.drawMs += performance.now() - began;
  }

  // ---------------------------------------------------------------- time

  const scrub = byId("scrub");
  let spoken = "";

  function windowAt(frame) {
    let number = 1;
    for (const boundary of boundaries) if (frame >= boundary) number += 1;
    return number;
  }

  function showTime(exact) {
    const frame = Math.min(Math.round(clock.time), lastFrame);
    const now = (frame / data.fps).toFixed(1);
    const end = (lastFrame / data.fps).toFixed(1);
    if (!clock.scrubbing) scrub.value = String(frame);
    byId("clock").textContent = `${now} / ${end} s`;
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
      const passed = Math.min((now - clock.before) / 1000, 0.25) * clock.speed;
      clock.before = now;
      if (!clock.scrubbing) {
        clock.time += Math.max(passed, 0) * data.fps;
        if (clock.time >= lastFrame) {
          clock.time = lastFrame;
          clock.held += Math.max(passed, 0);
          if (clock.held > HOLD) seekTo(0);
        }
      }
    }
    draw();
    showTime(!clock.playing);
    if (clock.playing) request();
  }

  function request() {
    if (requested) return;
    requested = true;
    requestAnimationFrame(tick);
  }

  function seekTo(frame) {
    clock.time = Math.min(Math.max(Math.round(frame), 0), lastFrame);
    clock.held = 0;
  }

  function seek(frame) {
    seekTo(frame);
    request();
  }

  function setPlaying(playing) {
    if (playing && clock.time >= lastFrame) seekTo(0);
    if (!playing) clock.time = Math.round(clock.time); // rest on a frame, not between two
    clock.playing = playing && lastFrame > 0;
    clock.before = performance.now();
    const button = byId("play");
    button.setAttribute("aria-label", clock.playing ? "Pause" : "Play");
    document.body.classList.toggle("playing", clock.playing);
    request();
  }

  function stepBy(frames) {
    setPlaying(false);
    seek(clock.time + frames);
  }

  const speeds = Array.from(byId("speed").options, (option) => Number(option.value));

  function setSpeed(speed) {
    clock.speed = speed;
    byId("speed").value = String(speed);
  }

  function faster(by) {
    const place = speeds.indexOf(clock.speed) + by;
    setSpeed(speeds[Math.min(Math.max(place, 0), speeds.length - 1)]);
  }

  // ---------------------------------------------------------------- the view

  function zoomBy(factor) {
    view.zoom = Math.min(Math.max(view.zoom * factor, 0.2), 20);
    request();
  }

  function orbit(around, elevation) {
    view.around += around;
    if (elevation && view.top) { // leave the bird's view where it was
      const { around: kept } = view;
      setTop(false);
      view.around = kept;
      view.elevation = 1.5;
    }
    view.elevation = Math.min(Math.max(view.elevation + elevation, 0.02), 1.55);
    request();
  }

  function panBy(panel, right, down) {
    const { eye } = panel;
    const metres = eye.distance / eye.focal;
    const ahead = down * metres / Math.max(eye.ty, 0.25);
    view.panX += -right * metres * eye.rx + ahead * Math.sin(view.around) * -1;
    view.panZ += -right * metres * eye.rz + ahead * Math.cos(view.around) * -1;
    request();
  }

  // For those who do not drag: a tenth of the panel to a side (of the reader) or over the ground.
  function moveView(right, forward) {
    const [panel] = panels;
    const step = 0.1 * Math.min(panel.width, panel.height);
    panBy(panel, -right * step, forward * step);
  }

  // From above, +Z is up the page and +X to the left, as in the film strips' plans.
  function setTop(top) {
    if (top && !view.top) {
      aroundBefore = view.around;
      view.around = Math.PI;
    } else if (!top && view.top) {
      view.around = aroundBefore;
    }
    view.top = top;
    byId("top").setAttribute("aria-pressed", String(top));
    fitDistance();
    request();
  }

  function setFollow(follow) {
    view.follow = follow;
    view.panX = view.panZ = 0;
    byId("follow").setAttribute("aria-pressed", String(follow));
    byId("grid-key").textContent = `grid ${gridStep()} m`;
    fitDistance();
    request();
  }

  function resetView() {
    setTop(false);
    view.around = data.around;
    view.elevation = panels.some((panel) => panel.scene.characters.length > 3) ? 0.5 : 0.24;
    view.zoom = 1;
    setFollow(data.follow);
  }

  // Columns that leave the panels as large as they can be.
  function arrange() {
    const stage = byId("stage");
    const box = stage.getBoundingClientRect();
    let best = 1;
    let most = 0;
    for (let columns = 1; columns <= panels.length; columns += 1) {
      const rows = Math.ceil(panels.length / columns);
      const wide = box.width / columns / FILL.width;
      const size = Math.min(wide, (box.height / rows - 44) / FILL.height);
      if (size > most * 1.02) { most = size; best = columns; }
    }
    stage.style.gridTemplateColumns = `repeat(${best}, minmax(0, 1fr))`;
    stage.style.gridAutoRows = "minmax(0, 1fr)";
  }

  function measure() {
    arrange();
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const tallest = Math.max(...panels.map((panel) => panel.captionElement.offsetHeight));
    for (const panel of panels) {
      const box = panel.canvas.getBoundingClientRect();
      panel.width = box.width;
      panel.height = box.height;
      panel.ratio = ratio;
      panel.caption = Math.min(tallest, 0.25 * box.height); // all figures stand at one height
      const width = Math.max(1, Math.round(box.width * ratio));
      const height = Math.max(1, Math.round(box.height * ratio));
      if (panel.canvas.width !== width) panel.canvas.width = width;
      if (panel.canvas.height !== height) panel.canvas.height = height;
    }
    fitDistance();
    if (panels.length) draw(); // at once: a resized canvas is blank
  }

  // ---------------------------------------------------------------- hands and keys

  function listenTo(panel) {
    const { canvas } = panel;
    const held = new Map();
    let pinch = null;
    const spread = () => {
      const [one, other] = [...held.values()];
      return {
        x: (one.x + other.x) / 2,
        y: (one.y + other.y) / 2,
        size: Math.max(Math.hypot(one.x - other.x, one.y - other.y), 1),
      };
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
      pinch = held.size === 2 ? spread() : null;
      canvas.classList.add("held");
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const dx = event.clientX - before.x;
      const dy = event.clientY - before.y;
      before.x = event.clientX;
      before.y = event.clientY;
      if (held.size === 1) {
        if (event.shiftKey || event.buttons & 2) panBy(panel, dx, dy);
        else orbit(-0.008 * dx, 0.006 * dy);
      } else if (held.size === 2 && pinch) {
        const now = spread();
        zoomBy(now.size / pinch.size);
        panBy(panel, now.x - pinch.x, now.y - pinch.y);
        pinch = now;
      }
    });
    const release = (event) => {
      held.delete(event.pointerId);
      pinch = held.size === 2 ? spread() : null;
      if (!held.size) canvas.classList.remove("held");
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      // In a notebook the wheel scrolls the notebook, until the reader has clicked in here.
      if (embedded && !document.hasFocus() && !event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      zoomBy(Math.exp(-0.0015 * lines * event.deltaY));
    }, { passive: false });
  }

  const sheet = byId("sheet");
  const keys = {
    " ": () => setPlaying(!clock.playing),
    ArrowLeft: (event) => stepBy(event.shiftKey ? -Math.round(data.fps) : -1),
    ArrowRight: (event) => stepBy(event.shiftKey ? Math.round(data.fps) : 1),
    ArrowUp: () => faster(1),
    ArrowDown: () => faster(-1),
    Home: () => seek(0),
    End: () => { setPlaying(false); seek(lastFrame); },
    "+": () => zoomBy(1.2),
    "=": () => zoomBy(1.2),
    "-": () => zoomBy(1 / 1.2),
    0: () => resetView(),
    a: (event) => (event.shiftKey ? moveView(-1, 0) : orbit(-0.12, 0)),
    d: (event) => (event.shiftKey ? moveView(1, 0) : orbit(0.12, 0)),
    w: (event) => (event.shiftKey ? moveView(0, 1) : orbit(0, 0.08)),
    s: (event) => (event.shiftKey ? moveView(0, -1) : orbit(0, -0.08)),
    f: () => setFollow(!view.follow),
    t: () => setTop(!view.top),
    Escape: () => {
      if (sheet.contains(document.activeElement)) byId("keys").querySelector("summary").focus();
      byId("keys").removeAttribute("open");
    },
  };

  const TURN = Math.PI / 12; // of one press of a button
  const presses = {
    "orbit-left": () => orbit(-TURN, 0),
    "orbit-right": () => orbit(TURN, 0),
    "orbit-up": () => orbit(0, TURN),
    "orbit-down": () => orbit(0, -TURN),
    "move-left": () => moveView(-1, 0),
    "move-right": () => moveView(1, 0),
    "move-forward": () => moveView(0, 1),
    "move-back": () => moveView(0, -1),
  };

  function showPad() {
    const button = byId("turn");
    const open = button.getAttribute("aria-expanded") !== "true";
    button.setAttribute("aria-expanded", String(open));
    byId("pad").hidden = !open;
  }

  function listen() {
    panels.forEach(listenTo);
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
    byId("play").addEventListener("click", () => setPlaying(!clock.playing));
    byId("back").addEventListener("click", () => stepBy(-1));
    byId("forward").addEventListener("click", () => stepBy(1));
    byId("zoom-in").addEventListener("click", () => zoomBy(1.2));
    byId("zoom-out").addEventListener("click", () => zoomBy(1 / 1.2));
    byId("follow").addEventListener("click", () => setFollow(!view.follow));
    byId("top").addEventListener("click", () => setTop(!view.top));
    byId("reset").addEventListener("click", resetView);
    byId("turn").addEventListener("click", showPad);
    for (const [name, act] of Object.entries(presses)) byId(name).addEventListener("click", act);
    byId("speed").addEventListener("change", (event) => setSpeed(Number(event.target.value)));
    scrub.addEventListener("pointerdown", () => { clock.scrubbing = true; });
    for (const name of ["pointerup", "pointercancel", "change"]) {
      scrub.addEventListener(name, () => { clock.scrubbing = false; });
    }
    scrub.addEventListener("input", () => seek(Number(scrub.value)));
    const recolor = () => { readColors(); request(); };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);
    new ResizeObserver(measure).observe(byId("stage"));
  }

  // ---------------------------------------------------------------- start

  const boundaries = [...new Set(data.scenes.flatMap((scene) => scene.boundaries))]
    .sort((one, other) => one - other);

  function makePanel(scene, element) {
    const canvas = element.querySelector("canvas");
    const centers = smoothCenters(scene.characters);
    const box = boundsOf(scene.characters);
    const count = scene.characters.length;
    return {
      scene, canvas, centers,
      captionElement: element.querySelector("figcaption"),
      context: canvas.getContext("2d", { alpha: false }),
      corners: cornersOf(box),
      middle: [(box[0] + box[1]) / 2, (box[2] + box[3]) / 2],
      reach: Math.hypot(box[1] - box[0], box[3] - box[2]) / 2,
      spread: spreadOf(scene.characters, centers) * (count > 1 ? 1 : 0),
      eye: {}, width: 0, height: 0, ratio: 1, caption: 0, distance: FILL.distance,
      shiftX: 0, shiftY: 0,
      colors: [...new Set(scene.characters.map((character) => character.color))],
      order: Uint16Array.from({ length: count }, (_, k) => k),
      depth: new Float32Array(count),
    };
  }

  async function start() {
    document.documentElement.classList.toggle("embedded", embedded);
    unpack(await inflate(data.tracks));
    delete data.tracks;
    const most = Math.max(...data.skeletons.map((skeleton) => skeleton.points));
    for (const name of Object.keys(seen)) seen[name] = new Float32Array(most);
    const items = 1 + Math.max(...data.skeletons.map(({ limbs }) => limbs.length)); // and a head
    limbOrder.index = new Uint16Array(items);
    limbOrder.depth = new Float32Array(items);
    const count = data.scenes.reduce((sum, scene) => sum + scene.characters.length, 0);
    crowded = count > 12;
    const elements = document.querySelectorAll(".panel");
    panels = data.scenes.map((scene, k) => makePanel(scene, elements[k]));
    scrub.max = String(lastFrame);
    for (const boundary of boundaries.length > 200 ? [] : boundaries) { // more would be a grey bar
      const mark = document.createElement("i");
      mark.style.left = `${100 * boundary / lastFrame}%`;
      byId("ticks").append(mark);
    }
    readColors();
    listen();
    resetView();
    measure();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    setPlaying(data.autoplay && !still);
    // For tests, and for those who look under the bonnet.
    window.player = {
      seek, setPlaying, setSpeed, view,
      state: () => ({
        time: clock.time, frame: Math.min(Math.floor(clock.time), lastFrame), numFrames,
        playing: clock.playing, speed: clock.speed, window: windowAt(clock.time), ...stats,
      }),
      position: (scene, character, frame, place) => {
        const { root, points } = data.scenes[scene].characters[character];
        const size = points.length / numFrames;
        return [0, 1, 2].map((axis) =>
          root[3 * frame + axis] + points[frame * size + 3 * place + axis]);
      },
    };
    document.documentElement.dataset.ready = "yes";
  }

  start().catch((error) => {
    const message = byId("message");
    message.textContent = `This motion cannot be shown: ${error.message}.`;
    message.hidden = false;
  });
})();
