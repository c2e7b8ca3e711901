// Characters: bones, a body of capsules (as text/data/body.py makes it), or sticks.
//
// A skeleton is { names, parents, offsets: [[x, y, z]], capsules: [[joint, start, end, radii, wide]],
// bones: [[joint, [x, y, z], side]], head, toes }, in metres; the sides are "left", "right", "middle".
import {
  Bone, BufferAttribute, BufferGeometry, Color, CylinderGeometry, Group, InstancedMesh, Matrix4, MeshBasicMaterial, MeshLambertMaterial,
  Quaternion, Skeleton, SkinnedMesh, SphereGeometry, Vector3,
} from "three";

const SIDES = 8;
const LATITUDES = [-1, -0.5, 0, 0, 0, 0.5, 1].map((share) => share * Math.PI / 2);

// Vertices in the joint's frame: a pole, five rings, a pole.
export function capsuleVertices([, start, end, radii, wide]) {
  const from = new Vector3(...start);
  const to = new Vector3(...end);
  const axis = to.clone().sub(from).normalize();
  const across = new Vector3(...wide);
  const stretch = across.length() || 1;
  across.addScaledVector(axis, -across.dot(axis));
  if (across.length() < 1e-6) {
    const small = [axis.x, axis.y, axis.z].map(Math.abs);
    across.set(0, 0, 0).setComponent(small.indexOf(Math.min(...small)), 1);
    across.crossVectors(axis, across);
  }
  across.normalize();
  const other = new Vector3().crossVectors(axis, across);
  const vertices = [];
  LATITUDES.forEach((latitude, place) => {
    const share = Math.min(Math.max((place - 2) / 2, 0), 1);
    const radius = radii[0] + share * (radii[1] - radii[0]);
    const centre = from.clone().lerp(to, share).addScaledVector(axis, radius * Math.sin(latitude));
    if (place === 0 || place === LATITUDES.length - 1) { vertices.push(centre); return; }
    for (let k = 0; k < SIDES; k += 1) {
      const turn = 2 * Math.PI * k / SIDES;
      vertices.push(centre.clone()
        .addScaledVector(across, stretch * radius * Math.cos(latitude) * Math.cos(turn))
        .addScaledVector(other, radius * Math.cos(latitude) * Math.sin(turn)));
    }
  });
  return vertices;
}

function capsuleFaces(first) {
  const faces = [];
  const rings = LATITUDES.length - 2;
  const at = (ring, k) => first + 1 + ring * SIDES + k % SIDES;
  const last = first + 1 + rings * SIDES;
  for (let k = 0; k < SIDES; k += 1) {
    faces.push(first, at(0, k + 1), at(0, k));
    for (let ring = 0; ring + 1 < rings; ring += 1) {
      faces.push(at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring, k), at(ring + 1, k + 1), at(ring + 1, k));
    }
    faces.push(at(rings - 1, k), at(rings - 1, k + 1), last);
  }
  return faces;
}

// Capsules for a skeleton that Python has not seen, such as one of a dropped file.
export function plainCapsules({ bones }) {
  return bones.map(([joint, end]) => {
    const radius = Math.min(0.06, 0.3 * Math.hypot(...end));
    return [joint, [0, 0, 0], end, [radius, 0.8 * radius], [0, 0, 0]];
  });
}

// Where joints are with all rotations the identity.
export function restPositions({ parents, offsets }) {
  const rest = [];
  parents.forEach((parent, joint) => {
    rest.push(parent < 0 ? [0, 0, 0] : offsets[joint].map((value, axis) => value + rest[parent][axis]));
  });
  return rest;
}

