// The ground below the motion, where there is gravity, with a grid and shadows; the axes of the
// world, and a bar of a round length at the middle of the picture.
const SHADOW = 0.22, CELLS = 24;
let ground = null;

// The largest of 1, 2 or 5 times a power of ten that is at most `length`.
function round_length(length) {
  const power = 10 ** Math.floor(Math.log10(length) + 1e-9), part = length / power;
  return (part >= 5 ? 5 : part >= 2 ? 2 : 1) * power;
}

// A cloth of squares that fades away from the middle, as ends in a picture would look like walls.
function make_ground({ up, height, size }) {
  const THREE = MeshCat.THREE, cell = round_length(size / 6), half = CELLS * cell;
  const group = new THREE.Group(), points = [], colours = [];
  for (let i = -CELLS; i <= CELLS; i++) {
    for (let j = -CELLS; j < CELLS; j++) {
      for (const [x, y] of [[i, j], [i, j + 1]]) {
        const fade = Math.max(0, 1 - Math.hypot(x, y) / CELLS) ** 1.5;
        points.push(x * cell, y * cell, 0, y * cell, x * cell, 0);
        colours.push(fade, fade);
      }
    }
  }
  const order = [];  // pairs of ends: first those along y, then those along x
  for (let k = 0; k < points.length / 3; k += 4) order.push(k, k + 2, k + 1, k + 3);
  const lines = new THREE.BufferGeometry();
  lines.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  lines.setAttribute("color", new THREE.Float32BufferAttribute(
    colours.flatMap((fade) => [0.45, 0.49, 0.53, 0.55 * fade, 0.45, 0.49, 0.53, 0.55 * fade]), 4));
  lines.setIndex(order);
  const material = new THREE.LineBasicMaterial({
    vertexColors: true, transparent: true, depthWrite: false });
  group.add(new THREE.LineSegments(lines, material));
  const cloth = new THREE.Mesh(new THREE.PlaneGeometry(2 * half, 2 * half),
    new THREE.ShadowMaterial({ opacity: SHADOW, depthWrite: false }));
  cloth.receiveShadow = true;
  group.add(cloth);
  // A lamp without light of its own: bodies keep their shading, and only the cloth has shadows.
  const lamp = new THREE.DirectionalLight(0xffffff, 0);
  lamp.position.set(0.25 * size, 0.2 * size, 2 * size);
  lamp.castShadow = true;
  lamp.shadow.mapSize.set(1024, 1024);
  lamp.shadow.radius = 4;
  Object.assign(lamp.shadow.camera, {
    left: -size, right: size, bottom: -size, top: size, near: 0.01 * size, far: 5 * size });
  group.add(lamp, lamp.target);
  group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), new THREE.Vector3(...up));
  group.userData = { cell, height, up: new THREE.Vector3(...up) };
  return group;
}

// Below the middle of the picture, to whole squares: a camera that follows leaves no ground behind.
function place_ground() {
  const { cell, height, up } = ground.userData, root = body_root().object;
  const here = root.position.clone().negate().applyQuaternion(ground.quaternion.clone().invert());
  here.set(cell * Math.round(here.x / cell), cell * Math.round(here.y / cell), 0);
  ground.position.copy(here.applyQuaternion(ground.quaternion)).addScaledVector(up, height);
}

at_layout.push(() => {
  ground?.removeFromParent();
  ground = about.ground && make_ground(about.ground);
  if (ground) body_root().object.add(ground);
  element("scale").hidden = !about.panel;
});

// Length (m) of a pixel at the middle of the picture, 0 while there is none.
function pixel_size() {
  const camera = viewer.camera, high = pane.clientHeight;
  camera.updateMatrixWorld();
  const middle = viewer.controls.target.clone().applyMatrix4(camera.parent.matrixWorld);
  const distance = Math.abs(middle.applyMatrix4(camera.matrixWorldInverse).z);
  return high && 2 * distance * Math.tan(camera.fov * Math.PI / 360) / camera.zoom / high;
}

// Longest bar of the scale (pixels): one of two fifths of it is still wider than its text.
const SCALE = 150;

// Axes and scale change with the camera only.
let last_view = "";
at_frame.push(() => {
  if (ground) place_ground();
  if (element("scale").hidden) return;
  const camera = viewer.camera, THREE = MeshCat.THREE, high = pane.clientHeight;
  camera.updateMatrixWorld();
  const matrix = camera.matrixWorldInverse.elements;
  const view = `${matrix.map((x) => x.toPrecision(6))} ${high}`;
  if (view === last_view || !high) return;
  last_view = view;
  const pixel = pixel_size(), length = round_length(SCALE * pixel);
  element("length").style.width = `${length / pixel}px`;
  const units = [[1, "m"], [1e-3, "mm"], [1e-6, "\u00b5m"]];
  const [size, unit] = units.find(([size]) => length >= 0.999 * size) ?? units[2];
  element("length").textContent = `${+(length / size).toPrecision(3)} ${unit}`;
  // three.js has y upwards, and meshcat turns its whole scene.
  const towards = new THREE.Matrix4().extractRotation(
    camera.matrixWorldInverse.clone().multiply(viewer.scene.matrixWorld));
  ["x", "y", "z"].forEach((name, i) => {
    const axis = new THREE.Vector3().setComponent(i, 1).applyMatrix4(towards);
    const [x, y] = [28 + 18 * axis.x, 28 - 18 * axis.y];
    const line = element(`axis-${name}`), text = element(`name-${name}`);
    line.setAttribute("x2", x);
    line.setAttribute("y2", y);
    text.setAttribute("x", 28 + 25 * axis.x);
    text.setAttribute("y", 32 - 25 * axis.y);
    // An axis that points to the reader or away is a dot.
    text.style.visibility = Math.hypot(axis.x, axis.y) < 0.3 ? "hidden" : "visible";
  });
});
