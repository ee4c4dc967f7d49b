// SPDX-License-Identifier: Apache-2.0
// The time line: a row for each unit, drawn on one canvas so that a hundred of them cost nothing.

export const ROW = 22;
const REACH = 7; // pixels between the pointer and a mark that it means
const STEPS_S = [1, 5, 10, 30, 60, 300, 600, 1800, 3600, 10800, 21600];

/** Kinds that are drawn, in the order in which they are painted: what matters is on top. */
const DRAWN = ["checkpoint", "notified", "missed", "died", "restored", "gave_up"];

export class TimeLine {
  constructor(line, names, canvas, tip, choose) {
    Object.assign(this, {line, names, canvas, tip});
    this.marks = [];
    canvas.addEventListener("mousemove", (at) => this.point(at));
    canvas.addEventListener("mouseleave", () => { tip.hidden = true; });
    canvas.addEventListener("click", (at) => {
      const mark = this.under(at);
      if (mark) choose(mark.event);
    });
  }

  /** Draws `units` ([{label, bad}]) with `events` of the last `spanS` seconds until `nowS`. */
  draw(units, events, nowS, spanS) {
    this.nameRows(units);
    const ratio = window.devicePixelRatio || 1;
    const width = this.canvas.clientWidth;
    const height = ROW * (units.length + 1);
    this.canvas.style.height = `${height}px`;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const pen = this.canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const from = nowS - spanS;
    const x = (at) => ((at - from) / spanS) * width;
    this.axis(pen, colour, {from, spanS, width, height, x});
    const rows = new Map(units.map((unit, row) => [unit.label, row + 1]));
    const marks = new Map(DRAWN.map((kind) => [kind, []]));
    for (const event of events) {
      const row = rows.get(event.container);
      if (event.at < from || row === undefined) continue;
      marks.get(event.kind)?.push({x: x(event.at), y: (row + 0.5) * ROW, event});
    }
    pen.lineWidth = 1.5;
    for (const [kind, those] of marks) {
      pen.fillStyle = pen.strokeStyle = colour(kind);
      for (const mark of those) shape(pen, kind, mark.x, mark.y);
    }
    this.marks = [...marks.values()].flat();
  }

  nameRows(units) {
    const key = units.map((unit) => unit.label + (unit.bad ? "!" : "")).join("\n");
    if (key === this.named) return;
    this.named = key;
    const head = document.createElement("div");
    head.textContent = `${units.length} units`;
    this.names.replaceChildren(head, ...units.map((unit) => {
      const name = document.createElement("div");
      name.textContent = name.title = unit.label;
      name.classList.toggle("bad", unit.bad);
      return name;
    }));
  }

  axis(pen, colour, {from, spanS, width, height, x}) {
    const step = STEPS_S.find((each) => spanS / each <= width / 90) ?? 86400;
    pen.strokeStyle = colour("line");
    pen.fillStyle = colour("quiet");
    pen.lineWidth = 1;
    pen.font = "11px system-ui, sans-serif";
    const zone = new Date(from * 1000).getTimezoneOffset() * 60;
    for (let at = Math.ceil((from - zone) / step) * step + zone; at <= from + spanS; at += step) {
      pen.beginPath();
      pen.moveTo(x(at), ROW - 4);
      pen.lineTo(x(at), height);
      pen.stroke();
      const text = new Date(at * 1000).toLocaleTimeString([], {
        hour12: false, hour: "2-digit", minute: "2-digit", ...(step < 60 ? {second: "2-digit"} : {}),
      });
      if (x(at) < width - 50) pen.fillText(text, x(at) + 3, ROW - 8);
    }
  }

  under(at) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [at.clientX - box.left, at.clientY - box.top];
    let found = null;
    for (const mark of this.marks) {
      // Later ones are painted over earlier ones, and so meant rather than these.
      if (Math.abs(mark.x - x) <= REACH && Math.abs(mark.y - y) <= ROW / 2) found = mark;
    }
    return found;
  }

  point(at) {
    const mark = this.under(at);
    this.tip.hidden = !mark;
    this.canvas.style.cursor = mark ? "pointer" : "";
    if (!mark) return;
    this.tip.textContent = `${new Date(mark.event.at * 1000).toLocaleTimeString([], {hour12: false})}  ${mark.event.container}: ${mark.event.message}`;
    const left = this.canvas.offsetLeft + mark.x;
    this.tip.style.left = `${Math.max(0, Math.min(left + 10, this.line.clientWidth - this.tip.offsetWidth - 4))}px`;
    this.tip.style.top = `${mark.y + ROW / 2 + 2}px`;
  }
}

function shape(pen, kind, x, y) {
  pen.beginPath();
  if (kind === "checkpoint") {
    pen.fillRect(x - 0.75, y - 5, 1.5, 10);
  } else if (kind === "died") {
    pen.moveTo(x - 4, y - 4); pen.lineTo(x + 4, y + 4);
    pen.moveTo(x + 4, y - 4); pen.lineTo(x - 4, y + 4);
    pen.stroke();
  } else if (kind === "restored") {
    pen.arc(x, y, 4, 0, 2 * Math.PI);
    pen.fill();
  } else if (kind === "gave_up") {
    pen.fillRect(x - 4, y - 4, 8, 8);
  } else if (kind === "missed") {
    pen.moveTo(x, y - 4); pen.lineTo(x + 4.5, y + 4); pen.lineTo(x - 4.5, y + 4);
    pen.closePath();
    pen.stroke();
  } else {
    pen.moveTo(x, y - 4.5); pen.lineTo(x + 4.5, y); pen.lineTo(x, y + 4.5); pen.lineTo(x - 4.5, y);
    pen.closePath();
    pen.stroke();
  }
}
