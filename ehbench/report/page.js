"use strict";
// the contents mark where one is
const links = new Map();
for (const link of document.querySelectorAll("nav a")) links.set(link.hash.slice(1), link);
const marks = [...links.keys()].map((id) => document.getElementById(id)).filter(Boolean);
let waiting = false;
function mark() {
  waiting = false;
  let here = marks[0];
  for (const one of marks) if (one.getBoundingClientRect().top < 120) here = one;
  for (const [id, link] of links) {
    if (here && id === here.id) link.setAttribute("aria-current", "true");
    else link.removeAttribute("aria-current");
    link.closest(".entry").classList.remove("here");
  }
  if (!here) return;
  const link = links.get(here.id);
  link.closest(".entry").classList.add("here");
  const nav = document.querySelector("nav");
  if (nav.scrollHeight > nav.clientHeight) {
    nav.scrollTop += link.getBoundingClientRect().top - nav.getBoundingClientRect().top - nav.clientHeight / 2;
  }
}
addEventListener("scroll", () => { if (!waiting) { waiting = true; requestAnimationFrame(mark); } }, { passive: true });
document.documentElement.classList.add("live");
if (innerWidth < 640) document.querySelector("nav details").open = false;
mark();

// the printed contents have page numbers: for a moment the page is laid out in columns of a sheet's size, which break where sheets do
function paginate() {
  const rules = [...document.styleSheets[0].cssRules].filter((one) => one.media);
  const meant = rules.map((one) => one.media.mediaText);
  for (const one of rules) one.media.mediaText = one.media.mediaText === "print" ? "all" : "not all";
  document.documentElement.classList.add("sheets");
  const { columnWidth, columnGap } = getComputedStyle(document.body);
  const left = document.body.getBoundingClientRect().left, sheet = parseFloat(columnWidth) + parseFloat(columnGap);
  for (const [id, link] of links) {
    const here = document.getElementById(id), box = here && (here.querySelector("h2") || here).getClientRects()[0];
    if (box) link.dataset.page = Math.floor((box.left - left + 1) / sheet) + 1;
    else delete link.dataset.page;
  }
  document.documentElement.classList.remove("sheets");
  rules.forEach((one, i) => { one.media.mediaText = meant[i]; });
}
addEventListener("beforeprint", paginate);

// a figure opens large: wheel or two fingers zoom, drag moves, double click shows all, Esc closes
const dialog = document.getElementById("zoom");
let svg = null, home = null, whole = null;
const fingers = new Map();
function box() { return svg.getAttribute("viewBox").split(" ").map(Number); }
function point(x, y) { return new DOMPoint(x, y).matrixTransform(svg.getScreenCTM().inverse()); }
function scale(at, by) {
  const [x, y, w, h] = box();
  const k = Math.min(Math.max(by, 1 / 60 * whole[2] / w), whole[2] / w);
  svg.setAttribute("viewBox", [at.x - (at.x - x) * k, at.y - (at.y - y) * k, w * k, h * k].join(" "));
  if (k * w >= whole[2]) svg.setAttribute("viewBox", whole.join(" "));
}
function open(plot) {
  svg = plot.querySelector("svg");
  home = plot;
  whole = box();
  dialog.append(svg);
  dialog.showModal();
}
dialog.addEventListener("close", () => {
  svg.setAttribute("viewBox", whole.join(" "));
  home.prepend(svg);
  fingers.clear();
});
dialog.addEventListener("wheel", (event) => {
  event.preventDefault();
  scale(point(event.clientX, event.clientY), Math.exp(0.0015 * event.deltaY));
}, { passive: false });
dialog.addEventListener("dblclick", () => svg.setAttribute("viewBox", whole.join(" ")));
dialog.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, event);
  dialog.setPointerCapture(event.pointerId);
});
dialog.addEventListener("pointermove", (event) => {
  const last = fingers.get(event.pointerId);
  if (!last) return;
  const other = [...fingers.values()].find((one) => one.pointerId !== event.pointerId);
  const a = point(last.clientX, last.clientY), b = point(event.clientX, event.clientY);
  if (other) {
    const o = point(other.clientX, other.clientY);
    scale(o, Math.hypot(a.x - o.x, a.y - o.y) / Math.hypot(b.x - o.x, b.y - o.y));
  } else {
    const [x, y, w, h] = box();
    svg.setAttribute("viewBox", [x + a.x - b.x, y + a.y - b.y, w, h].join(" "));
  }
  fingers.set(event.pointerId, event);
});
for (const end of ["pointerup", "pointercancel"]) {
  dialog.addEventListener(end, (event) => fingers.delete(event.pointerId));
}
const shut = document.createElement("button");
shut.textContent = "close";
shut.addEventListener("click", () => dialog.close());
shut.addEventListener("pointerdown", (event) => event.stopPropagation());
dialog.append(shut);
for (const plot of document.querySelectorAll(".plot")) {
  const button = document.createElement("button");
  button.textContent = "zoom";
  button.setAttribute("aria-label", "enlarge this figure");
  button.addEventListener("click", () => open(plot));
  plot.append(button);
  plot.addEventListener("dblclick", () => open(plot));
}
