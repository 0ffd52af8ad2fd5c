/* The player of the report and of the dashboard: a crash from above, with its curves. `_page.py` makes its data. */
const $ = (id) => document.getElementById(id);
const make = (tag, text, className) => {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (className) node.className = className;
  return node;
};
/* Each look-up of a style costs as much as drawing a vehicle, so colours are kept until the scheme changes. */
const STYLES = new Map();
function css(name) {
  if (!STYLES.has(name)) STYLES.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return STYLES.get(name);
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { STYLES.clear(); PAINTED.clear(); });

/* Curves of a crash stay the same while it plays, so they are painted once and copied below the cursor. */
const PAINTED = new Map();
function copied(id, crash, context, width, height, paint) {
  const ratio = window.devicePixelRatio || 1, known = PAINTED.get(id);
  if (!known || known.crash !== crash || known.size !== `${width} ${height} ${ratio}`) {
    const canvas = new OffscreenCanvas(Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio)));
    const below = canvas.getContext("2d");
    below.setTransform(ratio, 0, 0, ratio, 0, 0);
    paint(below);
    PAINTED.set(id, { crash, canvas, size: `${width} ${height} ${ratio}` });
  }
  context.drawImage(PAINTED.get(id).canvas, 0, 0, width, height);
}
const COLORS = { "traffic crash": "--crash", "traffic event": "--crash", "software fault": "--fault", "no crash": "--fine" };

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Float32Array(await new Response(stream).arrayBuffer());
}

function fit(canvas) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return [context, width, height];
}

const ofAll = (shown, all) => (shown < all ? `${shown.toLocaleString("en")} of ${all.toLocaleString("en")}` : all.toLocaleString("en"));

