// Floor, light, cameras and one renderer for all panels of a page: the player, crowds and the
// steering page share it. Lengths are metres, +Y is up.
import {
  Color, DirectionalLight, HemisphereLight, Mesh, PCFShadowMap, PerspectiveCamera, PlaneGeometry,
  Scene, ShaderMaterial, ShadowMaterial, Vector3, WebGLRenderer,
} from "three";

const FIELD = 30; // degrees from the bottom of a panel to its top
const FLOOR = 600; // metres from side to side: beyond the horizon of any camera of ours

// Lines every `step` metres, which fade before they would flicker; the floor fades into the sky.
function makeFloor() {
  const material = new ShaderMaterial({
    uniforms: {
      step: { value: 1 }, reach: { value: 40 },
      ground: { value: new Color() }, line: { value: new Color() }, sky: { value: new Color() },
    },
    vertexShader: `
      varying vec3 place;
      void main() {
        place = (modelMatrix * vec4(position, 1.0)).xyz;
        gl_Position = projectionMatrix * viewMatrix * vec4(place, 1.0);
      }`,
    fragmentShader: `
      uniform float step, reach;
      uniform vec3 ground, line, sky;
      varying vec3 place;
      void main() {
        vec2 cell = place.xz / step;
        vec2 width = fwidth(cell);
        vec2 near = abs(fract(cell - 0.5) - 0.5) / max(width, 1e-6);
        float drawn = (1.0 - min(min(near.x, near.y), 1.0)) * (1.0 - smoothstep(0.15, 0.6, max(width.x, width.y)));
        float away = smoothstep(0.25, 1.0, distance(place, cameraPosition) / reach);
        gl_FragColor = vec4(mix(mix(ground, line, drawn), sky, away), 1.0);
        #include <colorspace_fragment>
      }`,
  });
  const floor = new Mesh(new PlaneGeometry(FLOOR, FLOOR).rotateX(-Math.PI / 2), material);
  floor.frustumCulled = false;
  return floor;
}

// One panel: a scene with floor and light, and a camera that looks at a point from an offset.
export class View {
  constructor(element) {
    this.element = element;
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD, 1, 0.05, FLOOR);
    this.target = new Vector3(0, 0.9, 0);
    this.floor = makeFloor();
    this.shadow = new Mesh(new PlaneGeometry(1, 1).rotateX(-Math.PI / 2), new ShadowMaterial({ opacity: 0.3 }));
    this.shadow.receiveShadow = true;
    this.shadow.material.polygonOffset = true; // over the floor, without flicker
    this.shadow.material.polygonOffsetFactor = -1;
    this.shadow.renderOrder = 1;
    this.sky = new HemisphereLight(0xffffff, 0xa8a8a8, 2.3);
    this.sun = new DirectionalLight(0xffffff, 2.1);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.bias = -0.002;
    this.scene.add(this.floor, this.shadow, this.sky, this.sun, this.sun.target);
    this.light(3);
  }

  // Let shadows fall within so many metres around the target.
  light(radius) {
    const { camera } = this.sun.shadow;
    [camera.left, camera.right, camera.top, camera.bottom] = [-radius, radius, radius, -radius];
    [camera.near, camera.far] = [1, 6 * radius + 20];
    camera.updateProjectionMatrix();
    this.radius = radius;
    this.shadow.scale.set(3 * radius, 1, 3 * radius);
  }

  paint({ panel, floor, grid, dark }) {
    this.scene.background = new Color(panel);
    const { uniforms } = this.floor.material;
    uniforms.sky.value.set(panel);
    uniforms.ground.value.set(floor);
    uniforms.line.value.set(grid);
    this.shadow.material.opacity = dark ? 0.55 : 0.28;
  }

  // Look at a point from an offset (a Vector3).
  aim(target, offset) {
    this.target.copy(target);
    this.camera.position.copy(target).add(offset);
    if (this.camera.position.y < 0.05) this.camera.position.y = 0.05;
    this.camera.up.set(0, 1, 0);
    this.camera.lookAt(target);
    this.camera.updateMatrixWorld();
    this.floor.position.set(Math.round(target.x), 0, Math.round(target.z));
    this.floor.material.uniforms.reach.value = Math.max(40, 5 * offset.length());
    this.shadow.position.set(target.x, 0.002, target.z);
    this.sun.target.position.set(target.x, 0, target.z);
    this.sun.position.set(target.x, 0, target.z).add(SUN.clone().multiplyScalar(2 * this.radius + 8));
  }

  // Where a point is on the page's panel, in CSS pixels from its left and top; null if it is behind.
  onPanel(point, width, height) {
    const seen = point.clone().project(this.camera);
    if (seen.z > 1) return null;
    return [(seen.x + 1) / 2 * width, (1 - seen.y) / 2 * height];
  }
}

const SUN = new Vector3(0.45, 1, 0.3).normalize();

// A canvas behind all panels of an element; each panel is a window on it.
export class Stage {
  constructor(element) {
    this.element = element;
    this.renderer = new WebGLRenderer({ antialias: true, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.setScissorTest(true);
    this.canvas = this.renderer.domElement;
    this.canvas.setAttribute("aria-hidden", "true");
    element.prepend(this.canvas);
    this.views = [];
    const gl = this.renderer.getContext();
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const by = gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    this.software = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(by); // no graphics card
  }

  add(element) {
    const view = new View(element);
    this.views.push(view);
    return view;
  }

  resize() {
    const box = this.element.getBoundingClientRect();
    this.width = box.width;
    this.height = box.height;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.renderer.setSize(box.width, box.height);
    for (const view of this.views) {
      const own = view.element.getBoundingClientRect();
      view.box = [own.left - box.left, box.bottom - own.bottom, own.width, own.height];
      view.camera.aspect = own.width / Math.max(own.height, 1);
      view.camera.updateProjectionMatrix();
    }
  }

  draw() {
    for (const view of this.views) {
      this.renderer.setViewport(...view.box);
      this.renderer.setScissor(...view.box);
      this.renderer.render(view.scene, view.camera);
    }
  }

  castShadows(wanted) {
    for (const view of this.views) view.sun.castShadow = view.shadow.visible = wanted;
  }

  // Milliseconds that a picture takes until its pixels are there.
  cost(times = 3) {
    const gl = this.renderer.getContext();
    const pixel = new Uint8Array(4);
    const whole = () => { this.draw(); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); };
    whole(); // the first one compiles
    const began = performance.now();
    let made = 0;
    while (made < times && (!made || performance.now() - began < 200)) {
      whole();
      made += 1;
    }
    return (performance.now() - began) / made;
  }
}
