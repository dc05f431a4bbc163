// Names of the bodies under the pointer, and the one that is chosen by a click, a touch, or in the
// list, whose values the panel shows.
const HOVERED = 0x282828, FAINT = 0.22, LONGEST_CLICK = 6;  // pixels
let chosen = "", hovered = "";

const body_root = () => viewer.scene_tree.find(["mechanism"]);
const name_of = (node) => about.bodies.find((body) => body.node === node)?.name ?? "";

// The node of the first body below a point of the window, and the point of it in the scene; of none
// the name is "".
function body_below(x, y) {
  const box = pane.getBoundingClientRect(), THREE = MeshCat.THREE;
  const point = new THREE.Vector2(
    2 * (x - box.left) / box.width - 1, 1 - 2 * (y - box.top) / box.height);
  const caster = new THREE.Raycaster();
  caster.setFromCamera(point, viewer.camera);
  for (const { object, point: place } of caster.intersectObject(body_root().object, true)) {
    if (!object.isMesh) continue;
    let node = object, seen = true;
    for (; node.parent && node.parent !== body_root().object; node = node.parent) {
      seen &&= node.visible;
    }
    if (seen && name_of(node.name)) return { node: node.name, place };
  }
  return { node: "", place: null };
}
const body_at = (x, y) => body_below(x, y).node;

// The chosen body among others that are faint, and the one under the pointer a little brighter.
function mark_bodies() {
  for (const [name, node] of Object.entries(body_root().children)) {
    node.object.traverse(({ material }) => {
      if (!material) return;
      const own = material.userData.own ??= {
        opacity: material.opacity, transparent: material.transparent };
      const faint = chosen && name !== chosen;
      material.opacity = own.opacity * (faint ? FAINT : 1);
      material.transparent = faint || own.transparent;
      material.emissive?.setHex(name === hovered ? HOVERED : 0);
    });
  }
  viewer.set_dirty();
}

function hover(node, x, y) {
  const tip = element("tip"), width = element("view").clientWidth;
  tip.hidden = !node;
  if (node) {
    tip.textContent = name_of(node);
    tip.style.left = `${Math.max(0, Math.min(x + 14, width - tip.offsetWidth - 4))}px`;
    tip.style.top = `${Math.max(0, y - 30)}px`;
  }
  if (node === hovered) return;
  hovered = node;
  mark_bodies();
}

function choose(node) {
  chosen = node;
  mark_bodies();
  element("body").value = chosen;
  fill_panel();
}

let pressed = null;
pane.addEventListener("pointermove", (event) => {
  if (event.pointerType === "touch" || event.buttons) return hover("");
  hover(body_at(event.clientX, event.clientY), event.offsetX, event.offsetY);
});
pane.addEventListener("pointerleave", () => hover(""));
// A pointer that moves before it is released turns the picture.
pane.addEventListener("pointerdown", (event) => {
  pressed = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
}, true);
pane.addEventListener("pointerup", (event) => {
  if (!pressed) return;
  const moved = Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
  pressed = null;
  if (moved <= LONGEST_CLICK) choose(body_at(event.clientX, event.clientY));
}, true);
element("body").onchange = () => choose(element("body").value);
KEYS.Escape = () => choose("");

at_layout.push(() => {
  const list = element("body");
  list.hidden = !about.bodies.length;
  list.replaceChildren();
  add(list, "option", { value: "", textContent: "Body" });
  for (const { node, name } of about.bodies) add(list, "option", { value: node, textContent: name });
  choose(about.bodies.some(({ node }) => node === chosen) ? chosen : "");
});