function showTip(x, y, text) {
  const tip = $("tip");
  tip.textContent = text;
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(8, Math.min(x + 12, document.documentElement.clientWidth - box.width - 8))}px`;
  tip.style.top = `${y + 14 + box.height > window.innerHeight ? y - box.height - 12 : y + 14}px`;
}
function hideTip() { $("tip").hidden = true; }

/* What is shown of the crash */
const view = { crash: null, step: 0, playing: false, follow: true, scale: 6, x: 0, y: 0, last: 0, clock: 0, frames: 0 };
window.crashhuntView = view;

/* Unpacks what a crash came with; once. */
async function load(crash) {
  if (crash.values) return;
  const [values, ttc, gap, actions] = await Promise.all([crash.table, crash.ttc, crash.gap, crash.actions].map(unpack));
  const [own, behind] = crash.danger ? await Promise.all([crash.danger, crash.behind].map(unpack)) : [null, null];
  Object.assign(crash, { values, ttcs: ttc, gaps: gap, acts: actions, dangers: own, behinds: behind });
  crash.bent = new Map((crash.bends || []).map(([step, actor, line]) => [step * crash.actors.length + actor, line]));
  crash.road = new Path2D();
  crash.marks = new Path2D();
  for (const [rightText, leftText] of crash.lanes) {
    const right = await unpack(rightText), left = await unpack(leftText);
    for (const [side, begin] of [[right, true], [left, true]]) {
      for (let i = 0; i < side.length; i += 2) crash.marks[i === 0 && begin ? "moveTo" : "lineTo"](side[i], side[i + 1]);
    }
    for (let i = 0; i < right.length; i += 2) crash.road[i ? "lineTo" : "moveTo"](right[i], right[i + 1]);
    for (let i = left.length - 2; i >= 0; i -= 2) crash.road.lineTo(left[i], left[i + 1]);
    crash.road.closePath();
  }
}

/* Shows the notes of users, one line each. */
function showNotes(id, notes) {
  $(id).hidden = !notes?.length;
  $(id).replaceChildren(...(notes ?? []).map((note) => make("li", note)));
}

/* Shows what is said of a crash; the rows are names and values of facts of its trial. */
function describe(crash, rows) {
  $("verdict").textContent = crash.verdict;
  $("badges").replaceChildren(...crash.badges.map((text) => make("span", text, "badge")));
  showNotes("crash-notes", crash.notes);
  $("words").replaceChildren(...paragraphs(crash.words));
  $("steps").textContent = crash.table_lines.join("\n");
  $("facts").replaceChildren(...rows.flatMap(([name, value]) => [make("dt", name), make("dd", value, "mono")]));
}

/* Puts a crash that is loaded into the page; the rows are names and values of facts of its trial. */
function show(crash, rows) {
  describe(crash, rows);
  /* Without an animation of what went wrong, the traceback is the answer. */
  $("evidence").open = crash.category === "software fault";
  $("key-agent").textContent = crash.agent;
  $("key-other").textContent = crash.other;
  $("key-other-box").hidden = !crash.other;
  $("key-agents-box").hidden = crash.agents.length < 2;
  $("scrub").max = Math.max(0, crash.steps - 1);
  view.crash = crash;
  view.agent = crash.actors.findIndex((actor) => actor[0] === crash.agent);
  view.follow = true;
  $("danger").hidden = !crash.dangers;
  go(begin(crash));
  pause();
}

/* What happened, a paragraph each; lines of a traceback as they were printed. */
function paragraphs(words) {
  return words.filter((line) => line).map((line) => make("p", line, /^(File|Traceback|\^|\w+Error)/.test(line) ? "mono trace" : ""));
}

/* The last 5 s of a crash; of a near miss, those around the moment when it was nearest. */
function begin(crash) {
  return Math.max(0, crash.nearest === null ? crash.steps - 1 - Math.round(5 / crash.dt) : crash.nearest - Math.round(2.5 / crash.dt));
}
function end(crash) {
  return crash.nearest === null ? crash.steps - 1 : Math.min(crash.steps - 1, crash.nearest + Math.round(2.5 / crash.dt));
}

function state(step, actor) {
  const crash = view.crash, at = 4 * (step * crash.actors.length + actor);
  const x = crash.values[at];
  return Number.isNaN(x) || x === undefined ? null : [x, crash.values[at + 1], crash.values[at + 2], crash.values[at + 3]];
}

function colorOf(actor) {
  const crash = view.crash, id = crash.actors[actor][0];
  if (id === crash.agent) return css("--ego");
  if (id === crash.other) return css("--crash");
  return crash.agents.includes(id) ? css("--agent") : css("--other");
}

function drawScene() {
  const crash = view.crash, [context, width, height] = fit($("scene"));
  if (!crash) return;
  const own = view.agent >= 0 ? state(view.step, view.agent) : null;
  if (view.follow && own) [view.x, view.y] = own;
  context.save();
  context.translate(width / 2, height / 2);
  context.scale(view.scale, -view.scale);
  context.translate(-view.x, -view.y);
  context.fillStyle = css("--road");
  context.fill(crash.road);
  context.strokeStyle = css("--mark");
  context.lineWidth = Math.max(0.12, 0.8 / view.scale);
  context.stroke(crash.marks);
  /* where the two have been */
  for (const id of [crash.agent, crash.other]) {
    const actor = crash.actors.findIndex((entry) => entry[0] === id);
    if (actor < 0) continue;
    context.strokeStyle = colorOf(actor);
    context.globalAlpha = 0.5;
    context.lineWidth = Math.max(0.25, 1.5 / view.scale);
    context.beginPath();
    let down = false;
    for (let step = Math.max(0, view.step - Math.round(4 / crash.dt)); step <= view.step; step++) {
      const pose = state(step, actor);
      if (pose) context[down ? "lineTo" : "moveTo"](pose[0], pose[1]);
      down = pose !== null;
    }
    context.stroke();
    context.globalAlpha = 1;
  }
  for (let actor = 0; actor < crash.actors.length; actor++) {
    const pose = state(view.step, actor);
    if (!pose) continue;
    const [id, , length, breadth] = crash.actors[actor];
    const bend = crash.bent.get(view.step * crash.actors.length + actor);
    if (bend) {
      context.strokeStyle = colorOf(actor);
      context.lineWidth = breadth;
      context.beginPath();
      for (let i = 0; i < bend.length; i += 2) context[i ? "lineTo" : "moveTo"](bend[i], bend[i + 1]);
      context.stroke();
      continue;
    }
    if (id.startsWith("person ")) {
      context.fillStyle = colorOf(actor);
      context.beginPath();
      context.arc(pose[0] - length / 2 * Math.cos(pose[2]), pose[1] - length / 2 * Math.sin(pose[2]), Math.max(length / 2, breadth / 2, 3.5 / view.scale), 0, 7);
      context.fill();
      continue;
    }
    context.save();
    context.translate(pose[0], pose[1]);
    context.rotate(pose[2]);
    context.fillStyle = colorOf(actor);
    context.fillRect(-length, -breadth / 2, length, breadth);
    context.fillStyle = "rgba(0,0,0,0.35)";
    context.fillRect(-length * 0.38, -breadth * 0.4, length * 0.12, breadth * 0.8);
    context.restore();
  }
  context.restore();
  const since = view.step - crash.nearest;
  if ((crash.nearest === null ? view.step === crash.steps - 1 : since >= 0 && since <= 1 / crash.dt) && own) {
    context.strokeStyle = css("--crash");
    context.lineWidth = 2.5;
    context.beginPath();
    context.arc(width / 2 + (own[0] - view.x) * view.scale, height / 2 - (own[1] - view.y) * view.scale, 18, 0, 7);
    context.stroke();
  }
  if (!crash.actors.length) {
    view.frames++;
    context.fillStyle = css("--faint");
    context.font = "14px system-ui";
    context.textAlign = "center";
    context.fillText("this simulator shows no scene", width / 2, height / 2);
    context.textAlign = "start";
    return;
  }
  context.fillStyle = css("--text");
  context.font = "13px system-ui";
  context.strokeStyle = context.fillStyle = css("--fault");
  crash.disturbances.filter(([from, to]) => from <= view.step && view.step <= to).forEach(([, , words, id], place) => {
    context.fillText(words, 14, 24 + 18 * place, width - 28);
    const actor = crash.actors.findIndex((entry) => entry[0] === id), pose = actor < 0 ? null : state(view.step, actor);
    if (!pose) return;
    /* whoever errs, or is not seen */
    const half = crash.actors[actor][2] / 2, x = pose[0] - half * Math.cos(pose[2]), y = pose[1] - half * Math.sin(pose[2]);
    context.lineWidth = 2;
    context.beginPath();
    context.arc(width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale, Math.max(4, half * view.scale) + 5, 0, 7);
    context.stroke();
  });
  const meters = [5, 10, 20, 50, 100, 200, 500].find((length) => length * view.scale > 60) || 1000;
  context.strokeStyle = context.fillStyle = css("--faint");
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(14, height - 12);
  context.lineTo(14 + meters * view.scale, height - 12);
  context.stroke();
  context.font = "12px system-ui";
  context.fillText(`${meters} m`, 14, height - 18);
  view.frames++;
}

function drawPlot() {
  const crash = view.crash, [context, width, height] = fit($("plot"));
  if (!crash) return;
  const left = 34, right = width - 54, top = 16, bottom = height - 18, last = Math.max(1, crash.steps - 1);
  const x = (step) => left + ((right - left) * step) / last;
  if (!crash.speeds) crash.speeds = Array.from({ length: crash.steps }, (_, step) => (view.agent >= 0 && state(step, view.agent) ? state(step, view.agent)[3] : NaN));
  copied("plot", crash, context, width, height, (context) => {
    const speeds = crash.speeds, fastest = speeds.reduce((most, speed) => Math.max(most, Math.ceil(speed) || 0), 10);
    const widest = [10, 20, 50, 100].find((limit) => crash.gaps.every((gap) => !(gap > limit))) ?? 100;
    const curves = [["--s3", crash.gaps, widest], ["--crash", crash.ttcs, 10], ["--accent", speeds, fastest]];
    context.strokeStyle = css("--line");
    context.strokeRect(left + 0.5, top + 0.5, right - left, bottom - top);
    context.font = "11px system-ui";
    for (const [color, series, limit] of curves) {
      context.strokeStyle = css(color);
      context.lineWidth = 1.5;
      context.beginPath();
      let down = false;
      for (let step = 0; step < crash.steps; step++) {
        const value = series[step];
        const there = Number.isFinite(value);
        if (there) context[down ? "lineTo" : "moveTo"](x(step), bottom - ((bottom - top) * Math.min(value, limit)) / limit);
        down = there;
      }
      context.stroke();
    }
    context.fillStyle = css("--crash");
    context.textAlign = "right";
    context.fillText("10 s", left - 4, top + 9);
    context.fillText("TTC", left - 4, bottom);
    context.textAlign = "left";
    context.fillText(crash.other ? `time to collision with ${crash.other}` : "least time to collision with any actor", left, top - 5, right - left - 90);
    context.fillStyle = css("--s3");
    context.textAlign = "right";
    context.fillText(`gap, 0 to ${widest} m`, right, top - 5, 86);
    context.fillStyle = css("--accent");
    context.textAlign = "left";
    context.fillText(`${fastest} m/s`, right + 4, top + 9);
    context.fillText("speed", right + 4, bottom);
    context.fillStyle = css("--faint");
    context.textAlign = "center";
    const ticks = right - left < 300 ? 2 : 4;
    for (let part = 0; part <= ticks; part++) context.fillText(`${(crash.time0 + (part * last * crash.dt) / ticks).toFixed(1)} s`, Math.min(right - 14, Math.max(left + 14, left + ((right - left) * part) / ticks)), height - 4);
    if (crash.escape !== null) {
      context.strokeStyle = css("--faint");
      context.setLineDash([3, 3]);
      context.beginPath();
      context.moveTo(x(crash.escape), top);
      context.lineTo(x(crash.escape), bottom);
      context.stroke();
      context.setLineDash([]);
    }
    /* when others erred, or the agent saw or acted late; the scene of a step is what has come of it */
    context.fillStyle = css("--fault");
    for (const [from, to] of crash.disturbances) context.fillRect(x(Math.min(from, last)), bottom - 3, Math.max(2, x(Math.min(to, last)) - x(Math.min(from, last))), 3);
  });
  drawCursor(context, x(view.step), top, bottom);
}

function drawCursor(context, x, top, bottom) {
  context.strokeStyle = css("--text");
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(x, bottom);
  context.stroke();
}

function drawDanger() {
  const crash = view.crash;
  if (!crash || !crash.dangers) return;
  const [context, width, height] = fit($("danger"));
  const left = 34, right = width - 54, top = 16, bottom = height - 6, last = Math.max(1, crash.steps - 1);
  const x = (step) => left + ((right - left) * step) / last;
  copied("danger", crash, context, width, height, (context) => {
    context.strokeStyle = css("--line");
    context.strokeRect(left + 0.5, top + 0.5, right - left, bottom - top);
    for (const [color, series, dashes] of [["--accent", crash.behinds, [4, 3]], ["--ego", crash.dangers, []]]) {
      context.strokeStyle = css(color);
      context.lineWidth = 1.5;
      context.setLineDash(dashes);
      context.beginPath();
      let down = false;
      for (let step = 0; step < crash.steps; step++) {
        const there = Number.isFinite(series[step]);
        const y = bottom - (bottom - top) * series[step];
        if (there) context[down ? "lineTo" : "moveTo"](x(step), y);
        /* A step between two without a value, such as that of a lane change, would be no line. */
        if (there && !down && !Number.isFinite(series[step + 1])) context.rect(x(step) - 1, y - 1, 2, 2);
        down = there;
      }
      context.stroke();
    }
    context.setLineDash([]);
    context.font = "11px system-ui";
    context.fillStyle = css("--faint");
    context.textAlign = "right";
    context.fillText("1", left - 4, top + 9);
    context.fillText("0", left - 4, bottom);
    context.textAlign = "left";
    context.fillText("criticality (all actors)", left, top - 5);
    const free = left + context.measureText("criticality (all actors)").width + 8;
    context.fillStyle = css("--ego");
    context.fillText("own", right + 4, top + 9);
    context.fillStyle = css("--accent");
    context.fillText("rear", right + 4, bottom);
    if (crash.nearest !== null || COLORS[crash.category] === "--crash") {
      const at = crash.nearest === null ? last : crash.nearest;
      context.strokeStyle = context.fillStyle = css("--crash");
      context.lineWidth = 2;
      context.beginPath();
      context.moveTo(x(at), top);
      context.lineTo(x(at), bottom);
      context.stroke();
      context.textAlign = x(at) > (left + right) / 2 ? "right" : "left";
      context.fillText(crash.nearest === null ? "crash" : "nearest", Math.max(free, x(at)), top - 5);
    }
  });
  drawCursor(context, x(view.step), top, bottom);
}

const share = (value) => (Number.isFinite(value) ? value.toFixed(2) : "-");

/* The actors to which time to collision and gap of a step belong: the collision partner, or the closest ones. */
function partners(crash, step) {
  if (crash.other) return [crash.other, crash.other];
  return crash.closest[step] ?? ["", ""];
}

function showNow() {
  const crash = view.crash, own = view.agent >= 0 ? state(view.step, view.agent) : null;
  const number = (value, unit) => (Number.isFinite(value) ? `${value.toFixed(1)} ${unit}` : "-");
  const [ttcWith, gapTo] = partners(crash, view.step);
  const parts = [["step", `${view.step} of ${crash.steps - 1}`], ["time", number(crash.time0 + view.step * crash.dt, "s")], ["speed", number(own ? own[3] : NaN, "m/s")], [`TTC${ttcWith && ` with ${ttcWith}`}`, number(crash.ttcs[view.step], "s")], [`gap${gapTo && ` to ${gapTo}`}`, number(crash.gaps[view.step], "m")]];
  if (crash.dangers) parts.push(["criticality", share(crash.dangers[view.step])], ["rear criticality", share(crash.behinds[view.step])]);
  crash.actionNames.forEach((name, place) => {
    const value = crash.acts[view.step * crash.actionNames.length + place];
    parts.push([name, Number.isNaN(value) ? "-" : String(Number(value.toPrecision(4)))]);
  });
  $("now").replaceChildren(...parts.map(([name, value]) => {
    const span = make("span", `${name} `, "faint");
    span.append(make("b", value));
    span.lastChild.style.color = "var(--text)";
    return span;
  }));
}

function go(step) {
  view.step = Math.min(Math.max(0, step), view.crash.steps - 1);
  view.clock = view.step;
  $("scrub").value = view.step;
  $("scrub").setAttribute("aria-valuetext", `step ${view.step}`);
  draw();
}
function draw() { if (view.crash) { drawScene(); drawPlot(); drawDanger(); showNow(); $("follow").setAttribute("aria-pressed", String(view.follow)); } }
function pause() { view.playing = false; $("play").textContent = "Play"; }
function play() {
  if (view.step >= view.crash.steps - 1) go(view.crash.nearest === null ? 0 : begin(view.crash));
  view.playing = true;
  view.last = performance.now();
  $("play").textContent = "Pause";
  requestAnimationFrame(tick);
}
function tick(now) {
  if (!view.playing) return;
  view.clock += ((now - view.last) / 1000 / view.crash.dt) * Number($("rate").value);
  view.last = now;
  const step = Math.min(Math.floor(view.clock), view.crash.steps - 1), clock = view.clock;
  const passed = view.step < end(view.crash) && step >= end(view.crash);
  if (step !== view.step) { go(step); view.clock = clock; }
  if (passed || step >= view.crash.steps - 1) pause();
  else requestAnimationFrame(tick);
}
function toggle() { if (view.playing) pause(); else play(); }
function zoom(factor) { view.scale = Math.min(60, Math.max(0.5, view.scale * factor)); draw(); }
function step(count) { pause(); go(view.step + count); }

$("play").onclick = toggle;
$("back").onclick = () => step(-1);
$("forth").onclick = () => step(1);
$("in").onclick = () => zoom(1.4);
$("out").onclick = () => zoom(1 / 1.4);
$("follow").onclick = () => { view.follow = !view.follow; draw(); };
$("scrub").oninput = (event) => { pause(); go(Number(event.target.value)); };
$("scene").addEventListener("wheel", (event) => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15); }, { passive: false });
let drag = null;
$("scene").onpointerdown = (event) => { drag = [event.clientX, event.clientY]; $("scene").setPointerCapture(event.pointerId); };
$("scene").onpointermove = (event) => {
  if (!drag) return;
  view.follow = false;
  view.x -= (event.clientX - drag[0]) / view.scale;
  view.y += (event.clientY - drag[1]) / view.scale;
  drag = [event.clientX, event.clientY];
  draw();
};
$("scene").onpointerup = $("scene").onpointercancel = () => { drag = null; };
for (const id of ["plot", "danger"]) {
  const seek = (event) => {
    const box = $(id).getBoundingClientRect();
    pause();
    go(Math.round(((event.clientX - box.left - 34) / (box.width - 88)) * (view.crash.steps - 1)));
  };
  $(id).onpointerdown = (event) => { seek(event); $(id).setPointerCapture(event.pointerId); };
  $(id).onpointermove = (event) => { if (event.buttons) seek(event); else tellStep(event); };
  $(id).onpointerleave = hideTip;
}
function tellStep(event) {
  const crash = view.crash, box = $("plot").getBoundingClientRect();
  const at = Math.min(Math.max(0, Math.round(((event.clientX - box.left - 34) / (box.width - 88)) * (crash.steps - 1))), crash.steps - 1);
  const number = (value, unit) => (Number.isFinite(value) ? `${value.toFixed(1)} ${unit}` : "-");
  const [ttcWith, gapTo] = partners(crash, at);
  const parts = [`step ${at}, ${(crash.time0 + at * crash.dt).toFixed(Math.abs(10 * crash.dt - Math.round(10 * crash.dt)) < 1e-6 ? 1 : 2)} s`, `speed ${number(crash.speeds[at], "m/s")}`, `time to collision${ttcWith && ` with ${ttcWith}`} ${number(crash.ttcs[at], "s")}`, `gap${gapTo && ` to ${gapTo}`} ${number(crash.gaps[at], "m")}`];
  if (crash.dangers) parts.push(`criticality ${share(crash.dangers[at])}, rear criticality ${share(crash.behinds[at])}`);
  showTip(event.clientX, event.clientY, parts.join("\n"));
}
/* Whoever clicks does not want the keys to go to what was clicked; whoever presses a key there does. */
let pointed = false;
document.addEventListener("pointerdown", () => { pointed = true; }, true);
document.addEventListener("keydown", () => { pointed = false; }, true);
document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (button && pointed) button.blur();
});
$("rate").addEventListener("change", () => { if (pointed) $("rate").blur(); });
document.addEventListener("keydown", (event) => {
  if (!view.crash || event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  if (event.target.tagName === "BUTTON" && [" ", "Enter"].includes(event.key)) return;
  const count = event.shiftKey ? 10 : 1;
  const actions = { " ": toggle, ArrowLeft: () => step(-count), ArrowRight: () => step(count), Home: () => step(-Infinity), End: () => step(Infinity), "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), f: $("follow").onclick };
  if (actions[event.key]) { event.preventDefault(); actions[event.key](); }
});
