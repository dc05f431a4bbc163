// Curves of chosen values below the picture, in step with it.
const CURVE_HEIGHT = 84, GAP = 4;  // pixels
const MOST_DIGITS = 7;  // for which there is room beside a curve
const svg = (parent, tag, attributes) => {
  const made = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", tag));
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
};
let curves = [];  // of { value, digits, cursor, here }

// A line through the finite samples, with gaps at the others; x from 0 to 1000.
function path_of(value, low, high) {
  const times = times_of(value), start = about.start, duration = animator.duration || 1;
  let path = "", pen = "M";
  value.samples.forEach((sample, i) => {
    if (sample === null) { pen = "M"; return; }
    const x = 1000 * (times[i] - start) / duration;
    const y = CURVE_HEIGHT - GAP - (CURVE_HEIGHT - 2 * GAP) * (sample - low) / (high - low);
    path += `${pen}${x.toFixed(1)} ${y.toFixed(1)}`;
    pen = "L";
  });
  return path;
}

function add_curve(value) {
  if (curves.some((curve) => curve.value === value)) return;
  const samples = value.samples.filter((sample) => sample !== null);
  let low = samples.reduce((a, b) => Math.min(a, b), Infinity);
  let high = samples.reduce((a, b) => Math.max(a, b), -Infinity);
  if (!samples.length) [low, high] = [0, 1];
  // What is zero but for rounding is written as zero.
  const ends = [high, low].map((end) => Math.abs(end) < 1e-9 * (high - low) ? 0 : end);
  // Enough digits to see it vary; of what is constant but for rounding, the middle.
  const size = Math.max(Math.abs(low), Math.abs(high));
  let digits = 3;
  if (high - low > 1e-9 * size) {
    const needed = 2 + Math.ceil(Math.log10(size / (high - low)));
    digits = Math.min(Math.max(needed, digits), MOST_DIGITS);
  } else {
    const room = Math.abs(low) || 1;
    [low, high] = [low - room, high + room];
  }
  const row = add(element("plots"), "div", { className: "curve" });
  const head = add(row, "div", { className: "head" });
  add(head, "span", { textContent: `${value.label}${value.unit && ` (${value.unit})`}` });
  const here = add(head, "span", { className: "value" });
  const remove = add(head, "button", { textContent: "\u00d7", title: "remove the curve" });
  remove.setAttribute("aria-label", `remove the curve of ${value.label}`);
  const box = add(row, "div", { className: "plot" });
  const scale = add(box, "div", { className: "ends" });
  for (const end of ends) add(scale, "span", { textContent: shown(end, digits) });
  const plot = svg(box, "svg", {
    viewBox: `0 0 1000 ${CURVE_HEIGHT}`, preserveAspectRatio: "none", role: "img",
    "aria-label": `${value.label} over ${about.crank?.label ?? "time"}, from `
      + `${shown(ends[1], digits)} to ${shown(ends[0], digits)} ${value.unit}`,
  });
  for (const { time } of about.passages) {
    const x = 1000 * (time - about.start) / animator.duration;
    svg(plot, "line", { x1: x, x2: x, y1: 0, y2: CURVE_HEIGHT, class: "passage" });
  }
  svg(plot, "path", { d: path_of(value, low, high) });
  const cursor = svg(plot, "line", { y1: 0, y2: CURVE_HEIGHT, class: "cursor" });
  const move = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const { left, width } = plot.getBoundingClientRect();
    const part = Math.min(Math.max((event.clientX - left) / width, 0), 1);
    seek(part * animator.duration);
  };
  plot.onpointerdown = (event) => { plot.setPointerCapture(event.pointerId); move(event); };
  plot.onpointermove = move;
  const curve = { value, digits, cursor, here };
  curves.push(curve);
  remove.onclick = () => {
    curves = curves.filter((other) => other !== curve);
    row.remove();
    element("quantity").focus();
  };
}

function toggle_curves() {
  if (element("show-curves").hidden) return;
  const hidden = element("curves").hidden = !element("curves").hidden;
  element("show-curves").setAttribute("aria-pressed", !hidden);
  if (hidden || curves.length) return;
  // First the joint of the chosen body, otherwise sigma, or what there is.
  const values = about.values.filter((value) => value.samples);
  add_curve(values.find((value) => chosen && value.body === chosen)
    ?? values.find((value) => value.label === "sigma") ?? values[0]);
}
element("show-curves").onclick = toggle_curves;
KEYS.c = toggle_curves;
element("quantity").onchange = () => {
  const value = about.values[+element("quantity").value];
  element("quantity").value = "";
  add_curve(value);
};

at_layout.push(() => {
  curves = [];
  element("plots").replaceChildren();
  element("curves").hidden = true;
  element("show-curves").setAttribute("aria-pressed", false);
  const list = element("quantity");
  list.replaceChildren();
  add(list, "option", { value: "", textContent: "Add a curve" });
  about.values.forEach((value, i) => {
    if (value.samples) add(list, "option", { value: i, textContent: value.label });
  });
  element("show-curves").hidden = list.length === 1 || animator.duration === 0;
});
at_frame.push((time) => {
  if (element("curves").hidden) return;
  const x = 1000 * (time - about.start) / animator.duration;
  for (const { value, digits, cursor, here } of curves) {
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    here.textContent = `${shown(value_at(value, time), digits)} ${value.unit}`;
  }
});
