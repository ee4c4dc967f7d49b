// SPDX-License-Identifier: Apache-2.0
// Histograms of what the sidecar has measured, from its Prometheus metrics.

const SVG = "http://www.w3.org/2000/svg";
const SHOWN = [
  ["avckpt_freeze_seconds", "Freeze", "the application stood still"],
  ["avckpt_restore_seconds", "Restore", "death to running again"],
  ["avckpt_lost_seconds", "Lost", "age of the state gone back to, and the restore"],
];
const [WIDTH, HEIGHT, FOOT] = [300, 130, 26];

/** {name: {container: {buckets: [[le, count]], sum, count}}} of the histograms in Prometheus' text. */
export function histograms(text) {
  const found = {};
  for (const line of text.split("\n")) {
    const match = /^(\w+?)_(bucket|sum|count)\{(.*)\} (\S+)$/.exec(line);
    if (!match) continue;
    const [, name, part, labels, value] = match;
    const container = /container="((?:[^"\\]|\\.)*)"/.exec(labels)?.[1].replace(/\\(.)/g, "$1") ?? "";
    const one = ((found[name] ??= {})[container] ??= {buckets: [], sum: 0, count: 0});
    if (part === "bucket") one.buckets.push([Number(/le="([^"]*)"/.exec(labels)[1].replace("+Inf", "Infinity")), Number(value)]);
    else one[part] = Number(value);
  }
  return found;
}

/** Redraws all plots in `place`, of one unit or of all ("").  `most` has the greatest values seen, by metric. */
export function drawDistributions(place, all, whose, most) {
  place.replaceChildren(...SHOWN.map(([name, title, what]) => plot(title, what, added(all[name] ?? {}, whose), most[name])));
}

function added(byContainer, whose) {
  const total = {buckets: new Map(), sum: 0, count: 0};
  for (const [container, one] of Object.entries(byContainer)) {
    if (whose && container !== whose) continue;
    total.sum += one.sum;
    total.count += one.count;
    for (const [le, count] of one.buckets) total.buckets.set(le, (total.buckets.get(le) ?? 0) + count);
  }
  return total;
}

function plot(title, what, total, most) {
  const box = document.createElement("div");
  box.className = "plot";
  const head = document.createElement("p");
  const name = document.createElement("b");
  name.textContent = title;
  head.append(name, ` ${what}`);
  const text = document.createElement("p");
  text.className = "quiet";
  const mean = total.count ? `mean ${time(total.sum / total.count)}` : "none yet";
  text.textContent = `${total.count} measured, ${mean}${most ? `, longest kept ${time(most)}` : ""}`;
  box.append(head, text, bars([...total.buckets].sort((a, b) => a[0] - b[0]), title));
  return box;
}

function bars(cumulated, title) {
  const svg = element("svg", {viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img"});
  const counts = cumulated.map(([le, count], i) => [le, count - (i ? cumulated[i - 1][1] : 0)]);
  const label = document.createElementNS(SVG, "title");
  label.textContent = `${title}: ${counts.map(([le, count]) => `${count} up to ${time(le)}`).join(", ") || "none"}`;
  svg.append(label, element("line", {class: "base", x1: 0, x2: WIDTH, y1: HEIGHT - FOOT, y2: HEIGHT - FOOT}));
  const top = Math.max(1, ...counts.map(([, count]) => count));
  const step = WIDTH / Math.max(1, counts.length);
  counts.forEach(([le, count], i) => {
    const height = count ? Math.max(2, (count / top) * (HEIGHT - FOOT - 14)) : 0;
    const bar = element("rect", {x: i * step + 1.5, y: HEIGHT - FOOT - height, width: step - 3, height, rx: 1.5});
    const tip = document.createElementNS(SVG, "title");
    tip.textContent = `${count} up to ${time(le)}`;
    bar.append(tip);
    svg.append(bar);
    if (count) svg.append(words(count >= 10000 ? `${Math.round(count / 1000)}k` : count, (i + 0.5) * step, HEIGHT - FOOT - height - 3));
    if (i % 2 === 0 || counts.length < 8) svg.append(words(le === Infinity ? "more" : time(le), Math.max((i + 0.5) * step, 16), HEIGHT - 10));
  });
  return svg;
}

function words(text, x, y) {
  const node = element("text", {x, y, "text-anchor": "middle"});
  node.textContent = text;
  return node;
}

function element(name, attributes) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
}

/** A duration for a person. */
export function time(seconds) {
  if (seconds === null || seconds === undefined) return "-";
  if (seconds === Infinity) return "any";
  if (seconds < 0.01) return `${Number((seconds * 1000).toPrecision(2))} ms`;
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  if (seconds < 120) return `${Number(seconds.toPrecision(3))} s`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}
