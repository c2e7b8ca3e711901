// What of three.js the pages use; scripts/three.sh bundles it into three.min.js.
export {
  AnimationClip, Bone, BoxGeometry, BufferAttribute, BufferGeometry, CircleGeometry, Color, CylinderGeometry, DirectionalLight,
  Float32BufferAttribute, Group, HemisphereLight, InstancedMesh, Line, LineBasicMaterial, LineDashedMaterial, LineSegments,
  Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial, Object3D, PCFShadowMap, PerspectiveCamera,
  PlaneGeometry, Quaternion, QuaternionKeyframeTrack, Raycaster, RingGeometry, Scene, ShaderMaterial, ShadowMaterial, Skeleton,
  SkinnedMesh, SphereGeometry, Spherical, Vector2, Vector3, VectorKeyframeTrack, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { BVHLoader } from "three/addons/loaders/BVHLoader.js";
export { GLTFExporter } from "three/addons/exporters/GLTFExporter.js";
