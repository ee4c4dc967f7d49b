// SPDX-License-Identifier: Apache-2.0
// The page: asks the API, follows its events, and hands both to what draws them.

import {kept} from "./kept.js";
import {TimeLine} from "./time_line.js";
import {drawDistributions, histograms, time} from "./distributions.js";

const KEPT = 20000; // events held, the checkpoints among them
const CRASHES = 200; // rows of crashes shown
const LOOK_MS = 2000;
const METRICS_MS = 5000;
const AGAIN_MS = 1000;
const TOLD = new Set(["restored", "gave_up", "unprotected", "guard_lost", "dropped", "missed", "health"]);
const FIRST = ["message", "at", "kind", "reason", "outcome", "generation", "age_s", "lost_s", "restore_s", "freeze_s"];

const $ = (id) => document.getElementById(id);
const state = {token: "", control: false, containers: [], events: [], last: null, chosen: null, metrics: {}, most: {}};
const line = new TimeLine($("line"), $("names"), $("canvas"), $("tip"), choose);

class Refused extends Error {}

async function ask(path, options = {}) {
  const answer = await fetch(path, {
    ...options, cache: "no-store", headers: {...options.headers, Authorization: `Bearer ${state.token}`},
  });
  if (answer.status === 401) throw new Refused("the token is wrong");
  if (!answer.ok) {
    const said = await answer.json().catch(() => ({}));
    throw new Error(said.error?.message ?? `HTTP status ${answer.status}`);
  }
  return answer;
}

/** The token is taken out of the URL, so that it is not in what somebody copies or bookmarks. */
function findToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("avckpt-token", given);
    history.replaceState(null, "", location.pathname);
  }
  state.token = sessionStorage.getItem("avckpt-token") ?? "";
}

function link(kind, text) {
  $("link").className = `link ${kind}`;
  $("link").textContent = text;
}

function node(name, text = "", kind = "") {
  const made = document.createElement(name);
  made.textContent = text;
  made.className = kind;
  return made;
}

/** unit9 comes before unit12. */
const byName = new Intl.Collator(undefined, {numeric: true}).compare;
const label = (container) => container.name || container.id.slice(0, 12);
/** It has generations of its own: it is neither a launcher of nodes, nor one that only hears of others. */
const guarded = (container) => container.state !== "listening" && container.state !== "nodes";

/** The time of day, with the date where that is another one: the history outlives a reboot. */
function clock(at) {
  const when = new Date(at * 1000);
  const today = when.toDateString() === new Date().toDateString();
  return today ? when.toLocaleTimeString([], {hour12: false}) : when.toLocaleString([], {hour12: false});
}

// ---- what comes ------------------------------------------------------------

function take(event) {
  if (event.seq) state.last = event.seq;
  state.events.push(event);
  state.events = kept(state.events, KEPT);
  for (const [name, field] of [["restore", "restore_s"], ["lost", "lost_s"], ["freeze", "freeze_s"]]) {
    if (event[field] === undefined) continue;
    const most = (state.most[event.container] ??= {});
    const metric = `avckpt_${name}_seconds`;
    most[metric] = Math.max(most[metric] ?? 0, event[field]);
  }
  if (TOLD.has(event.kind)) due.crashes = true;
}

/** What the sidecar is, and what this page may do: after each of its starts, also when the page was first. */
async function about() {
  const info = await (await ask("/v1/info")).json();
  state.control = (await (await ask("/v1/access")).json()).control;
  $("sidecar").textContent = `sidecar ${info.version}, since ${new Date(info.started_at * 1000).toLocaleString()}`;
}

async function follow() {
  for (;;) {
    try {
      const headers = state.last === null ? {} : {"Last-Event-ID": String(state.last)};
      const answer = await ask("/v1/events?all=1", {headers});
      await about();
      link("live", "live");
      let rest = "";
      for (const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader(); ;) {
        const {done, value} = await reader.read();
        if (done) break;
        const blocks = (rest + value).split("\n\n");
        rest = blocks.pop();
        for (const block of blocks) {
          for (const part of block.split("\n")) if (part.startsWith("data: ")) take(JSON.parse(part.slice(6)));
        }
      }
      link("lost", "the sidecar was stopped");
    } catch (error) {
      if (error instanceof Refused) return login();
      link("lost", error.message);
    }
    await new Promise((wake) => setTimeout(wake, AGAIN_MS));
  }
}

