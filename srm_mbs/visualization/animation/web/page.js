// Plays what `scene` holds, or what the server of this page sends if it is null, with the values,
// passages and notes of `about`.
const SPEEDS = [0.01, 0.1, 0.25, 0.5, 1, 2, 4];

var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
// A run that is computed comes as one transform, for a node of its own: a block of 4 x 4 with the
// time and the values for the panel in its first column, and one for each body.
let state = [0];
const set_transform = viewer.set_transform;
viewer.set_transform = (path, matrix) => {
  if (path.length !== 1 || path[0] !== "live") return set_transform.call(viewer, path, matrix);
  state = matrix.slice(0, 3);
  about.live?.forEach((name, i) => {
    set_transform.call(viewer, ["mechanism", name], matrix.slice(16 * (i + 1), 16 * (i + 2)));
  });
};

if (scene === null) viewer.connect(`ws://${location.host}${location.pathname}socket`);
else for (const text of scene) {
  const bytes = atob(text), buffer = new Uint8Array(bytes.length);
  for (let i = 0; i < bytes.length; i++) buffer[i] = bytes.charCodeAt(i);
  viewer.handle_command_bytearray(buffer);
}

const element = (id) => document.getElementById(id);
const add = (parent, tag, properties) =>
  Object.assign(parent.appendChild(document.createElement(tag)), properties);
// What the other files of the script add: keys, and what follows a new scene or each picture.
const KEYS = {}, at_layout = [], at_frame = [];
const animator = viewer.animator, slider = element("time"), clock = document.querySelector("output");

// The picture is made for one shape of window: step back in a narrower one.
const pane = element("meshcat-pane");
pane.setAttribute("aria-label", document.title);
const set_size = viewer.set_3d_pane_size;  // of itself it takes the height of the window
viewer.set_3d_pane_size = () => set_size.call(viewer, pane.clientWidth, pane.clientHeight);
new ResizeObserver(() => {
  viewer.set_3d_pane_size();
  fold_notes();
  make_room();
}).observe(pane);
let away = 1;
function step_back() {
  const wanted = Math.max(1, about.aspect * pane.clientHeight / pane.clientWidth);
  if (Math.abs(wanted - away) < 1e-3) return;
  viewer.camera.position.multiplyScalar(wanted / away);
  away = wanted;
  viewer.set_dirty();
}

// Where the panel would cover the motion, the picture moves aside as far as the window has room.
const MARGIN = 12;  // pixels
function make_room() {
  const width = pane.clientWidth, height = pane.clientHeight, panel = element("panel");
  if (!about.panel || !about.ends || !width || !height) return;
  const part = 0.5 * height / Math.max(1, about.aspect * height / width);
  const [left, right, upper] = about.ends.map((end) => part * end);
  let aside = panel.offsetLeft + panel.offsetWidth + MARGIN - (0.5 * width + left);
  aside = Math.max(0, Math.min(aside, 0.5 * width - MARGIN - right));
  if (panel.offsetTop + panel.offsetHeight < 0.5 * height - upper) aside = 0;  // it is above
  viewer.camera.setViewOffset(width, height, -aside, 0, width, height);
  viewer.set_dirty();
}

