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
async function unpackBytes(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
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
const view = { crash: null, step: 0, playing: false, follow: true, ids: false, observed: true, whole: false, picked: "", scale: 6, x: 0, y: 0, last: 0, clock: 0, frames: 0 };
window.crashhuntView = view;

/* Unpacks what a crash came with; once. */
async function load(crash) {
  if (crash.values) return;
  const [values, ttc, gap, actions] = await Promise.all([crash.table, crash.ttc, crash.gap, crash.actions].map(unpack));
  const [own, behind] = crash.danger ? await Promise.all([crash.danger, crash.behind].map(unpack)) : [null, null];
  Object.assign(crash, { values, ttcs: ttc, gaps: gap, acts: actions, dangers: own, behinds: behind });
  for (const layer of [crash.plan, ...Object.values(crash.observed?.layers ?? {})].filter(Boolean)) layer.array = await unpack(layer.values);
  for (const seen of [crash.seen, crash.seenTable].filter(Boolean)) seen.array = await unpack(seen.values);
  for (const picture of Object.values(crash.pictures ?? {})) picture.array = await unpackBytes(picture.bytes);
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
  crash.buildings = await Promise.all((crash.obstacles ?? []).map(async (packed) => {
    const outline = await unpack(packed), area = new Path2D();
    for (let i = 0; i < outline.length; i += 2) area.lineTo(outline[i], outline[i + 1]);
    return area;
  }));
}

/* The observed matrix of a step, such as highway-env's Kinematics; rows of zeros have no actor. */
function showSeen() {
  const table = view.crash.seenTable;
  $("seen-box").hidden = !table;
  if (!table || !$("seen-box").open) return;
  const width = table.names.length, begin = (view.step - table.first) * table.rows * width;
  const rows = Array.from({ length: table.rows }, (_, row) => [row, ...table.array.slice(begin + row * width, begin + (row + 1) * width)]);
  const shown = begin < 0 ? [] : rows.filter((row) => row.length > 1 && row.slice(1).some(Boolean));
  const lines = [["row", ...table.names], ...shown.map((row) => row.map((value) => formatNumber(value + 0)))]; // -0 is 0
  const widths = lines[0].map((_, column) => Math.max(...lines.map((line) => line[column].length)));
  const text = lines.map((line) => line.map((cell, column) => cell.padStart(widths[column])).join("  ")).join("\n");
  $("seen").textContent = shown.length ? text : `no observation is shown at this step; those of steps ${table.first} to ${table.first + table.array.length / table.rows / width - 1} are`;
}
$("seen-box").addEventListener("toggle", () => { if (view.crash) showSeen(); });

/* The last steps are those that matter. */
$("steps").closest("details").addEventListener("toggle", () => { $("steps").scrollTop = $("steps").scrollHeight; });

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
  $("key-agent").textContent = crash.agent;
  $("key-other").textContent = crash.other;
  $("key-other-box").hidden = !crash.other;
  $("key-agents-box").hidden = crash.agents.length < 2;
  $("key-observed").hidden = !crash.observed && !crash.pictures;
  $("key-route").hidden = !crash.way?.routes.length;
  $("key-plan").hidden = !crash.plan;
  $("scrub").max = Math.max(0, crash.steps - 1);
  view.crash = crash;
  view.agent = crash.actors.findIndex((actor) => actor[0] === crash.agent);
  view.other = crash.actors.findIndex((actor) => actor[0] === crash.other);
  view.follow = true;
  view.picked = "";
  view.step = begin(crash);
  $("pictures").replaceChildren();
  $("scene").style.height = crash.actors.length ? "" : "48px";
  for (const id of ["in", "out", "follow", "fit", "ids", "key-scene"]) $(id).hidden = !crash.actors.length;
  $("observed").hidden = !crash.observed && !crash.pictures;
  crash.rows ??= rowsOf(crash);
  $("plot").style.height = `${HEAD + crash.rows.length * ROW + BELOW}px`;
  $("avoidable").hidden = $("avoidable-words").hidden = !crash.avoidable;
  $("avoidable-words").textContent = crash.avoidable ? `Last avoidable step: ${crash.avoidable[0]}. A run from this step avoids the crash, in which ${crash.agent} ${crash.avoidable[1]}.${crash.avoidable[2] ? ` After it, the dashed outline shows where braking at ${crash.avoidable[2].toFixed(1)} m/s² leads (a calculation).` : ""}` : "";
  fitEncounter();
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

/* The scale at which the agent and its collision partner are both in sight, half a second before the end. */
function fitEncounter() {
  const crash = view.crash, at = Math.max(0, end(crash) - Math.round(1.5 / crash.dt)), canvas = $("scene");
  const own = view.agent < 0 ? null : state(at, view.agent), its = view.other < 0 ? null : state(at, view.other);
  view.follow = true;
  view.scale = 6;
  if (!own || !its) return;
  const across = Math.abs(own[0] - its[0]) + 12, up = Math.abs(own[1] - its[1]) + 12;
  view.scale = Math.min(16, Math.max(2.5, Math.min(canvas.clientWidth / 2 / across, canvas.clientHeight / 2 / up)));
}

function state(step, actor) {
  const crash = view.crash, at = 4 * (step * crash.actors.length + actor);
  const x = crash.values[at];
  return Number.isNaN(x) || x === undefined ? null : [x, crash.values[at + 1], crash.values[at + 2], crash.values[at + 3]];
}

function colorOf(actor) {
  const crash = view.crash, id = crash.actors[actor][0];
  if (id === crash.agent) return css("--ego");
  if (id === crash.other) return css("--partner");
  return crash.agents.includes(id) ? css("--agent") : css("--other");
}

/* The acceleration of an actor over the last step, in m/s². */
function accelerationOf(step, actor) {
  const now = actor < 0 ? null : state(step, actor), before = actor < 0 || step < 1 ? null : state(step - 1, actor);
  return now && before ? (now[3] - before[3]) / view.crash.dt : NaN;
}
const SLOWS_DOWN = -0.5;  // m/s²

/* Where the outlines of the agent and its collision partner are closest; null where one of them is not there. */
function contactPoint(step) {
  const crash = view.crash, COUNT = 40;
  const outline = (actor) => {
    const pose = actor < 0 || crash.nearest !== null ? null : state(step, actor);
    if (!pose) return null;
    const [, , length, breadth] = crash.actors[actor], [x, y, heading] = pose, points = [];
    const corners = [[0, breadth / 2], [-length, breadth / 2], [-length, -breadth / 2], [0, -breadth / 2]];
    corners.forEach(([ahead, left], place) => {
      const [nextAhead, nextLeft] = corners[(place + 1) % 4];
      for (let part = 0; part < COUNT; part++) {
        const along = ahead + ((nextAhead - ahead) * part) / COUNT, across = left + ((nextLeft - left) * part) / COUNT;
        points.push([x + along * Math.cos(heading) - across * Math.sin(heading), y + along * Math.sin(heading) + across * Math.cos(heading)]);
      }
    });
    return points;
  };
  const own = outline(view.agent), its = outline(view.other);
  if (!own || !its) return null;
  let least = Infinity, found = null;
  for (const a of own) for (const b of its) {
    const apart = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2;
    if (apart < least) [least, found] = [apart, [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]];
  }
  return found;
}

/* The values of a layer at the present step. The agent observes and plans at each scene but the last one, where the
   values of the scene before are drawn. */
function layerAt(layer, first, step = view.step) {
  if (!layer) return null;
  const size = layer.size.reduce((all, one) => all * one, 1), number = Math.min(step, view.crash.steps - 2) - first;
  return number < 0 || (number + 1) * size > layer.array.length ? null : layer.array.subarray(number * size, (number + 1) * size);
}
const seenAt = (name) => layerAt(view.crash.observed?.layers[name], view.crash.observed?.first);
function wordsAt(step) {
  const { first, words } = view.crash.observed ?? { first: 0, words: [] }, observed = words[Math.min(step, view.crash.steps - 2) - first] ?? [];
  const way = until(view.crash.way?.words, step)?.[1] ?? [];
  return [...observed, ...way.filter(([name]) => !observed.some(([other]) => other === name))];
}
/* The last entry of a list of [step, ...] that begins at a step or before it. */
function until(changes, step) { return (changes ?? []).findLast(([begin]) => begin <= step); }
/* Brake light and indicator: as the replay has read them from the simulator, or as the agent has observed them. */
function lightsAt(step, id) {
  const { first, lights } = view.crash.observed ?? { first: 0 }, known = until(view.crash.vehicleLights?.[id], step);
  return known ? [id, known[1], known[2]] : lights?.[Math.min(step, view.crash.steps - 2) - first]?.find(([name]) => name === id);
}

/* Stop lines, by the rule at them: solid where a vehicle has to stop, dashed where it has to yield, dotted at traffic lights. */
const RULES = { stop: [], allway_stop: [], yield: [1.2, 0.6], right_before_left: [1.2, 0.6], traffic_light: [0.4, 0.4] };
const SIGNAL_COLORS = { g: "#2e9e5b", y: "#e0a800", r: "#d50000", o: "#8593a6" };
function drawStopLines(context) {
  for (const [kind, [x0, y0, x1, y1], changes] of view.crash.stopLines ?? []) {
    context.strokeStyle = css("--text");
    context.lineWidth = Math.max(0.4, 2 / view.scale);
    context.setLineDash(RULES[kind] ?? []);
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    context.stroke();
    /* A disc per colour that the lane shows: more than one if its directions differ. */
    const colours = [...(until(changes, view.step)?.[1] ?? "")], radius = Math.max(0.6, 5 / view.scale);
    context.setLineDash([]);
    colours.forEach((colour, place) => {
      const share = (place + 1) / (colours.length + 1), x = x0 + share * (x1 - x0), y = y0 + share * (y1 - y0);
      context.fillStyle = SIGNAL_COLORS[colour] ?? SIGNAL_COLORS.o;
      context.lineWidth = 1.5 / view.scale;
      context.beginPath();
      context.arc(x, y, radius, 0, 7);
      context.fill();
      context.stroke();
      if (colour !== "r" && colour !== "y") return;
      /* Red and yellow have a shape besides the colour: a bar, and a dot. */
      context.fillStyle = "#ffffff";
      if (colour === "r") context.fillRect(x - 0.55 * radius, y - 0.16 * radius, 1.1 * radius, 0.32 * radius);
      else { context.beginPath(); context.arc(x, y, 0.3 * radius, 0, 7); context.fill(); }
    });
  }
  context.setLineDash([]);
}

/* The route of the agent, as the replay has read it from the simulator; what the agent observes of it is drawn apart. */
function drawRoute(context) {
  const points = until(view.crash.way?.routes, view.step)?.[1];
  if (!points?.length || (view.observed && view.crash.observed?.layers.route)) return;
  context.strokeStyle = css("--ego-line");
  context.globalAlpha = 0.55;
  context.lineWidth = 3 / view.scale;
  context.setLineDash([10 / view.scale, 6 / view.scale]);
  context.beginPath();
  for (let at = 0; at < points.length; at += 2) context[at ? "lineTo" : "moveTo"](points[at], points[at + 1]);
  context.stroke();
  context.setLineDash([]);
  context.globalAlpha = 1;
}

/* What the agent observed, in its own colour: the route, lanes, boxes, predictions and points of lidar. */
function drawObserved(context) {
  const thin = 1.5 / view.scale, crash = view.crash, own = state(Math.min(view.step, crash.steps - 2), view.agent);
  const lines = (values, points) => {
    context.beginPath();
    for (let begin = 0; begin < values.length; begin += 2 * points) {
      let down = false;
      for (let at = begin; at < begin + 2 * points; at += 2) {
        const there = Number.isFinite(values[at]);
        if (there) context[down ? "lineTo" : "moveTo"](values[at], values[at + 1]);
        down = there;
      }
    }
    context.stroke();
  };
  context.strokeStyle = context.fillStyle = css("--observed");
  for (const [name, width, dash] of [["lanes", 1, [2, 4]], ["route", 3, [8, 5]], ["predictions", 1.5, [2, 2]]]) {
    const values = seenAt(name);
    if (!values) continue;
    context.lineWidth = width / view.scale;
    context.setLineDash(dash.map((one) => one / view.scale));
    lines(values, crash.observed.layers[name].size.at(-2));
  }
  context.setLineDash([]);
  context.lineWidth = thin;
  const boxes = seenAt("actors") ?? [];
  for (let at = 0; at < boxes.length; at += 5) {
    if (!Number.isFinite(boxes[at])) continue;
    context.save();
    context.translate(boxes[at], boxes[at + 1]);
    context.rotate(boxes[at + 2]);
    context.strokeRect(-boxes[at + 3] / 2 - 0.3, -boxes[at + 4] / 2 - 0.3, boxes[at + 3] + 0.6, boxes[at + 4] + 0.6);
    context.restore();
  }
  const rays = seenAt("lidar2d");
  if (!rays || !own) return;
  const half = crash.actors[view.agent][2] / 2, x = own[0] - half * Math.cos(own[2]), y = own[1] - half * Math.sin(own[2]);
  const reach = rays.reduce((most, one) => Math.max(most, one), 0), dot = 2 / view.scale;
  rays.forEach((distance, place) => {
    if (!(distance < reach - 0.01)) return;
    const angle = own[2] + (2 * Math.PI * place) / rays.length;
    context.fillRect(x + distance * Math.cos(angle) - dot, y + distance * Math.sin(angle) - dot, 2 * dot, 2 * dot);
  });
}

/* The pictures that the agent observed at this scene, next to each other below the scene. */
function drawPictures() {
  const crash = view.crash, known = Object.entries(crash.pictures ?? {});
  $("pictures").hidden = !known.length || !view.observed;
  if ($("pictures").hidden) return;
  if ($("pictures").childElementCount !== known.length) {
    $("pictures").replaceChildren(...known.map(([name]) => {
      const box = make("figure"), canvas = make("canvas");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `What the agent observed: ${name}`);
      box.append(canvas, make("figcaption", "", "faint"));
      return box;
    }));
  }
  known.forEach(([name, { first, size: [height, width, colours], array }], place) => {
    const box = $("pictures").children[place], canvas = box.firstChild, size = height * width * colours;
    const number = Math.min(view.step, crash.steps - 2) - first, there = number >= 0 && (number + 1) * size <= array.length;
    box.lastChild.textContent = there ? `observed: ${name}` : `observed: ${name} (from step ${first} on)`;
    [canvas.width, canvas.height] = [width, height];
    canvas.style.width = `${Math.max(160, Math.min(320, 2 * width))}px`;
    if (!there) return;
    const context = canvas.getContext("2d"), image = context.createImageData(width, height);
    for (let at = 0; at < height * width; at++) {
      for (let colour = 0; colour < 3; colour++) image.data[4 * at + colour] = array[number * size + at * colours + (colours === 3 ? colour : 0)];
      image.data[4 * at + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  });
}

/* The poses that the agent planned at this scene: a line with a dot for each. */
function drawPlan(context) {
  const values = layerAt(view.crash.plan, view.crash.plan?.first), own = state(Math.min(view.step, view.crash.steps - 2), view.agent);
  if (!values || !own) return;
  context.strokeStyle = context.fillStyle = css("--plan");
  context.lineWidth = 2.5 / view.scale;
  context.beginPath();
  context.moveTo(own[0] - (view.crash.actors[view.agent][2] / 2) * Math.cos(own[2]), own[1] - (view.crash.actors[view.agent][2] / 2) * Math.sin(own[2]));
  for (let at = 0; at < values.length; at += 2) if (Number.isFinite(values[at])) context.lineTo(values[at], values[at + 1]);
  context.stroke();
  for (let at = 0; at < values.length; at += 2) {
    context.beginPath();
    if (Number.isFinite(values[at])) context.arc(values[at], values[at + 1], 3 / view.scale, 0, 7);
    context.fill();
  }
}

/* The vehicle under the pointer; the nearest one within a few pixels. */
function vehicleAt(event) {
  const crash = view.crash, box = $("scene").getBoundingClientRect();
  const x = view.x + (event.clientX - box.left - box.width / 2) / view.scale, y = view.y - (event.clientY - box.top - box.height / 2) / view.scale;
  let found = "", least = Infinity;
  crash.actors.forEach(([id, , length, breadth], actor) => {
    const pose = state(view.step, actor);
    if (!pose) return;
    const [dx, dy] = [x - pose[0], y - pose[1]], along = dx * Math.cos(pose[2]) + dy * Math.sin(pose[2]), across = dy * Math.cos(pose[2]) - dx * Math.sin(pose[2]);
    const apart = Math.max(Math.abs(along + length / 2) - length / 2, Math.abs(across) - breadth / 2);
    if (apart < Math.min(least, 8 / view.scale)) [least, found] = [apart, id];
  });
  return found;
}

/* The facts of the chosen vehicle at this step. */
function showPicked() {
  const crash = view.crash, actor = crash.actors.findIndex(([id]) => id === view.picked), pose = actor < 0 ? null : state(view.step, actor);
  $("vehicle").hidden = actor < 0;
  if (actor < 0) return;
  const [id, kind, length, breadth] = crash.actors[actor], rows = [["vehicle", id], ["kind", `${kind}, ${measured(length, "m")} long, ${measured(breadth, "m")} wide`]];
  if (pose) {
    const own = id === crash.agent ? null : state(view.step, view.agent), light = lightsAt(view.step, id), pull = accelerationOf(view.step, actor);
    rows.push(["speed", measured(pose[3], "m/s")], ["acceleration", measured(pull, "m/s²")]);
    const [since, lane] = (crash.actorLanes ?? []).filter(([step, lanes]) => step <= view.step && lanes[id]).map(([step, lanes]) => [step, lanes[id]]).at(-1) ?? [];
    if (lane) rows.push(["lane", since === view.step ? lane : `${lane} (at step ${since})`]);
    if (light) rows.push(["lights", [light[1] ? "brake" : "", { 1: "left indicator", "-1": "right indicator", 2: "hazard lights" }[light[2]]].filter(Boolean).join(", ")]);
    if (own) {
      const [dx, dy] = [pose[0] - own[0], pose[1] - own[1]], ahead = dx * Math.cos(own[2]) + dy * Math.sin(own[2]), left = dy * Math.cos(own[2]) - dx * Math.sin(own[2]);
      rows.push([`seen from ${crash.agent}`, `${measured(Math.abs(ahead), "m")} ${ahead < 0 ? "behind" : "ahead"}${Math.abs(left) < 0.05 ? "" : `, ${measured(Math.abs(left), "m")} to the ${left < 0 ? "right" : "left"}`} (front bumpers)`]);
    }
  } else rows.push(["at this step", "not in the scene"]);
  const roles = [id === crash.agent ? "agent" : crash.agents.includes(id) ? "another agent" : "", id === crash.other ? "collision partner" : "", crash.yields ? { [crash.yields]: "must yield by the map", [[crash.agent, crash.other].find((one) => one !== crash.yields)]: "has priority by the map" }[id] : ""].filter(Boolean);
  if (roles.length) rows.push(["role", roles.join(", ")]);
  $("vehicle-facts").replaceChildren(...rows.flatMap(([name, value]) => [make("dt", name), make("dd", value, "mono")]));
}

/* Words with a halo, which can be read on any ground. */
function label(context, text, x, y) {
  context.font = "12px system-ui";
  context.lineJoin = "round";
  context.lineWidth = 3;
  context.strokeStyle = css("--page");
  context.strokeText(text, x, y);
  context.fillStyle = css("--text");
  context.fillText(text, x, y);
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
  context.fillStyle = css("--building");
  for (const area of crash.buildings) context.fill(area);
  drawStopLines(context);
  drawRoute(context);
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
    if (id === crash.agent || id === crash.other) {
      context.strokeStyle = css("--text");
      context.lineWidth = Math.max(0.12, 1.2 / view.scale);
      context.strokeRect(-length, -breadth / 2, length, breadth);
    }
    if (accelerationOf(view.step, actor) < SLOWS_DOWN) {
      context.fillStyle = css("--brake");
      for (const side of [-0.5, 0.2]) context.fillRect(-length, side * breadth, Math.max(0.5, 3 / view.scale), 0.3 * breadth);
    }
    const indicator = lightsAt(view.step, id)?.[2] ?? 0, light = Math.max(0.6, 4 / view.scale);
    context.fillStyle = css("--indicator");
    for (const side of indicator === 2 ? [1, -1] : indicator ? [indicator] : []) {
      for (const along of [-light, -length]) context.fillRect(along, side > 0 ? breadth / 2 - light / 2 : -breadth / 2 - light / 2, light, light);
    }
    if (id === view.picked) {
      context.strokeStyle = css("--accent");
      context.lineWidth = 3 / view.scale;
      context.strokeRect(-length - 0.5, -breadth / 2 - 0.5, length + 1, breadth + 1);
    }
    context.restore();
  }
  if (view.observed) drawObserved(context);
  drawPlan(context);
  drawGhost(context);
  context.restore();
  context.textAlign = "center";
  for (let actor = 0; actor < crash.actors.length; actor++) {
    const pose = state(view.step, actor), [id, , length, breadth] = crash.actors[actor];
    if (!pose || !(view.ids || id === crash.agent || id === crash.other)) continue;
    const x = width / 2 + (pose[0] - length / 2 * Math.cos(pose[2]) - view.x) * view.scale, y = height / 2 - (pose[1] - length / 2 * Math.sin(pose[2]) - view.y) * view.scale;
    if (x < 0 || x > width || y < 0 || y > height) continue;
    const reach = (Math.abs(length * Math.sin(pose[2])) + Math.abs(breadth * Math.cos(pose[2]))) / 2 * view.scale;
    /* The two may touch, so that the label of one is above it and that of the other below. */
    const priority = !crash.yields || ![crash.agent, crash.other].includes(id) ? "" : id === crash.yields ? " (must yield)" : " (has priority)";
    label(context, `${id}${priority}`, x, id === crash.other ? y + reach + 15 : y - reach - 5);
  }
  context.textAlign = "start";
  const since = view.step - crash.nearest;
  if ((crash.nearest === null ? view.step === crash.steps - 1 : since >= 0 && since <= 1 / crash.dt) && own) {
    context.strokeStyle = css("--crash");
    context.lineWidth = 2.5;
    context.beginPath();
    const [x, y] = contactPoint(view.step) ?? own;
    context.arc(width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale, 18, 0, 7);
    context.stroke();
  }
  if (!crash.actors.length) {
    view.frames++;
    context.fillStyle = css("--faint");
    context.font = "14px system-ui";
    context.textAlign = "center";
    context.fillText(`this simulator shows no scene${crash.pictures ? "; the agent observed the picture below" : ""}`, width / 2, height / 2);
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
  const signal = wordsAt(view.step).find(([name]) => name === "signal")?.[1];
  if (signal) {
    context.textAlign = "right";
    label(context, `signal ${signal}`, width - 30, 24);
    context.textAlign = "start";
    context.fillStyle = SIGNAL_COLORS[signal[0]] ?? SIGNAL_COLORS.o;
    context.beginPath();
    context.arc(width - 18, 20, 7, 0, 7);
    context.fill();
  }
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

/* Where the agent would be if it had braked from the last avoidable step on, along its recorded way; others as recorded.
   This is a calculation: the run of `judge` itself is not recorded. */
function ghostOf(step) {
  const crash = view.crash, [from, , braking] = crash.avoidable ?? [Infinity, "", null];
  if (!braking || step <= from || view.agent < 0) return null;
  const first = state(from, view.agent), time = Math.min((step - from) * crash.dt, first ? first[3] / braking : 0);
  if (!first) return null;
  let left = first[3] * time - braking * time ** 2 / 2, at = first;
  for (let number = from + 1; number < crash.steps; number++) {
    const next = state(number, view.agent);
    if (!next) return null;
    const apart = Math.hypot(next[0] - at[0], next[1] - at[1]);
    if (apart >= left) {
      const part = apart ? left / apart : 0;
      return [at[0] + part * (next[0] - at[0]), at[1] + part * (next[1] - at[1]), at[2]];
    }
    left -= apart;
    at = next;
  }
  return null;
}
function drawGhost(context) {
  const pose = ghostOf(view.step);
  if (!pose) return;
  const [, , length, breadth] = view.crash.actors[view.agent];
  context.save();
  context.translate(pose[0], pose[1]);
  context.rotate(pose[2]);
  context.strokeStyle = css("--text");
  context.lineWidth = 1.5 / view.scale;
  context.setLineDash([4 / view.scale, 3 / view.scale]);
  context.strokeRect(-length, -breadth / 2, length, breadth);
  context.restore();
}

/* The curves: one above the other, each with its own axis. */
const HEAD = 14, ROW = 66, TITLE = 16, BELOW = 22, LEFT = 56, RIGHT = 12, TTC_CUT_S = 10, GAP_CUT_M = 100, PULL_CUT_MPS2 = 12;
const ROUND = [1, 2, 3, 5, 10, 15, 20, 30, 40, 50, 60, 80, 100, 150, 200];
function rowsOf(crash) {
  const whole = (count, value) => Float32Array.from({ length: count }, (_, step) => value(step));
  const speedOf = (actor) => whole(crash.steps, (step) => (actor < 0 ? NaN : state(step, actor)?.[3] ?? NaN));
  const most = (...series) => series.reduce((all, one) => one.reduce((top, value) => (value > top ? value : top), all), 0);
  const above = (value) => ROUND.find((limit) => limit >= value) ?? Math.ceil(value / 100) * 100;
  crash.speeds = speedOf(view.agent);
  crash.otherSpeeds = speedOf(view.other);
  crash.pulls = whole(crash.steps, (step) => accelerationOf(step, view.agent));
  crash.otherPulls = whole(crash.steps, (step) => accelerationOf(step, view.other));
  const own = (values, more = {}) => ({ name: crash.agent, color: "--ego-line", values, ...more });
  const its = (values) => (view.other < 0 ? [] : [{ name: crash.other, color: "--partner", dash: [5, 3], values }]);
  const widest = above(Math.min(GAP_CUT_M, most(crash.gaps)));
  const braked = most(...[crash.pulls, crash.otherPulls].map((one) => one.map((value) => -value)));
  const strongest = Math.min(PULL_CUT_MPS2, above(Math.max(1, braked))), quickest = Math.min(PULL_CUT_MPS2, above(Math.max(1, most(crash.pulls, crash.otherPulls))));
  const rows = [
    { title: `time to collision${crash.other ? ` with ${crash.other}` : " with any actor"}`, unit: "s", low: 0, high: TTC_CUT_S, series: [{ name: "", color: "--accent", values: crash.ttcs }] },
    { title: `gap${crash.other ? ` to ${crash.other}` : " to the closest actor"}`, unit: "m", low: 0, high: widest, series: [{ name: "", color: "--accent", values: crash.gaps }] },
    { title: "speed", unit: "m/s", low: 0, high: above(most(crash.speeds, crash.otherSpeeds)), series: [own(crash.speeds), ...its(crash.otherSpeeds)] },
    { title: "acceleration", unit: "m/s²", low: -strongest, high: quickest, series: [own(crash.pulls), ...its(crash.otherPulls)] },
  ];
  if (crash.dangers) rows.push({ title: "criticality", unit: "", low: 0, high: 1, series: [own(crash.dangers, { name: "own" }), { name: "rear", color: "--faint", dash: [2, 3], values: crash.behinds }] });
  const size = crash.actionNames.length;
  crash.actionNames.slice(0, 4).forEach((name, place) => {
    const values = whole(crash.steps, (step) => crash.acts[step * size + place]), finite = values.filter(Number.isFinite);
    if (!finite.length) return;
    const low = finite.reduce((a, b) => Math.min(a, b)), high = finite.reduce((a, b) => Math.max(a, b));
    const words = [...new Set(finite)].sort((a, b) => a - b).filter((value) => actionWord(crash, value)).map((value) => `${value} ${actionWord(crash, value)}`);
    rows.push({ title: `action: ${words.join(", ") || name}`, unit: "", low: low === high ? low - 1 : low, high: low === high ? high + 1 : high, isStep: true, series: [own(values, { name: "" })] });
  });
  crash.seen?.names.forEach((name, place) => {
    const values = whole(crash.steps, (step) => crash.seen.array[step * crash.seen.names.length + place]), finite = values.filter(Number.isFinite);
    if (!finite.length) return;
    const low = finite.reduce((a, b) => Math.min(a, b)), high = finite.reduce((a, b) => Math.max(a, b));
    rows.push({ title: `observed: ${name}`, unit: "", low: low === high ? low - 1 : low, high: low === high ? high + 1 : high, series: [{ name: "", color: "--observed", values }] });
  });
  return rows.filter((row) => row.series.some((one) => one.values.some(Number.isFinite)));
}
/* The steps that the curves show: of a long trial the last seconds, unless the user wants it whole or is before them. */
const SHOWN_S = 15, LONG_S = 20;
function shownSteps(crash) {
  const last = Math.max(1, crash.steps - 1), from = end(crash) - Math.round(SHOWN_S / crash.dt);
  return view.whole || last * crash.dt <= LONG_S || view.step < from ? [0, last] : [Math.max(0, from), Math.min(last, end(crash) + Math.round(2 / crash.dt))];
}
function drawPlot() {
  const crash = view.crash, [context, width, height] = fit($("plot"));
  if (!crash) return;
  const right = width - RIGHT, [from, last] = shownSteps(crash), x = (step) => LEFT + ((right - LEFT) * (step - from)) / (last - from);
  const bottom = HEAD + crash.rows.length * ROW;
  $("whole").hidden = (crash.steps - 1) * crash.dt <= LONG_S;
  copied("plot", `${crash.id} ${from}`, context, width, height, (context) => {
    context.font = "11px system-ui";
    crash.rows.forEach((row, place) => drawRow(context, row, HEAD + place * ROW + TITLE, HEAD + (place + 1) * ROW - 4, x, right, from, last));
    context.fillStyle = css("--faint");
    context.textAlign = "center";
    const ticks = right - LEFT < 300 ? 2 : 4;
    for (let part = 0; part <= ticks; part++) context.fillText(`${(crash.time0 + (from + (part * (last - from)) / ticks) * crash.dt).toFixed(1)} s`, Math.min(right - 14, Math.max(LEFT + 14, LEFT + ((right - LEFT) * part) / ticks)), bottom + 12);
    if (crash.avoidable && crash.avoidable[0] >= from) mark(context, x(crash.avoidable[0]), "last avoidable step", "--faint", [3, 3], bottom, right);
    if (crash.nearest !== null || COLORS[crash.category] === "--crash") mark(context, x(crash.nearest ?? last), crash.nearest === null ? "crash" : "nearest", "--crash", [], bottom, right);
    /* when others erred, or the agent saw or acted late; the scene of a step is what has come of it */
    context.fillStyle = css("--fault");
    for (const [begun, to] of crash.disturbances) if (to >= from && begun <= last) context.fillRect(x(Math.max(begun, from)), bottom - 3, Math.max(2, x(Math.min(to, last)) - x(Math.max(begun, from))), 3);
  });
  drawCursor(context, x(view.step), HEAD, bottom - 4);
}

/* A vertical line through all rows, with its label above the first one. */
function mark(context, x, words, color, dashes, bottom, right) {
  context.strokeStyle = context.fillStyle = css(color);
  context.lineWidth = 1.5;
  context.setLineDash(dashes);
  context.beginPath();
  context.moveTo(x, HEAD);
  context.lineTo(x, bottom - 4);
  context.stroke();
  context.setLineDash([]);
  context.textAlign = x > right - 120 ? "right" : "left";
  const away = words === "crash" ? 0 : context.textAlign === "right" ? -44 : 0;
  context.fillText(words, x + away, HEAD - 4);
}

function drawRow(context, row, top, bottom, x, right, from, last) {
  const { low, high } = row, y = (value) => bottom - ((bottom - top) * (Math.min(high, Math.max(low, value)) - low)) / (high - low);
  context.lineWidth = 1;
  context.strokeStyle = css("--line");
  context.strokeRect(LEFT + 0.5, top + 0.5, right - LEFT, bottom - top);
  if (low < 0 && high > 0 && !row.isStep) {
    context.beginPath();
    context.moveTo(LEFT, y(0));
    context.lineTo(right, y(0));
    context.stroke();
  }
  context.fillStyle = css("--faint");
  context.textAlign = "right";
  const middle = low < 0 && high > 0 ? 0 : (low + high) / 2, ticks = [high, ...(Math.abs(y(middle) - top) > 11 && Math.abs(y(middle) - bottom) > 11 ? [middle] : []), low];
  for (const tick of ticks) context.fillText(formatNumber(tick), LEFT - 5, Math.min(bottom, Math.max(top + 8, y(tick) + 4)));
  context.textAlign = "left";
  context.fillStyle = css("--text");
  const title = `${row.title}${row.unit ? ` (${row.unit})` : ""}`, isCut = row.series.some((one) => one.values.some((value) => Number.isFinite(value) && (value > high || value < low)));
  context.fillText(title, LEFT, top - 4, right - LEFT);
  let at = LEFT + context.measureText(title).width + 14;
  const told = [...row.series.filter((one) => one.name).map((one) => [one.name, one.color, one.dash ?? []]), ...(isCut ? [["cut at the axis", "--faint", [1, 3]]] : [])];
  for (const [name, color, dash] of told) {
    context.strokeStyle = css(color);
    context.lineWidth = 1.8;
    context.setLineDash(dash);
    context.beginPath();
    context.moveTo(at, top - 8);
    context.lineTo(at + 18, top - 8);
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = css("--faint");
    context.fillText(name, at + 22, top - 4);
    at += 36 + context.measureText(name).width;
  }
  for (const { color, dash, values } of row.series) {
    context.strokeStyle = css(color);
    let down = false, wasCut = false;
    const begin = (isOut) => { context.lineWidth = isOut ? 1.2 : 1.6; context.setLineDash(isOut ? [1, 3] : dash ?? []); context.beginPath(); };
    begin(false);
    for (let step = from; step <= Math.min(last, values.length - 1); step++) {
      const value = values[step], there = Number.isFinite(value), isOut = there && (value > high || value < low);
      if (there && down && isOut !== wasCut) {
        context.lineTo(x(step), y(value));
        context.stroke();
        begin(isOut);
        context.moveTo(x(step), y(value));
      } else if (there && !down) {
        context.stroke();
        begin(isOut);
        context.moveTo(x(step), y(value));
        /* A step between two without a value, such as that of a lane change, would be no line. */
        if (!Number.isFinite(values[step + 1])) context.rect(x(step) - 1, y(value) - 1, 2, 2);
      } else if (there) {
        if (row.isStep) context.lineTo(x(step), y(values[step - 1]));
        context.lineTo(x(step), y(value));
      }
      down = there;
      wasCut = isOut;
    }
    context.stroke();
  }
  context.setLineDash([]);
}

function drawCursor(context, x, top, bottom) {
  context.strokeStyle = css("--text");
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(x, bottom);
  context.stroke();
}

/* A measured value, with one decimal as in texts and tables. */
const measured = (value, unit) => (Number.isFinite(value) ? `${value.toFixed(1).replace(/^-0\.0$/, "0.0")} ${unit}` : "-");

/* The actors to which time to collision and gap of a step belong: the collision partner, or the closest ones. */
function partners(crash, step) {
  if (crash.other) return [crash.other, crash.other];
  return crash.closest[step] ?? ["", ""];
}

/* The name of a discrete action; undefined for other actions, and where the names are not known. */
const actionWord = (crash, value) => (crash.actionNames.length === 1 ? crash.actionWords[value] : undefined);

/* What the rows of curves say at a step, and its actions: for the line below the scene and for the tip on the curves. */
function valuesAt(crash, step) {
  const [ttcWith, gapTo] = partners(crash, step), other = crash.other ? [[`speed of ${crash.other}`, measured(crash.otherSpeeds[step], "m/s")]] : [];
  const parts = [["time", `${(crash.time0 + step * crash.dt).toFixed(Math.abs(10 * crash.dt - Math.round(10 * crash.dt)) < 1e-6 ? 1 : 2)} s`], ["speed", measured(crash.speeds[step], "m/s")], ...other, ["acceleration", measured(crash.pulls[step], "m/s²")]];
  if (crash.other) parts.push([`acceleration of ${crash.other}`, measured(crash.otherPulls[step], "m/s²")]);
  parts.push([`TTC${ttcWith && ` with ${ttcWith}`}`, measured(crash.ttcs[step], "s")], [`gap${gapTo && ` to ${gapTo}`}`, measured(crash.gaps[step], "m")]);
  if (!crash.actors.length) parts.splice(1);
  if (crash.dangers) parts.push(["criticality", formatCriticality(crash.dangers[step])], ["rear criticality", formatCriticality(crash.behinds[step])]);
  crash.actionNames.forEach((name, place) => {
    const value = crash.acts[step * crash.actionNames.length + place];
    parts.push([name, actionWord(crash, value) ?? formatNumber(value)]);
  });
  crash.seen?.names.forEach((name, place) => parts.push([name, formatNumber(crash.seen.array[step * crash.seen.names.length + place])]));
  return parts;
}

function showNow() {
  const crash = view.crash, parts = [["step", `${view.step} of ${crash.steps - 1}`], ...valuesAt(crash, view.step), ...wordsAt(view.step)];
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
function draw() { if (view.crash) { drawScene(); drawPictures(); drawPlot(); showNow(); showSeen(); showPicked(); $("observed").setAttribute("aria-pressed", String(view.observed)); $("ids").setAttribute("aria-pressed", String(view.ids)); $("whole").setAttribute("aria-pressed", String(view.whole)); $("follow").setAttribute("aria-pressed", String(view.follow)); } }
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
$("fit").onclick = () => { fitEncounter(); draw(); };
$("ids").onclick = () => { view.ids = !view.ids; draw(); };
$("whole").onclick = () => { view.whole = !view.whole; draw(); };
$("observed").onclick = () => { view.observed = !view.observed; draw(); };
function pickNext() {
  const there = view.crash.actors.map(([id], actor) => [id, state(view.step, actor)]).filter(([, pose]) => pose), own = there.find(([id]) => id === view.crash.agent)?.[1] ?? [view.x, view.y];
  there.sort(([, one], [, two]) => Math.hypot(one[0] - own[0], one[1] - own[1]) - Math.hypot(two[0] - own[0], two[1] - own[1]));
  view.picked = there[(there.findIndex(([id]) => id === view.picked) + 1) % Math.max(1, there.length)]?.[0] ?? "";
  draw();
}
$("avoidable").onclick = () => { pause(); go(view.crash.avoidable[0]); };
/* A page with several crashes sets this: 1 shows the next crash, -1 the previous one. */
window.anotherCrash = () => {};
$("previous").onclick = () => window.anotherCrash(-1);
$("next").onclick = () => window.anotherCrash(1);
$("scrub").oninput = (event) => { pause(); go(Number(event.target.value)); };
$("scene").addEventListener("wheel", (event) => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15); }, { passive: false });
let drag = null, moved = 0;
$("scene").onpointerdown = (event) => { drag = [event.clientX, event.clientY]; moved = 0; $("scene").setPointerCapture(event.pointerId); };
$("scene").onpointermove = (event) => {
  if (!drag) return;
  moved += Math.abs(event.clientX - drag[0]) + Math.abs(event.clientY - drag[1]);
  if (moved < 4) return;
  view.follow = false;
  view.x -= (event.clientX - drag[0]) / view.scale;
  view.y += (event.clientY - drag[1]) / view.scale;
  drag = [event.clientX, event.clientY];
  draw();
};
$("scene").onpointercancel = () => { drag = null; };
$("scene").onpointerup = (event) => {
  if (drag && moved < 4 && view.crash) { view.picked = vehicleAt(event); draw(); }
  drag = null;
};
{
  const stepAt = (event) => {
    const box = $("plot").getBoundingClientRect(), [from, last] = shownSteps(view.crash);
    return Math.min(Math.max(from, from + Math.round(((event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT)) * (last - from))), Math.min(last, view.crash.steps - 1));
  };
  const seek = (event) => { pause(); go(stepAt(event)); };
  $("plot").onpointerdown = (event) => { seek(event); $("plot").setPointerCapture(event.pointerId); };
  $("plot").onpointermove = (event) => {
    if (event.buttons) return seek(event);
    const step = stepAt(event);
    return showTip(event.clientX, event.clientY, [`step ${step}`, ...valuesAt(view.crash, step).map(([name, value]) => `${name} ${value}`)].join("\n"));
  };
  $("plot").onpointerleave = hideTip;
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
  const actions = { " ": toggle, ArrowLeft: () => step(-count), ArrowRight: () => step(count), Home: () => step(-Infinity), End: () => step(Infinity), "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), f: $("follow").onclick, i: $("ids").onclick, v: pickNext, o: $("observed").onclick, Escape: () => { view.picked = ""; draw(); }, "[": () => window.anotherCrash(-1), "]": () => window.anotherCrash(1) };
  if (actions[event.key]) { event.preventDefault(); actions[event.key](); }
});
