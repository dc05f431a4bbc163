// Plays what `scene` holds, or what the server of this page sends if it is null, with the values,
// passages and notes of `about`.
const SPEEDS = [0.01, 0.1, 0.25, 0.5, 1, 2, 4];

var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
if (scene === null) viewer.connect();
else for (const text of scene) {
  const bytes = atob(text), buffer = new Uint8Array(bytes.length);
  for (let i = 0; i < bytes.length; i++) buffer[i] = bytes.charCodeAt(i);
  viewer.handle_command_bytearray(buffer);
}

// The picture is made for one shape of window: step back in a narrower one.
function step_back() {
  const narrow = about.aspect * window.innerHeight / window.innerWidth;
  if (narrow > 1) viewer.camera.position.multiplyScalar(narrow);
}

const element = (id) => document.getElementById(id);
const animator = viewer.animator, slider = element("time"), clock = document.querySelector("output");

// Panel: time, and the values of the run there, interpolated between their samples.
const cells = [];
function add_row(label, unit) {
  const row = document.querySelector("#panel table").insertRow();
  for (const text of [label, "", unit]) row.insertCell().textContent = text;
  cells.push(row.cells[1]);
}
if (about.panel) add_row("t", "s");
for (const value of about.values) add_row(value.label, value.unit);
for (const note of about.notes) {
  const text = element("notes").appendChild(document.createElement("div"));
  text.textContent = note.text;
  if (!note.ramp) continue;
  const ramp = element("notes").appendChild(document.createElement("div"));
  ramp.className = "ramp";
  ramp.style.background = `linear-gradient(to right, ${note.ramp.join(", ")})`;
  const ends = element("notes").appendChild(document.createElement("div"));
  ends.className = "ends";
  for (const end of note.ends) ends.appendChild(document.createElement("span")).textContent = end;
}
element("panel").hidden = !about.panel && !about.notes.length;

function value_at(samples, time) {
  const times = about.times;
  let low = 0, high = times.length - 1;
  if (time <= times[0]) return samples[0];
  if (time >= times[high]) return samples[high];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  const before = samples[low], after = samples[high];
  // A value that was not finite is null: nothing is shown around it.
  if (before === null || after === null) return null;
  return before + (after - before) * (time - times[low]) / (times[high] - times[low]);
}

function shown(value) {
  if (value === null) return "–";
  const size = Math.abs(value);
  if (size === 0) return "0";
  return (size >= 1e-3 && size < 1e4 ? value.toPrecision(3) : value.toExponential(2))
    .replace("-", "\u2212").replace("e-", "e\u2212").replace("e+", "e");
}

// Bar: meshcat's own controls remain under "Open Controls".
for (const speed of SPEEDS) {
  const option = element("speed").appendChild(document.createElement("option"));
  option.value = speed;
  option.textContent = `${speed}\u00d7`;
  option.selected = speed === 1;
}
function seek(time) {
  animator.pause();
  animator.seek(time);
  animator.display_progress(time);
}
slider.oninput = () => seek(+slider.value);
element("toggle").onclick = () => animator.playing ? animator.pause() : animator.play();
element("speed").onchange = () => { animator.mixer.timeScale = +element("speed").value; };
element("loop").onchange = () => {
  for (const action of animator.actions) {
    if (element("loop").checked) action.setLoop(MeshCat.THREE.LoopRepeat, Infinity);
    else action.setLoop(MeshCat.THREE.LoopOnce, 1);
  }
};

let laid_out = null;
// The animation comes with the scene, or later from the server.
function lay_out() {
  laid_out = animator.actions;
  element("bar").hidden = animator.duration === 0;
  slider.max = animator.duration;
  element("marks").replaceChildren(...about.passages.map(({ time, text }) => {
    const mark = document.createElement("span");
    mark.style.left = `${100 * (time - about.start) / animator.duration}%`;
    mark.title = text;
    mark.onclick = () => seek(time - about.start);
    return mark;
  }));
  element("speed").onchange();
  if (scene !== null || animator.duration > 0) step_back();
}

(function show() {
  if (laid_out !== animator.actions) lay_out();
  slider.value = animator.time;
  element("toggle").textContent = animator.playing ? "Pause" : "Play";
  const digits = animator.duration > 0 && animator.duration < 1 ? 4 : 2;
  clock.value = `${animator.time.toFixed(digits)} / ${animator.duration.toFixed(digits)} s`;
  // While a run is computed there is no animation, and the server moves this node with the time.
  const computed = about.live && animator.duration === 0;
  const time = computed ? viewer.scene_tree.find(["live"]).object.position.x
    : about.start + animator.time;
  if (about.panel) cells[0].textContent = time.toFixed(digits + 1);
  about.values.forEach((value, i) => {
    cells[i + 1].textContent = shown(value_at(value.samples, time));
  });
  requestAnimationFrame(show);
})();
