// The position of a crank in place of the time, and bodies that are dragged along their paths.
const PLACES = 360, SMALLEST_PATH = 8;  // pixels
let grip = null;  // of a dragged body: the path of its point in the window, and the place there

const repetition = () => about.crank && !about.crank.closed
  ? MeshCat.THREE.LoopPingPong : MeshCat.THREE.LoopRepeat;

function crank_position(time) {
  const { samples, unit } = about.crank;
  const range = Math.max(...samples) - Math.min(...samples);
  const digits = unit === "\u00b0" ? 1 : Math.max(3 + Math.ceil(-Math.log10(range)), 0);
  return fixed(value_at(about.crank, time), digits);
}
function crank_text(time) {
  const { label, unit } = about.crank;
  return `${label} ${crank_position(time)}${unit === "\u00b0" ? "" : " "}${unit}`;
}

at_layout.push(() => {
  if (!about.crank) return;
  seek(about.crank.start);
  slider.setAttribute("aria-label", `position of ${about.crank.label}`);
  element("panel").setAttribute("aria-label", "values of the position");
});

// The places in the window (pixels) of a point of a body, in coordinates of the body.
function path_in_window(body, point) {
  const now = animator.time, box = pane.getBoundingClientRect(), camera = viewer.camera;
  camera.updateMatrixWorld();
  const path = [];
  for (let i = 0; i <= PLACES; i++) {
    animator.seek(animator.duration * i / PLACES);
    body.updateMatrix();
    const place = point.clone().applyMatrix4(body.matrix)
      .applyMatrix4(body.parent.matrixWorld).project(camera);
    path.push([box.left + 0.5 * (1 + place.x) * box.width,
      box.top + 0.5 * (1 - place.y) * box.height]);
  }
  animator.seek(now);
  return path;
}

// From its place the point goes along its path for as long as it comes closer to the pointer: it
// does not jump to another part of the path, nor over a dead centre.
function drag(x, y) {
  const { path } = grip, closed = about.crank.closed;
  const wrapped = (i) => closed ? (i + PLACES) % PLACES : Math.min(Math.max(i, 0), PLACES);
  const off = (i) => Math.hypot(path[i][0] - x, path[i][1] - y);
  let place = grip.place;
  for (const way of [1, -1]) {
    for (let i = wrapped(place + way); off(i) < off(place); i = wrapped(place + way)) place = i;
  }
  grip.place = place;
  // Between two places the path is straight.
  let best = place, least = off(place);
  for (const way of [1, -1]) {
    const next = wrapped(place + way), [ax, ay] = path[place];
    const [dx, dy] = [path[next][0] - ax, path[next][1] - ay], size = dx * dx + dy * dy;
    if (!size) continue;
    const part = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / size, 0), 1);
    const left = Math.hypot(ax + part * dx - x, ay + part * dy - y);
    if (left < least) [best, least] = [place + way * part, left];
  }
  seek(inside(animator.duration * best / PLACES));
}

pane.addEventListener("pointerdown", (event) => {
  if (!about.crank || !event.isPrimary || event.button !== 0) return;
  const { node, place } = body_below(event.clientX, event.clientY);
  if (!node) return;
  const body = body_root().children[node].object;
  const path = path_in_window(body, body.worldToLocal(place.clone()));
  const size = (k) => Math.max(...path.map((p) => p[k])) - Math.min(...path.map((p) => p[k]));
  // What hardly moves is no handle: the picture is turned instead.
  if (Math.max(size(0), size(1)) < SMALLEST_PATH) return;
  const at = Math.round(PLACES * animator.time / animator.duration);
  grip = { path, place: about.crank.closed ? at % PLACES : at, pointer: event.pointerId };
  viewer.controls.enabled = false;
  pane.setPointerCapture(event.pointerId);
}, true);
pane.addEventListener("pointermove", (event) => {
  if (grip?.pointer === event.pointerId) drag(event.clientX, event.clientY);
  else pane.style.cursor = about.crank && hovered ? "grab" : "";
});
const release = (event) => {
  if (grip?.pointer !== event.pointerId) return;
  grip = null;
  viewer.controls.enabled = true;
};
pane.addEventListener("pointerup", release);
pane.addEventListener("pointercancel", release);