// Panel: time, and the values of the run there, interpolated between their samples.
let cells = new Map();  // of each value, and of the time as "t"
function add_row(label, unit, value) {
  const row = document.querySelector("#panel table").insertRow();
  for (const text of [label, "", unit]) row.insertCell().textContent = text;
  cells.set(value, row.cells[1]);
  return row;
}
function fill_panel() {
  cells = new Map();
  document.querySelector("#panel table").replaceChildren();
  const notes = element("notes");
  notes.replaceChildren();
  element("name").textContent = document.title;
  if (about.panel) add_row(about.crank?.label ?? "t", about.crank?.unit ?? "s", "t");
  for (const value of about.values) {
    if (!value.body) add_row(value.label, value.unit, value);
  }
  if (chosen) add_row(name_of(chosen), "", "chosen").className = "chosen";
  for (const value of about.values) {
    if (chosen && value.body === chosen) add_row(value.label, value.unit, value);
  }
  for (const note of about.notes) {
    add(notes, "div", { textContent: note.text });
    for (const { colour, text } of note.keys ?? []) {
      const key = add(notes, "div", { className: "key" });
      add(key, "span").style.background = colour;
      add(key, "span", { textContent: text });
    }
    for (const kind of note.bars ?? []) {
      const bar = add(notes, "div", { className: "bar" });
      bar.dataset.kind = kind;
      add(bar, "span");
      add(bar, "span");
    }
    if (note.more) add(notes, "div", { textContent: note.more });
    if (!note.ramp) continue;
    const background = `linear-gradient(to right, ${note.ramp.join(", ")})`;
    add(notes, "div", { className: "ramp" }).style.background = background;
    const ends = add(notes, "div", { className: "ends" });
    for (const end of note.ends) add(ends, "span", { textContent: end });
  }
  element("panel").hidden = !about.panel && !about.notes.length;
  fold_notes();
  make_room();
}

// A long panel takes the pointer, to be scrolled; through others the picture is turned.
const lengths = new ResizeObserver(() => {
  const panel = element("panel");
  panel.classList.toggle("long", panel.scrollHeight > panel.clientHeight);
});
for (const part of [pane, document.querySelector("#panel table"), element("notes")]) {
  lengths.observe(part);
}

// In a small window the notes would lie on the motion: there a button unfolds them.
const SMALL = [640, 420], MOST_COVERED = 0.25;  // pixels; part of the height of the picture
let unfolded = false;
function fold_notes() {
  const notes = element("notes"), button = element("unfold");
  notes.hidden = false;
  button.hidden = true;
  if (!about.panel) return;  // pictures
  const small = window.innerWidth <= SMALL[0] || window.innerHeight <= SMALL[1];
  const height = element("panel").offsetHeight, most = MOST_COVERED * pane.clientHeight;
  if (!small || !notes.childElementCount || height <= most) return;
  button.hidden = false;
  notes.hidden = !unfolded;
  button.setAttribute("aria-expanded", unfolded);
}
element("unfold").onclick = () => { unfolded = !unfolded; fold_notes(); };

const times_of = (value) => value.times ?? (value.body ? about.joint_times : about.times);

