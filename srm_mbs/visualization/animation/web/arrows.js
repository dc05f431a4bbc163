// Straight arrows of forces, and curved ones of moments, in three objects of many instances.
const THIN = 0.0035, HEAD = 0.028, WIDE = 0.0095;  // over the size of the picture
const ARC = 1.5 * Math.PI, TUBE = 0.045;  // of a curved arrow of radius 1
let arrows = null;  // shafts, arcs, heads, and the vectors of each arrow
let arrows_shown = true;

function vectors_of(text) {
  const bytes = atob(text), buffer = new Uint8Array(bytes.length);
  for (let i = 0; i < bytes.length; i++) buffer[i] = bytes.charCodeAt(i);
  return new Float32Array(buffer.buffer);
}

function make_arrows({ arrows: all, size }) {
  const THREE = MeshCat.THREE;
  // Drawn in front, as joints lie within the bodies.
  const material = new THREE.MeshPhongMaterial({
    depthTest: false, transparent: true, opacity: 0.92, shininess: 10 });
  const parts = (shape, colours) => {
    const mesh = new THREE.InstancedMesh(shape, material, colours.length);
    colours.forEach((colour, i) => mesh.setColorAt(i, new THREE.Color(...colour)));
    return Object.assign(mesh, { frustumCulled: false, renderOrder: 1, raycast: () => {} });
  };
  const colours = (kind) =>
    all.filter((arrow) => arrow.kind === kind).map(({ colour }) => colour);
  return {
    all, size,
    vectors: all.map(({ vectors }) => vectors_of(vectors)),
    shafts: parts(new THREE.CylinderGeometry(1, 1, 1, 10, 1, true).translate(0, 0.5, 0),
      colours("force")),
    arcs: parts(new THREE.TorusGeometry(1, TUBE, 6, 40, ARC), colours("moment")),
    heads: parts(new THREE.ConeGeometry(1, 1, 14).translate(0, 0.5, 0),
      all.map(({ colour }) => colour)),
  };
}

// Force or moment of an arrow at a time of the run, null while it does not act.
function vector_at(i, time) {
  const times = about.arrows.times, vectors = arrows.vectors[i];
  let low = 0, high = times.length - 1;
  time = Math.min(Math.max(time, times[0]), times[high]);
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  const part = high > low ? (time - times[low]) / (times[high] - times[low]) : 0;
  const found = [0, 1, 2].map((k) => part === 1 ? vectors[3 * high + k]
    : vectors[3 * low + k] + (part && part * (vectors[3 * high + k] - vectors[3 * low + k])));
  return found.every(Number.isFinite) ? found : null;
}

// Just before each picture, when the bodies are in their places.
function place_arrows() {
  if (!arrows) return;
  const THREE = MeshCat.THREE, { all, size, shafts, arcs, heads } = arrows;
  const time = about.start + animator.time, nodes = body_root().children;
  const [x, y, z] = [0, 1, 2].map((i) => new THREE.Vector3().setComponent(i, 1));
  const matrix = new THREE.Matrix4(), none = new THREE.Matrix4().makeScale(0, 0, 0);
  const start = new THREE.Vector3(), end = new THREE.Vector3(), along = new THREE.Vector3();
  const turn = new THREE.Quaternion(), scale = new THREE.Vector3();
  const sideways = new THREE.Quaternion().setFromUnitVectors(y, x);
  const next = { force: 0, moment: 0 };
  all.forEach(({ kind, on, source, node, point }, i) => {
    const lines = kind === "force" ? shafts : arcs, own = next[kind]++;
    const { length: per, longest } = about.arrows.scales[kind];
    // Of a chosen body: what acts on it.
    const acts = !chosen || on === chosen || source === chosen;
    const vector = arrows_shown && acts && vector_at(i, time);
    const length = vector ? Math.min(per * Math.hypot(...vector), longest) : 0;
    if (length < 1e-3 * size) {
      lines.setMatrixAt(own, none);
      heads.setMatrixAt(i, none);
      return;
    }
    along.set(...vector).normalize();
    if (chosen && on !== chosen) along.negate();
    start.set(...point);
    const body = nodes[node]?.object;
    if (body) {
      body.updateMatrix();
      start.applyMatrix4(body.matrix);
    }
    // The head of a short arrow is smaller.
    const tip = Math.min(HEAD * size, 0.6 * length), part = tip / (HEAD * size);
    if (kind === "force") {
      turn.setFromUnitVectors(y, along);
      const thin = THIN * size * Math.min(1, 2.5 * part);
      lines.setMatrixAt(own, matrix.compose(start, turn, scale.set(thin, length - tip, thin)));
      end.copy(start).addScaledVector(along, length - tip);
    } else {
      turn.setFromUnitVectors(z, along);
      lines.setMatrixAt(own, matrix.compose(start, turn, scale.setScalar(length)));
      end.set(0, -length, 0).applyQuaternion(turn).add(start);
      turn.multiply(sideways);
    }
    scale.set(WIDE * size * part, tip, WIDE * size * part);
    heads.setMatrixAt(i, matrix.compose(end, turn, scale));
  });
  for (const mesh of [shafts, arcs, heads]) mesh.instanceMatrix.needsUpdate = true;
}
viewer.scene.onBeforeRender = place_arrows;

function toggle_arrows() {
  if (!arrows) return;
  arrows_shown = !arrows_shown;
  element("show-arrows").setAttribute("aria-pressed", arrows_shown);
  viewer.set_dirty();
}
element("show-arrows").onclick = KEYS.f = toggle_arrows;

// Sizes of forces and moments, among the values of the body that they act on.
function add_sizes() {
  about.arrows.sized = true;
  about.arrows.arrows.forEach(({ label, kind, on, source }, i) => {
    const vectors = arrows.vectors[i], samples = [];
    for (let k = 0; k < vectors.length; k += 3) {
      const size = Math.hypot(vectors[k], vectors[k + 1], vectors[k + 2]);
      samples.push(Number.isFinite(size) ? size : null);
    }
    const body = on === "world" && source ? source : on;
    about.values.push({ label, unit: about.arrows.scales[kind].unit, samples, body,
      times: about.arrows.times });
  });
}

at_layout.push(() => {
  if (arrows) body_root().object.remove(arrows.shafts, arrows.arcs, arrows.heads);
  arrows = about.arrows && make_arrows(about.arrows);
  element("show-arrows").hidden = !arrows;
  element("show-arrows").setAttribute("aria-pressed", arrows_shown);
  if (!arrows) return;
  body_root().object.add(arrows.shafts, arrows.arcs, arrows.heads);
  if (about.panel && !about.arrows.sized) add_sizes();
});

// The bars of the legend, of round values, at the middle of the picture.
at_frame.push(() => {
  const pixel = arrows && pixel_size();
  if (!pixel) return;
  for (const bar of document.querySelectorAll("#notes .bar")) {
    const { length, unit } = about.arrows.scales[bar.dataset.kind];
    const value = round_length(90 * pixel / length);
    bar.firstChild.style.width = `${value * length / pixel}px`;
    const what = bar.dataset.kind === "moment" ? " (radius)" : "";
    const text = `${+value.toPrecision(3)} ${unit}${what}`;
    if (bar.lastChild.textContent !== text) bar.lastChild.textContent = text;
  }
});
