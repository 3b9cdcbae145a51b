// What arview's pages use of three.js. `tools/vendor-web` makes three.min.js of it; names may be added.
export {
  AmbientLight, ArrowHelper, Box3, BufferAttribute, BufferGeometry, CanvasTexture, Color, ConeGeometry, CylinderGeometry,
  DirectionalLight, DoubleSide, EdgesGeometry, Float32BufferAttribute, FrontSide, Group, HemisphereLight, Line,
  LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial,
  OrthographicCamera, PerspectiveCamera, Points, PointsMaterial, Quaternion, Raycaster, SRGBColorSpace, Scene,
  Sphere, Sprite, SpriteMaterial, Texture, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