export function bodyGeometry(skeleton) {
  const rest = restPositions(skeleton);
  const places = [];
  const joints = [];
  const weights = [];
  const faces = [];
  const sides = [];
  for (const capsule of skeleton.capsules) {
    faces.push(...capsuleFaces(joints.length / 4));
    const side = sideOf(skeleton, capsule);
    for (const vertex of capsuleVertices(capsule)) {
      places.push(...vertex.add(new Vector3(...rest[capsule[0]])).toArray());
      joints.push(capsule[0], 0, 0, 0);
      weights.push(1, 0, 0, 0);
      sides.push(side);
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
  geometry.setAttribute("skinIndex", new BufferAttribute(new Uint16Array(joints), 4));
  geometry.setAttribute("skinWeight", new BufferAttribute(new Float32Array(weights), 4));
  geometry.setIndex(faces);
  geometry.computeVertexNormals();
  geometry.userData.sides = sides;
  return geometry;
}

// The side of a capsule: that of the bone which it goes along, or of its joint.
function sideOf({ bones, sides }, [joint, , end]) {
  const along = bones.find(([from, to]) => from === joint && to.every((value, axis) => Math.abs(value - end[axis]) < 1e-6));
  return along ? along[2] : sides[joint];
}

// Colours of trunk and limbs, or one for all.
function partColors(colors, one) {
  const soft = new Color(colors.flesh);
  return Object.fromEntries(["left", "right", "middle"].map((side) =>
    [side, one ? new Color(one) : side === "middle" ? soft : new Color(colors[side]).lerp(soft, 0.3)]));
}

export function paintBody(geometry, colors, one) {
  const { sides } = geometry.userData;
  const parts = partColors(colors, one);
  const values = new Float32Array(3 * sides.length);
  sides.forEach((side, k) => parts[side].toArray(values, 3 * k));
  geometry.setAttribute("color", new BufferAttribute(values, 3));
}

// One character: bones with a skinned body on them. `geometry` may be shared by characters alike.
export class Figure {
  constructor(skeleton, geometry, material) {
    this.skeleton = skeleton;
    this.bones = skeleton.names.map((name) => Object.assign(new Bone(), { name }));
    const rest = restPositions(skeleton);
    skeleton.parents.forEach((parent, joint) => {
      if (parent < 0) return;
      this.bones[joint].position.set(...skeleton.offsets[joint]);
      this.bones[parent].add(this.bones[joint]);
    });
    const inverses = rest.map(([x, y, z]) => new Matrix4().makeTranslation(-x, -y, -z));
    this.mesh = new SkinnedMesh(geometry, material);
    this.mesh.add(this.bones[0]);
    this.mesh.bind(new Skeleton(this.bones, inverses), new Matrix4());
    this.mesh.frustumCulled = false; // its box is that of the rest pose, at the origin
    this.mesh.castShadow = true;
  }

  // Root [3] in metres and local quaternions [J, 4] as x, y, z, w.
  pose(root, turns) {
    this.bones[0].position.fromArray(root);
    this.bones.forEach((bone, joint) => bone.quaternion.fromArray(turns, 4 * joint));
    this.mesh.updateMatrixWorld(true);
  }

  joint(number, into = new Vector3()) {
    return into.setFromMatrixPosition(this.bones[number].matrixWorld);
  }
}

export function bodyMaterial(options = {}) {
  return new MeshLambertMaterial({ vertexColors: true, ...options });
}

// Bodies of many characters, a draw for each capsule of a skeleton: it goes rigidly with its joint. Bones have to be posed
// before `update`.
export class Bodies {
  constructor(figures) {
    const material = bodyMaterial({ vertexColors: false });
    this.parts = [...new Set(figures.map(({ skeleton }) => skeleton))].flatMap((skeleton) => {
      const alike = figures.filter((figure) => figure.skeleton === skeleton);
      const rest = restPositions(skeleton);
      return skeleton.capsules.map((capsule) => {
        const [joint] = capsule;
        const geometry = bodyGeometry({ ...skeleton, capsules: [capsule] }).translate(...rest[joint].map((value) => -value));
        const mesh = new InstancedMesh(geometry, material, alike.length);
        mesh.frustumCulled = false;
        mesh.castShadow = true;
        return { mesh, joint, figures: alike };
      });
    });
    this.group = new Group().add(...this.parts.map(({ mesh }) => mesh));
  }

  paint(colors) {
    for (const { mesh, figures } of this.parts) {
      const [side] = mesh.geometry.userData.sides;
      figures.forEach(({ color }, k) => mesh.setColorAt(k, partColors(colors, color)[side]));
      mesh.instanceColor.needsUpdate = true;
    }
  }

  update() {
    for (const { mesh, joint, figures } of this.parts) {
      figures.forEach(({ bones }, k) => mesh.setMatrixAt(k, bones[joint].matrixWorld));
      mesh.instanceMatrix.needsUpdate = true;
    }
  }
}

// Sticks and heads of many characters in two draws. Bones have to be posed before `update`.
export class Sticks {
  constructor(figures, thickness = 0.022, plain = false) { // plain ones, of a crowd, are quicker to draw
    this.figures = figures;
    this.thickness = thickness;
    const bones = figures.reduce((sum, { skeleton }) => sum + skeleton.bones.length, 0);
    const rod = new CylinderGeometry(1, 1, 1, plain ? 3 : 6, 1, plain).translate(0, 0.5, 0);
    const material = plain ? new MeshBasicMaterial() : new MeshLambertMaterial();
    this.rods = new InstancedMesh(rod, material, bones);
    this.heads = new InstancedMesh(new SphereGeometry(0.1, plain ? 6 : 12, plain ? 4 : 8), material, figures.length);
    for (const mesh of [this.rods, this.heads]) {
      mesh.frustumCulled = false;
      mesh.castShadow = true;
    }
  }

  paint(colors) {
    let number = 0;
    this.figures.forEach(({ skeleton, color }, k) => {
      for (const [, , side] of skeleton.bones) {
        this.rods.setColorAt(number, new Color(side === "middle" && color ? color : colors[side]));
        number += 1;
      }
      this.heads.setColorAt(k, new Color(color || colors.middle));
    });
    for (const mesh of [this.rods, this.heads]) if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
  }

  update() {
    let number = 0;
    this.figures.forEach((figure, k) => {
      const { skeleton, bones, mesh: { visible } } = figure;
      const shown = figure.shown === undefined ? visible : figure.shown;
      for (const [joint, end] of skeleton.bones) {
        const { matrixWorld } = bones[joint];
        from.setFromMatrixPosition(matrixWorld);
        along.set(...end).applyMatrix4(matrixWorld).sub(from);
        const length = along.length();
        turned.setFromUnitVectors(UP, along.divideScalar(Math.max(length, 1e-9)));
        size.set(this.thickness, length, this.thickness).multiplyScalar(shown ? 1 : 0);
        this.rods.setMatrixAt(number, matrix.compose(from, turned, size));
        number += 1;
      }
      const { head } = skeleton;
      matrix.makeScale(0, 0, 0);
      if (head && shown) { // a little beyond the joint, away from the neck
        figure.joint(head[0], along);
        figure.joint(head[1], from);
        along.sub(from);
        along.setLength(0.07 + along.length()).add(from);
        matrix.makeTranslation(along);
      }
      this.heads.setMatrixAt(k, matrix);
    });
    this.rods.instanceMatrix.needsUpdate = true;
    this.heads.instanceMatrix.needsUpdate = true;
  }
}

const UP = new Vector3(0, 1, 0);
const from = new Vector3();
const along = new Vector3();
const size = new Vector3();
const turned = new Quaternion();
const matrix = new Matrix4();
