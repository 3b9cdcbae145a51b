// What arview's pages use of three.js. `tools/vendor-web` makes three.min.js of it; names may be added.
export {
  AmbientLight, ArrowHelper, Box3, BufferAttribute, BufferGeometry, Camera, CanvasTexture, ClampToEdgeWrapping, Color,
  ConeGeometry, CustomBlending, CylinderGeometry, DirectionalLight, DoubleSide, DynamicDrawUsage, EdgesGeometry,
  Float32BufferAttribute, FrontSide, GLSL3, Group, HemisphereLight, Line, LinearFilter,
  LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial,
  NearestFilter, NoBlending, NoColorSpace, OneFactor, OneMinusSrcAlphaFactor, OrthographicCamera, PerspectiveCamera,
  Points, PointsMaterial, Quaternion, RawShaderMaterial, Raycaster, RGBAFormat, SRGBColorSpace, Scene, Sphere, Sprite,
  SpriteMaterial, Texture, UnsignedByteType, Vector2, Vector3, Vector4, WebGLRenderer, WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
