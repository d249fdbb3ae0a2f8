"use strict";
const { names, sheets } = JSON.parse(document.getElementById("data").textContent);
const dark = matchMedia("(prefers-color-scheme: dark)").matches;
const COLOURS = dark
  ? ["#7fb2e5", "#f0a04b", "#6fc79d", "#d28fc9", "#c9b48a", "#f08a80", "#9aa4f0", "#d8d34f"]
  : ["#1f3f66", "#e08214", "#2e7d5b", "#8e4585", "#7a6a4f", "#b3261e", "#5560c8", "#8a8000"];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

function numbers(text, kind) {
  const bytes = Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  return Array.from(new kind(bytes.buffer), (value) => (Number.isNaN(value) ? null : value));
}

// the wheel zooms about the cursor
function wheel(plot) {
  plot.over.addEventListener("wheel", (event) => {
    if (!event.deltaY) return;
    event.preventDefault();
    const by = Math.exp(0.0015 * event.deltaY);
    const at = plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x");
    const all = plot.data[0], { min, max } = plot.scales.x;
    const low = Math.max(at - (at - min) * by, all[0]);
    const high = Math.min(at + (max - at) * by, all[all.length - 1]);
    plot.setScale("x", { min: low, max: high });
  }, { passive: false });
}

function joined(sheet, curves) {
  const by = new Map();
  for (const curve of curves) {
    if (!by.has(curve.x)) by.set(curve.x, []);
    by.get(curve.x).push(curve);
  }
  const order = [...by.values()].flat();
  const tables = [...by].map(([x, own]) => {
    sheet.ready[x] ??= numbers(sheet.xs[x], Float64Array);
    return [sheet.ready[x], ...own.map((curve) => numbers(curve.y, Float32Array))];
  });
  return [order, tables.length > 1 ? uPlot.join(tables) : tables[0]];
}

function draw(place, sheet, panel) {
  const [curves, data] = joined(sheet, panel.curves);
  const seen = new Map();
  const axis = { stroke: css("--soft"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line") } };
  const series = curves.map((curve) => {
    if (!seen.has(curve.name)) seen.set(curve.name, COLOURS[seen.size % COLOURS.length]);
    const stroke = curve.dots ? css("--soft") : seen.get(curve.name);
    const label = curve.name + (curve.of ? " (2nd)" : "");
    const shape = { label, stroke, width: 1.3, spanGaps: true, pxAlign: 0, value: (_, v) => (v == null ? "–" : Number(v.toPrecision(6))) };
    if (curve.of) shape.dash = [6, 4];
    if (curve.dots) Object.assign(shape, { paths: () => null, points: { show: true, size: 5, stroke } });
    return shape;
  });
  const plot = new uPlot({
    title: panel.title,
    width: place.clientWidth,
    height: 260,
    scales: { x: { time: false } },
    axes: [{ ...axis, label: sheet.across }, axis],
    cursor: { sync: { key: sheet.key, scales: ["x", null] }, drag: { x: true, y: false } },
    series: [{ label: sheet.across, value: (_, v) => (v == null ? "–" : Number(v.toPrecision(7))) }, ...series],
    hooks: { ready: [wheel], setScale: [(from, scale) => {
      if (scale !== "x" || sheet.busy) return;
      sheet.busy = true;
      const { min, max } = from.scales.x;
      for (const other of sheet.plots) if (other !== from) other.setScale("x", { min, max });
      sheet.busy = false;
    }] },
  }, data, place);
  sheet.plots.push(plot);
  addEventListener("resize", () => plot.setSize({ width: place.clientWidth, height: 260 }));
}

const watch = new IntersectionObserver((found) => {
  for (const one of found) {
    if (!one.isIntersecting) continue;
    watch.unobserve(one.target);
    one.target.go();
  }
}, { rootMargin: "300px" });

sheets.forEach((sheet, place) => {
  Object.assign(sheet, { ready: [], plots: [], busy: false, key: `sheet ${place}` });
  const box = document.createElement("details");
  box.className = "sheet";
  box.open = place === 0;
  const title = document.createElement("summary");
  title.textContent = sheet.title || "all channels";
  box.append(title);
  for (const panel of sheet.panels) {
    const div = document.createElement("div");
    div.className = "panel";
    div.go = () => draw(div, sheet, panel);
    box.append(div);
    watch.observe(div);
  }
  if (sheet.still.length) {
    const still = document.createElement("p");
    still.textContent = `Never change: ${sheet.still.join("; ")}.`;
    box.append(still);
  }
  document.querySelector("main").append(box);
});