function value_at(value, time) {
  const samples = value.samples, times = times_of(value);
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

function shown(value, digits = 3) {
  if (value === null) return "–";
  const size = Math.abs(value);
  if (size === 0) return "0";
  return (size >= 1e-3 && size < 1e4 ? value.toPrecision(digits) : value.toExponential(digits - 1))
    .replace("-", "\u2212").replace("e-", "e\u2212").replace("e+", "e");
}

// Of times in a run of some duration: enough to see it go on.
function digits_of(duration) {
  if (duration === 0 || duration >= 1) return 2;
  return Math.min(Math.max(4, 2 + Math.ceil(-Math.log10(duration))), 15);
}

function fixed(time, digits) {
  return time.toFixed(digits).replace("-", "\u2212");
}

// The controls of meshcat itself, hidden until somebody asks for them.
function toggle_controls() {
  const shown = element("view").classList.toggle("meshcat-controls");
  element("controls").setAttribute("aria-pressed", shown);
  if (shown) viewer.gui.open();
}
element("controls").onclick = KEYS.g = toggle_controls;

// In the dark the background is darker too: still lighter than black pins.
const dark = matchMedia("(prefers-color-scheme: dark)");
function set_background() {
  const [top, bottom] = about.background[+dark.matches];
  viewer.set_property(["Background"], "top_color", top);
  viewer.set_property(["Background"], "bottom_color", bottom);
}
dark.onchange = set_background;

// Bar.
for (const speed of SPEEDS) {
  const textContent = `${speed}\u00d7`;
  add(element("speed"), "option", { value: speed, textContent, selected: speed === 1 });
}
function seek(time) {
  animator.pause();
  animator.seek(time);
  animator.display_progress(time);
}
slider.oninput = () => seek(+slider.value);
element("speed").onchange = () => { animator.mixer.timeScale = +element("speed").value; };
element("loop").onchange = () => {
  for (const action of animator.actions) {
    if (element("loop").checked) action.setLoop(repetition(), Infinity);
    else action.setLoop(MeshCat.THREE.LoopOnce, 1);
  }
};

function toggle() {
  if (animator.playing) animator.pause(); else animator.play();
}
element("toggle").onclick = toggle;

const step_of_keys = () => about.crank?.step ?? animator.duration / 100;
// A crank that turns goes on at the end of a turn.
function inside(time) {
  const duration = animator.duration, over = time < -1e-9 || time > duration + 1e-9;
  if (about.crank?.closed && over) return (time + duration) % duration;
  return Math.min(Math.max(time, 0), duration);
}

// Keys, wherever the focus is; those that its own element takes are left to it.
const SEEKS = {
  ArrowLeft: () => animator.time - step_of_keys(),
  ArrowRight: () => animator.time + step_of_keys(),
  Home: () => 0,
  End: () => animator.duration,
};
document.addEventListener("keydown", (event) => {
  const own = event.target.closest("button, select, input, .dg");
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (key in KEYS && !event.target.closest("select, .dg")) return KEYS[key]();
  if (animator.duration === 0) return;
  if (own && own !== slider && (own.tagName !== "BUTTON" || event.key === " ")) return;
  if (event.key === " ") toggle();
  else if (event.key in SEEKS) {
    seek(inside(SEEKS[event.key]()));
  } else return;
  event.preventDefault();
});

let laid_out = null;
// The animation comes with the scene, or later from the server.
function lay_out() {
  laid_out = animator.actions;
  element("bar").hidden = animator.duration === 0;
  slider.max = animator.duration;
  set_background();
  element("marks").replaceChildren(...about.passages.map(({ time, text }) => {
    const mark = document.createElement("button");
    mark.style.left = `${100 * (time - about.start) / animator.duration}%`;
    mark.title = text;
    mark.setAttribute("aria-label", text);
    mark.onclick = (event) => {
      seek(time - about.start);
      // After a click of the mouse, space plays from there instead of clicking the mark again.
      if (event.detail > 0) mark.blur();
    };
    return mark;
  }));
  element("speed").onchange();
  element("loop").onchange();
  for (const follow of at_layout) follow();
  if (scene === null) away = 1;  // the camera's place has come with the animation
}

// At the end of a run that the page follows, the server sends its values, passages and notes.
let received;
function receive() {
  const sent = viewer.scene_tree.find(["about"]).object.about;
  if (sent === undefined || sent === received) return;
  received = sent;
  about = { ...JSON.parse(sent), live: [] };
  laid_out = null;
}

function show() {
  if (about.live) receive();
  if (laid_out !== animator.actions) lay_out();
  slider.value = animator.time;
  element("toggle").textContent = animator.playing ? "Pause" : "Play";
  // In the time of the run, as in the panel: meshcat's own begins at 0.
  const digits = digits_of(animator.duration), end = about.start + animator.duration;
  clock.value = about.crank ? crank_text(animator.time)
    : `${fixed(about.start + animator.time, digits)} / ${fixed(end, digits)} s`;
  slider.setAttribute("aria-valuetext", clock.value);
  // While a run is computed there is no animation.
  const computed = about.live && animator.duration === 0;
  const time = computed ? state[0] : about.start + animator.time;
  if (scene !== null || animator.duration > 0 || time > 0) step_back();
  if (about.panel) {
    cells.get("t").textContent = about.crank ? crank_position(time) : fixed(time, digits + 1);
  }
  for (const [value, cell] of cells) {
    if (!value.label) continue;
    cell.textContent = shown(computed ? state[value.live] ?? null : value_at(value, time));
  }
  for (const follow of at_frame) follow(time);
  requestAnimationFrame(show);
}