async function look() {
  try {
    if (!document.hidden) {
      state.containers = (await (await ask("/v1/containers?memory=0&all=1")).json()).containers;
      due.units = true;
    }
  } catch { /* follow() says so */ }
  setTimeout(look, LOOK_MS);
}

async function lookAtMetrics() {
  try {
    if (!document.hidden) {
      state.metrics = histograms(await (await ask("/metrics")).text());
      due.plots = true;
    }
  } catch { /* as above */ }
  setTimeout(lookAtMetrics, METRICS_MS);
}

// ---- what is shown ---------------------------------------------------------

const due = {units: true, crashes: true, plots: true};

function shownUnits() {
  const wanted = $("find").value.trim().toLowerCase();
  return state.containers
    .filter((each) => each.state !== "ended")
    .filter((each) => !wanted || [label(each), each.group, each.state].some((text) => text.toLowerCase().includes(wanted)))
    .sort((a, b) => byName(a.group, b.group) || byName(label(a), label(b)));
}

function frame() {
  const units = shownUnits();
  line.draw(
    units.map((each) => ({label: label(each), bad: each.state === "unprotected"})),
    state.events, Date.now() / 1000, Number($("span").value),
  );
  if (due.units) { drawTiles(); drawUnits(units); due.units = false; }
  if (due.crashes) { drawCrashes(); due.crashes = false; }
  if (due.plots) { drawPlots(); due.plots = false; }
}

function drawTiles() {
  const live = state.containers.filter((each) => each.state !== "ended" && guarded(each));
  const sound = live.filter((each) => each.state === "protected").length;
  const restored = state.events.filter((event) => event.kind === "restored");
  const lost = restored.map((event) => event.lost_s ?? 0).sort((a, b) => a - b);
  const tiles = [
    [`${sound} of ${live.length}`, "units protected", sound < live.length],
    [restored.length, "restores in the history", false],
    [state.events.filter((event) => event.kind === "gave_up" && !["clean_exit", "stopped"].includes(event.outcome)).length,
      "crashes not undone", false],
    [lost.length ? time(lost[Math.floor(lost.length / 2)]) : "-", "lost by a crash, median", false],
    [lost.length ? time(lost.at(-1)) : "-", "lost by a crash, most", false],
    [restored.length ? time(Math.max(...restored.map((event) => event.restore_s ?? 0))) : "-", "slowest restore", false],
  ];
  $("tiles").replaceChildren(...tiles.map(([value, what, bad]) => {
    const tile = node("div", "", bad ? "tile bad" : "tile");
    tile.append(node("b", String(value)), node("span", what));
    return tile;
  }));
}

/** Rows that stay are left where they are: a click, the focus and a selection outlive what others do. */
function settle(body, rows) {
  const stay = new Set(rows);
  for (const row of [...body.rows]) if (!stay.has(row)) row.remove();
  rows.forEach((row, at) => { if (body.rows[at] !== row) body.insertBefore(row, body.rows[at] ?? null); });
}

const unitRows = new Map();
const crashRows = new WeakMap();

function unitRow(each) {
  const row = node("tr");
  for (const kind of ["", "", "", "number", "number", "number", "number", "number", "", ""]) row.append(node("td", "", kind));
  row.cells[2].append(node("span"));
  unitRows.set(each.id, row);
  return row;
}

function drawUnits(units) {
  for (const id of unitRows.keys()) if (!state.containers.some((each) => each.id === id)) unitRows.delete(id);
  settle($("units").tBodies[0], units.map((each) => {
    const row = unitRows.get(each.id) ?? unitRow(each);
    const age = each.last_checkpoint_at === null ? "-" : `${time(Math.max(0, Date.now() / 1000 - each.last_checkpoint_at))} ago`;
    const texts = [label(each), each.group, null, guarded(each) ? `${each.generations}/${each.keep}` : "-", age,
      time(each.last_freeze_s), String(each.restores), time(each.last_restore_s), each.reason];
    texts.forEach((text, at) => {
      if (text !== null && row.cells[at].textContent !== text) row.cells[at].textContent = text;
    });
    row.cells[2].firstChild.textContent = each.state;
    row.cells[2].firstChild.className = `state ${each.state}`;
    const may = state.control && guarded(each);
    if (may !== row.cells[9].hasChildNodes()) {
      row.cells[9].replaceChildren(...(may ? ["checkpoint", "restore"].map((what) => command(each, what)) : []));
    }
    return row;
  }));
}

