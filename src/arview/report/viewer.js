// The viewer of the report: components at their design and measured positions, cloud, arrows. Needs the global THREE and
// the elements #scene (JSON, see scene.py) and #viewer. It draws only when something changes.
"use strict";
(() => {
  const host = document.getElementById("viewer");
  const source = document.getElementById("scene");
  if (!host || !source) return;
  const COLORS = { pass: 0x2fbf86, fail: 0xf0564f, undecided: 0xf0b13c, measured: 0x5aa0e6, not_measured: 0x8ea3bd, none: 0xb9c2cc };
  const VERDICT_TEXTS = { pass: "pass", fail: "fail", undecided: "undecided", measured: "measured", not_measured: "not measured" };

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const points = (pack) => {
    const whole = new Uint16Array(bytes(pack.points).buffer);
    const out = new Float32Array(whole.length);
    for (let i = 0; i < whole.length; i++) out[i] = pack.low[i % 3] + whole[i] * pack.step[i % 3];
    return out;
  };
  const number = (value, digits = 3) =>
    value === null || value === undefined ? "undetermined" : value.toFixed(digits).replace("-", "−");

  function start() {
    const scene = JSON.parse(source.textContent);
    const stage = host.querySelector(".stage");
    let renderer;
    try {
      renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    } catch (error) {
      host.classList.add("flat");
      host.querySelector(".viewer-note").textContent =
        "This browser does not support WebGL, which the 3D view needs; the pictures do not need it.";
      return;
    }
    host.classList.add("live");
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    stage.appendChild(renderer.domElement);
    renderer.domElement.setAttribute("aria-label", "3D view of the part; drag to rotate, scroll or pinch to zoom");
    const world = new THREE.Scene();
    world.background = new THREE.Color(0x1f252e);
    world.add(new THREE.HemisphereLight(0xffffff, 0x5a6470, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    world.add(sun);
    const camera = new THREE.PerspectiveCamera(32, 1, 1, 10000);
    camera.up.set(0, 0, 1);
    const controls = new THREE.OrbitControls(camera, renderer.domElement);
    controls.enableDamping = false;
    const groups = { design: new THREE.Group(), measured: new THREE.Group(), cloud: new THREE.Group(),
                     arrows: new THREE.Group(), names: new THREE.Group(), uncovered: new THREE.Group() };
    for (const key of ["design", "measured", "cloud", "arrows", "uncovered"]) world.add(groups[key]);

    const box = new THREE.Box3();
    const pickable = [];
    const edgeMaterial = new THREE.LineBasicMaterial({ color: 0xdfe7ef, transparent: true, opacity: 0.55 });
    if (scene.mesh) {
      const position = new THREE.BufferAttribute(points(scene.mesh), 3);
      const faces = new Uint32Array(bytes(scene.mesh.faces).buffer);
      scene.components.forEach((component, index) => {
        const [first, last] = scene.mesh.ranges[index];
        // Faces share no vertices, for flat shading and sharp edges.
        const mine = faces.subarray(3 * first, 3 * last);
        const flat = new Float32Array(3 * mine.length);
        for (let i = 0; i < mine.length; i++)
          for (let k = 0; k < 3; k++) flat[3 * i + k] = position.array[3 * mine[i] + k];
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("position", new THREE.BufferAttribute(flat, 3));
        geometry.computeVertexNormals();
        geometry.computeBoundingBox();
        box.union(geometry.boundingBox);
        const edges = new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 30), edgeMaterial);
        const isContext = component.verdict === null;
        const ghost = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({
          color: isContext ? 0x77828f : 0xcfd8e2, transparent: true, opacity: isContext ? 0.28 : 0.2,
          depthWrite: false, side: THREE.DoubleSide }));
        groups.design.add(ghost, edges);
        if (component.place && !component.missing) {
          const solid = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({
            color: COLORS[component.verdict], side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1 }));
          const place = new THREE.Matrix4();
          place.set(...component.place);
          solid.matrixAutoUpdate = false;
          solid.matrix.copy(place);
          solid.userData.component = component;
          groups.measured.add(solid);
          pickable.push(solid);
        }
        ghost.userData.component = component;
        pickable.push(ghost);
      });
    }
    for (const one of scene.foreign || []) {
      const geometry = new THREE.BufferGeometry();
      const low = one.center.map((v, k) => v - one.size[k] / 2), high = one.center.map((v, k) => v + one.size[k] / 2);
      const corner = (i) => [0, 1, 2].map((k) => (i >> k & 1 ? high[k] : low[k]));
      const ends = [];
      for (let a = 0; a < 8; a++)
        for (const bit of [1, 2, 4]) if (!(a & bit)) ends.push(...corner(a), ...corner(a | bit));
      geometry.setAttribute("position", new THREE.Float32BufferAttribute(ends, 3));
      groups.arrows.add(new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: 0xffd60a })));
    }

    // ---- surfaces that no two photos saw: the CAD model stands in for them, hatched in the plane
    // of the picture. Faces that look away are left out: the design is transparent, and the underside would show.
    if (scene.uncovered && scene.uncovered.points) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(points(scene.uncovered), 3));
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({
        color: 0xc9a227, side: THREE.FrontSide, polygonOffset: true, polygonOffsetFactor: -1, polygonOffsetUnits: -1 });
      const period = (9 * renderer.getPixelRatio()).toFixed(1), width = (3.5 * renderer.getPixelRatio()).toFixed(1);
      material.onBeforeCompile = (shader) => {
        shader.fragmentShader = shader.fragmentShader.replace("void main() {",
          `void main() {\n  if (mod(gl_FragCoord.x + gl_FragCoord.y, ${period}) > ${width}) discard;`);
      };
      groups.uncovered.add(new THREE.Mesh(geometry, material));
    }

    // ---- the cloud, coloured by the photos or by distance
    let cloud = null, distances = null, photo = null;
    if (scene.cloud) {
      const geometry = new THREE.BufferGeometry();
      const places = points(scene.cloud);
      geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
      geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(places.length), 3, true));
      if (!scene.mesh) { geometry.computeBoundingBox(); box.union(geometry.boundingBox); }
      cloud = new THREE.Points(geometry, new THREE.PointsMaterial({ size: 1, vertexColors: true }));
      groups.cloud.add(cloud);
      if (scene.cloud.colors) photo = bytes(scene.cloud.colors);
      if (scene.cloud.distances) distances = new Int16Array(bytes(scene.cloud.distances).buffer);
    }
    const linear = new Uint8Array(256).map((_, i) => Math.round(255 * (i / 255) ** 2.2));
    function paintCloud(mode, limit) {
      if (!cloud) return;
      const color = cloud.geometry.getAttribute("color");
      const stops = scene.stops;
      for (let i = 0; i < color.count; i++) {
        for (let k = 0; k < 3; k++) {
          let value = 120;
          if (mode === "photo" && photo) value = photo[3 * i + k];
          else if (distances && distances[i] !== -32768) {
            const share = Math.min(Math.max(0.5 + distances[i] / 2000 / limit, 0), 1) * (stops.length - 1);
            const low = Math.min(Math.floor(share), stops.length - 2);
            value = stops[low][k] + (share - low) * (stops[low + 1][k] - stops[low][k]);
          }
          color.array[3 * i + k] = linear[Math.round(value)];
        }
      }
      color.needsUpdate = true;
    }

    // ---- exaggerated arrows from the design position
    const diameter = box.getSize(new THREE.Vector3()).length();
    const middle = box.getCenter(new THREE.Vector3());
    function drawArrows(scale) {
      for (const old of groups.arrows.children.filter((one) => one.userData.isArrow)) groups.arrows.remove(old);
      for (const component of scene.components) {
        if (!component.center || component.distance == null || component.distance <= component.uncertainty) continue;
        const along = new THREE.Vector3(...component.displacement.map((value) => value || 0));
        const length = along.length() * scale;
        if (length < 1e-9) continue;
        const width = Math.min(0.008 * diameter, 0.2 * length), head = Math.min(4 * width, 0.6 * length);
        const color = new THREE.MeshBasicMaterial({ color: 0xffffff, depthTest: false, transparent: true });
        const shaft = new THREE.Mesh(new THREE.CylinderGeometry(width / 2, width / 2, length - head, 12), color);
        const tip = new THREE.Mesh(new THREE.ConeGeometry(1.1 * width, head, 16), color);
        shaft.position.y = (length - head) / 2;
        tip.position.y = length - head / 2;
        const arrow = new THREE.Group();
        arrow.add(shaft, tip);
        arrow.renderOrder = shaft.renderOrder = tip.renderOrder = 10;
        arrow.position.set(...component.center);
        arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.normalize());
        arrow.userData.isArrow = true;
        groups.arrows.add(arrow);
      }
    }

    // ---- names over the view
    const names = host.querySelector(".names");
    const labels = scene.components.filter((c) => c.center && c.verdict && c.verdict !== "pass").map((component) => {
      const label = document.createElement("span");
      label.className = "name " + component.verdict;
      label.textContent = component.name;
      names.appendChild(label);
      return [label, new THREE.Vector3(...component.center)];
    });

    const panel = host.querySelector(".about");
    function showDetails(component) {
      panel.textContent = "";
      const title = document.createElement("strong");
      title.textContent = component.name;
      panel.appendChild(title);
      const line = (text) => { const p = document.createElement("div"); p.textContent = text; panel.appendChild(p); };
      if (component.verdict === null) line("not inspected");
      else if (component.missing) line("fail: missing");
      else {
        line(VERDICT_TEXTS[component.verdict]);
        if (component.distance != null) line(`distance ${number(component.distance, component.digits)} ± ${number(component.uncertainty, component.digits)} mm`);
        component.displacement.forEach((value, k) => line(`d${"xyz"[k]} ${number(value, component.digits)}${value === null ? "" : " mm"}`));
      }
      const share = scene.uncovered ? scene.uncovered.shares[scene.components.indexOf(component)] : 0;
      if (share >= 0.005) line(`${Math.round(100 * share)} % of its surface was seen by fewer than two photos`);
      panel.hidden = false;
    }

    // ---- drawing, only when needed
    let isRequested = false;
    const requestDraw = () => { if (!isRequested) { isRequested = true; requestAnimationFrame(draw); } };
    function draw() {
      isRequested = false;
      sun.position.copy(camera.position);
      renderer.render(world, camera);
      const { width, height } = stage.getBoundingClientRect();
      for (const [label, place] of labels) {
        const at = place.clone().project(camera);
        const shown = groups.names.visible && at.z < 1 && Math.abs(at.x) < 1 && Math.abs(at.y) < 1;
        label.hidden = !shown;
        if (shown) label.style.transform =
          `translate(${((at.x + 1) / 2) * width}px, ${((1 - at.y) / 2) * height}px) translate(-50%, -190%)`;
      }
    }
    const VIEWS = { iso: [0.6, -0.8, 0.75], top: [0, -0.001, 1], front: [0, -1, 0.001], right: [1, 0, 0.001] };
    let view = VIEWS.iso, isMoved = false;
    controls.addEventListener("start", () => { isMoved = true; });
    function resize() {
      const { width, height } = stage.getBoundingClientRect();
      if (width < 2 || height < 2) return;
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      if (cloud) cloud.material.size = diameter / 320;
      if (!isMoved) setView(...view);
      requestDraw();
    }
    function setView(x, y, z) {
      // The nearest position from which the whole bounding box is visible.
      const towards = new THREE.Vector3(x, y, z).normalize();
      let distance = 2 * diameter;
      for (let i = 0; i < 5; i++) {
        camera.position.copy(middle).addScaledVector(towards, distance);
        camera.near = distance / 100;
        camera.far = distance * 10;
        camera.updateProjectionMatrix();
        camera.lookAt(middle);
        camera.updateMatrixWorld();
        let widest = 0;
        for (let k = 0; k < 8; k++) {
          const corner = new THREE.Vector3(k & 1 ? box.max.x : box.min.x, k & 2 ? box.max.y : box.min.y,
                                           k & 4 ? box.max.z : box.min.z).project(camera);
          widest = Math.max(widest, Math.abs(corner.x), Math.abs(corner.y));
        }
        distance *= widest / 0.92;
      }
      controls.target.copy(middle);
      controls.update();
      requestDraw();
    }
    controls.addEventListener("change", requestDraw);

    const settings = host.querySelector(".controls");
    const value = (name) => settings.querySelector(`[name="${name}"]`);
    function apply() {
      for (const key of Object.keys(groups)) {
        const input = value(key);
        if (input) groups[key].visible = input.checked;
      }
      const mode = value("color"), limit = value("limit");
      if (mode) {
        paintCloud(mode.value, Number(limit.value));
        const legend = host.querySelector(".scale");
        legend.hidden = mode.value !== "distance" || !groups.cloud.visible;
        legend.querySelector(".low").textContent = `−${limit.value}`;
        legend.querySelector(".high").textContent = `+${limit.value} mm`;
      }
      if (scene.mesh) drawArrows(Number(value("exaggeration").value));
      requestDraw();
    }
    settings.addEventListener("input", apply);
    settings.addEventListener("click", (event) => {
      const chosen = VIEWS[event.target.dataset && event.target.dataset.view];
      if (!chosen) return;
      view = chosen;
      isMoved = false;
      setView(...view);
    });
    let pressed = null;
    renderer.domElement.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
    renderer.domElement.addEventListener("pointerup", (event) => {
      if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 5) return;
      const area = renderer.domElement.getBoundingClientRect();
      const at = new THREE.Vector2(((event.clientX - area.left) / area.width) * 2 - 1,
                                   1 - ((event.clientY - area.top) / area.height) * 2);
      const ray = new THREE.Raycaster();
      ray.setFromCamera(at, camera);
      // Inspected components take precedence over the others.
      const hits = ray.intersectObjects(pickable, false);
      const hit = hits.find((one) => one.object.userData.component.verdict !== null) || hits[0];
      if (hit) showDetails(hit.object.userData.component); else panel.hidden = true;
    });
    new ResizeObserver(resize).observe(stage);
    resize();
    apply();
    host.dataset.state = "ready";
  }

  // Start when the viewer comes near the viewport, or some time after the page has loaded.
  let isStarted = false;
  const once = () => { if (!isStarted) { isStarted = true; start(); } };
  if ("IntersectionObserver" in window)
    new IntersectionObserver((entries) => { if (entries.some((entry) => entry.isIntersecting)) once(); },
                             { rootMargin: "400px" }).observe(host);
  addEventListener("load", () => setTimeout(once, 1500));
})();