function command(container, what) {
  const button = node("button", what === "restore" ? "Roll back" : "Checkpoint");
  button.type = "button";
  button.addEventListener("click", async () => {
    if (what === "restore" && !confirm(`Roll ${label(container)} back to its newest checkpoint?`)) return;
    try {
      await ask(`/v1/containers/${encodeURIComponent(container.id)}/${what}`, {method: "POST"});
    } catch (error) {
      alert(error.message);
    }
  });
  return button;
}

function drawCrashes() {
  const told = state.events.filter((event) => TOLD.has(event.kind)).slice(-CRASHES).reverse();
  settle($("crashes").tBodies[0], told.map((event) => {
    const row = crashRows.get(event) ?? crashRow(event);
    row.className = event === state.chosen ? "chosen" : "";
    return row;
  }));
}

function crashRow(event) {
  const row = node("tr");
  row.append(node("td", clock(event.at), "when"), node("td", event.container), node("td", event.message),
    node("td", event.lost_s === undefined ? "" : time(event.lost_s), "number"));
  row.tabIndex = 0;
  row.addEventListener("click", () => choose(event));
  row.addEventListener("keydown", (key) => { if (key.key === "Enter") choose(event); });
  crashRows.set(event, row);
  return row;
}

function drawPlots() {
  const whose = $("whose");
  const names = state.containers.filter((each) => each.state !== "ended").map(label).sort(byName);
  if ([...whose.options].slice(1).map((each) => each.value).join("\n") !== names.join("\n")) {
    const before = whose.value;
    whose.replaceChildren(new Option("all units", ""), ...names.map((name) => new Option(name, name)));
    whose.value = names.includes(before) ? before : "";
  }
  const most = {};
  for (const [container, byMetric] of Object.entries(state.most)) {
    if (whose.value && container !== whose.value) continue;
    for (const [metric, value] of Object.entries(byMetric)) most[metric] = Math.max(most[metric] ?? 0, value);
  }
  drawDistributions($("plots"), state.metrics, whose.value, most);
}

/** Shows all that is known of an event, and what happened to its unit and its group around it. */
function choose(event) {
  state.chosen = event;
  due.crashes = true;
  const list = node("dl");
  const fields = [...FIRST, ...Object.keys(event).filter((key) => !FIRST.includes(key))];
  for (const key of fields.filter((each) => event[each] !== undefined && event[each] !== "")) {
    const value = event[key];
    const text = key === "at" ? new Date(value * 1000).toISOString()
      : key.endsWith("_s") && key !== "monotonic_s" ? time(value)
      : typeof value === "object" ? JSON.stringify(value, null, 1) : String(value);
    const cell = node("dd");
    cell.append(text.includes("\n") ? node("pre", text) : text);
    list.append(node("dt", key), cell);
  }
  const around = state.events.filter((each) => each !== event && each.kind !== "checkpoint" && Math.abs(each.at - event.at) < 2
    && (each.id === event.id || (event.group && each.group === event.group)));
  const others = node("ul");
  others.append(...around.slice(0, 20).map((each) => node("li", `${clock(each.at)} ${each.container}: ${each.message}`)));
  $("detail").replaceChildren(node("h2", `${event.container}: ${event.kind}`), list,
    ...(around.length ? [node("h2", "Within two seconds of it"), others] : []));
}

// ---- start -----------------------------------------------------------------

function theme(kind) {
  document.documentElement.dataset.theme = kind;
  $("theme").textContent = kind === "dark" ? "Light" : "Dark";
}

function login() {
  $("main").hidden = true;
  $("login").hidden = false;
  link("lost", "no access");
}

async function start() {
  try {
    await about();
  } catch (error) {
    if (error instanceof Refused) return login();
    link("lost", error.message);
  }
  $("login").hidden = true;
  $("main").hidden = false;
  look();
  lookAtMetrics();
  follow();
  setInterval(() => { if (!document.hidden) requestAnimationFrame(frame); }, 250);
}

theme(localStorage.getItem("avckpt-theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
$("theme").addEventListener("click", () => {
  const kind = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("avckpt-theme", kind);
  theme(kind);
});
$("login").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("avckpt-token", $("token").value.trim());
  location.reload();
});
$("find").addEventListener("input", () => { due.units = true; });
$("whose").addEventListener("change", () => { due.plots = true; });
findToken();
if (state.token) start(); else login();
