/* The page of one hunt. */
import { $, PALETTE, Refused, between, copyButton, count, css, draw, drawTheRest, drawWhenNear, get, make, mayControl, now, onScheme, plural, poll, post, seconds, setText, short, stateOf, sinceNewestKind, spelled, table, tell } from "/static/common.js";

const ID = location.pathname.split("/")[2], API = `/api/hunts/${ID}`;
const NOT_DECIDED = "nobody can tell"; // the verdict of the API
const COLORS = { "traffic crash": "--crash", "traffic event": "--crash", "software fault": "--fault", "no crash": "--fine" };
let hunt = null, crashes = [], points = [], cursor = "", units = {}, road = null, shares = { share: 1, crash_share: 1 };
const byNumber = new Map(), brushes = new Map();

/* The choices are in the address, so that a reload or a link shows the same. */
const words = new URLSearchParams(location.search);
const CHOICES = { over: "0", across: "", up: "", colour: "outcome", "crash-filter": "", "crash-words": "", near: "", density: "" };
const chosen = Object.fromEntries(Object.entries(CHOICES).map(([name, usual]) => [name, words.get(name) ?? usual]));
function choose(name, value) {
  chosen[name] = value;
  const kept = new URLSearchParams(Object.entries(chosen).filter(([key, now_]) => now_ && now_ !== CHOICES[key]));
  history.replaceState(null, "", kept.size ? `?${kept}` : location.pathname);
}

/* A part of the page is made again only where what it shows is another. */
const shown = new Map();
function renew(id, data, fill) {
  const text = JSON.stringify(data);
  if (shown.get(id) === text) return;
  shown.set(id, text);
  const within = $(id).contains(document.activeElement) ? document.activeElement : null, key = within?.getAttribute("href") ?? within?.textContent;
  fill();
  if (within) [...$(id).querySelectorAll("a, button")].find((node) => (node.getAttribute("href") ?? node.textContent) === key)?.focus();
}

const noteText = (note) => [note.text, ...note.tags.map((tag) => `#${tag}`), `(${note.by}, ${note.at})`].filter((part) => part).join(" ");
const notesOn = (crash) => (hunt?.notes ?? []).filter((note) => note.crash === crash).map(noteText);
const faultOf = (one) => (one.fault === NOT_DECIDED ? "not decided" : one.fault ?? "");

function link(crash, text) { return make("a", text ?? crash, "", { href: `/hunts/${ID}/crashes/${encodeURIComponent(crash)}` }); }

function showHunt() {
  document.title = `${hunt.name} - crashhunt`;
  setText($("title"), hunt.name);
  setText($("state"), stateOf(hunt));
  $("state").className = `state ${hunt.state}`;
  const agents = Object.entries(hunt.agents).map(([id, agent]) => `${id}: ${agent}`).join(", ");
  setText($("subtitle"), [hunt.scenario && `scenario ${hunt.scenario}`, agents, hunt.sampler && `sampler ${hunt.sampler}`].filter((part) => part).join("; "));
  const problems = [hunt.detail, ...hunt.problems].filter((part) => part);
  $("detail").hidden = !problems.length;
  setText($("detail"), problems.join("\n"));
  const notices = hunt.notices ?? [];
  $("notices").hidden = !notices.length;
  renew("notices", notices, () => $("notices").replaceChildren(...notices.map((notice) => make("li", notice))));
  const notes = (hunt.notes ?? []).filter((note) => !note.crash);
  $("hunt-notes").hidden = !notes.length;
  renew("hunt-notes", notes, () => $("hunt-notes").replaceChildren(...notes.map((note) => make("li", noteText(note)))));
  $("progress").hidden = !(hunt.trials_planned >= hunt.trials_run && hunt.trials_planned) || hunt.state !== "running";
  $("progress").value = hunt.trials_planned ? hunt.trials_run / hunt.trials_planned : 0;
  const rate = hunt.rate, newest = sinceNewestKind(hunt);
  const tiles = [
    ["trials", hunt.trials_planned >= hunt.trials_run && hunt.trials_planned ? `${count(hunt.trials_run)} of ${count(hunt.trials_planned)}` : count(hunt.trials_run)],
    ["crashes", count(hunt.crashed_trials)],
    ...(hunt.kinds_count === null ? [] : [["crash types", count(hunt.kinds_count)]]),
    ...(newest === null ? [] : [["since the last new type", seconds(newest)]]),
    ["trials/s", hunt.rate_per_s ? formatNumber(hunt.rate_per_s) : "-"],
    ...(hunt.seconds_left === null ? [] : [["time left", seconds(hunt.seconds_left)]]),
    ...(rate?.certain ? [["crash rate per trial, 95 % interval", between(rate)]] : []),
    ...(rate && rate.estimate !== null && rate.estimate !== undefined ? [["crash rate per trial, estimate", formatNumber(rate.estimate)]] : []),
    ...(hunt.until_rate ? [[`bar ${hunt.until_rate.bar}`, hunt.until_rate.verdict]] : []),
  ];
  renew("tiles", tiles, () => $("tiles").replaceChildren(...tiles.map(([name, value]) => {
    const tile = make("div", undefined, "card tile");
    tile.append(make("b", value), make("span", name, "faint"));
    return tile;
  })));
  if (rate?.why_not) $("tiles").title = `No estimate: ${rate.why_not}`;
  renew("settings", hunt.settings, () => $("settings").replaceChildren(...Object.entries(hunt.settings).flatMap(([name, value]) => [make("dt", name), make("dd", value === true ? "yes" : value, "mono")])));
  renew("command", hunt.command, () => $("command").replaceChildren(...(hunt.command ? [make("span", "command"), make("code", hunt.command), copyButton(hunt.command, "repeat this hunt")] : [make("span", "No command is known.")])));
  $("workers-card").hidden = hunt.state !== "running" && !(hunt.nodes ?? []).length;
  renew("workers", hunt.workers, () => $("workers").replaceChildren(...(hunt.workers.length ? [table([["Trial", "number"], ["Step", "number"], ["Doing"], ["Since", "number"]], hunt.workers.map((one) => [count(one.trial), count(one.step), one.doing, seconds(one.since_s)]), "Running trials")] : [make("p", hunt.state === "running" ? "Between two trials." : "No trial is running.", "faint")])));
  renew("nodes", hunt.nodes, () => $("nodes").replaceChildren(...(hunt.nodes?.length ? [table([["Node"], ["Trials at a time", "number"], ["Trials", "number"], ["Trials/s", "number"]], hunt.nodes.map((one) => [one.name, one.parallel, count(one.trials), formatNumber(one.rate_per_s ?? 0)]), "Nodes")] : [])));
  const copies = [["probes", hunt.probes], ["branches", hunt.branches]].flatMap(([name, sums]) => (sums ? Object.entries(sums).map(([key, value]) => [`${name}: ${key.replaceAll("_", " ")}`, value]) : []));
  $("copies-card").hidden = !copies.length;
  renew("copies", copies, () => $("copies").replaceChildren(...copies.flatMap(([name, value]) => [make("dt", name), make("dd", value ?? "-", "mono")])));
  renew("events", hunt.events, () => $("events").replaceChildren(table([["At"], ["State"], ["Detail"]], [...hunt.events].reverse().map(([at, state, why]) => [new Date(at * 1000).toLocaleString("sv-SE"), state.replaceAll("_", " "), why]), "Events")));
  showControl();
  $("run-log-box").hidden = !hunt.run_log;
  setText($("run-log-title"), hunt.run_log_of);
  setText($("run-log"), hunt.run_log);
}

function showKinds() {
  const crashed = crashes.filter((one) => !one.near_miss);
  const kinds = hunt.kinds ?? [...Map.groupBy(crashed.filter((one) => one.type), (one) => one.type)].map(([type, members]) => ({ words: type, count: members.length, first: members[0].id, shortest: [...members].sort((a, b) => a.steps - b.steps)[0].id }));
  const faults = new Map([...Map.groupBy(crashed.filter((one) => one.type), (one) => one.type)].map(([type, members]) => [type, [...new Set(members.map((one) => faultOf(one)))].join(", ")]));
  const kept = new Set(crashes.map((one) => one.id));
  $("kinds-section").hidden = !kinds.length;
  const lines = kinds.map((kind) => [kind.words, kind.count, kind.first, kind.shortest, faults.get(kind.words) ?? ""]);
  renew("kinds", [lines, [...kept]], () => {
    const named = (crash) => (kept.has(crash) ? link(crash) : crash);
    $("kinds").replaceChildren(table([["Crash type"], ["Crashes", "number"], ["First"], ["Shortest"], ["At fault"]], lines.map(([type, number, first, shortest, fault]) => {
      const button = make("button", type);
      button.onclick = () => { choose("crash-filter", type); $("crash-filter").value = type; showCrashes(); $("crashes-section").scrollIntoView(); };
      return [button, count(number), named(first), named(shortest), fault];
    }), "Crash types"));
  });
}

function withNotes(one) {
  const cell = make("span", one.damaged || one.summary);
  cell.append(...notesOn(one.id).map((note) => make("span", note, "sub note")));
  const answers = Object.entries(one.preventable_by ?? {}).filter(([, answer]) => answer !== null);
  if (answers.length) cell.append(make("span", `preventable: ${answers.map(([model, answer]) => `${model} ${answer ? "yes" : "no"}`).join(", ")}`, "sub"));
  return cell;
}

function showCrashes() {
  $("crashes-section").hidden = !crashes.length;
  const types = [...new Set(crashes.map((one) => one.type).filter((type) => type))].sort();
  renew("crash-filter", types, () => {
    const near = crashes.some((one) => one.near_miss);
    $("crash-filter").replaceChildren(make("option", "all", "", { value: "" }), ...(near ? [make("option", "near misses", "", { value: "near misses" })] : []), ...types.map((type) => make("option", type)));
    $("crash-filter").value = chosen["crash-filter"];
  });
  const filter = $("crash-filter").value;
  const wanted = $("crash-words").value.toLowerCase().split(/\s+/);
  const isWanted = (one) => { const text = [one.id, one.summary, one.type, one.damaged, ...notesOn(one.id)].join(" ").toLowerCase(); return wanted.every((word) => text.includes(word)); };
  const lines = crashes.filter((one) => (!filter || (filter === "near misses" ? one.near_miss : one.type === filter)) && isWanted(one));
  renew("crashes", [lines, hunt?.notes], () => $("crashes").replaceChildren(table([["Crash"], ["What happened"], ["Type"], ["At fault"], ["Steps", "number"], ["Confirmed"]], lines.map((one) => [
    one.damaged && !one.summary ? one.id : link(one.id), withNotes(one), one.near_miss ? (one.disturbed ? "near miss, disturbed" : "near miss") : one.type ?? "", faultOf(one), one.steps === undefined ? "" : count(one.steps),
    one.near_miss ? "" : one.confirmed === true ? "yes" : one.confirmed === false ? "no: flaky" : one.why_unconfirmed || "not yet",
  ]), "Crashes")));
}

/* Charts */
const firstNumbers = () => (hunt.kinds ?? crashes.filter((one) => one.type && !one.near_miss).map((one) => ({ first: one.id, words: one.type }))).reduce((found, kind) => found.set(kind.words, Math.min(found.get(kind.words) ?? Infinity, Number.parseInt(kind.first, 10))), new Map());
function drawProgress() {
  $("progress-section").hidden = !hunt.parts.length;
  if (!hunt.parts.length) return;
  const bySteps = $("over").value === "1", curve = hunt.curve, at = curve.map((one) => one[bySteps ? 1 : 0]);
  const stepsAt = (number) => {
    let trials = 0;
    for (let place = 0; place < hunt.parts.length; place++) {
      const part = hunt.parts[place], inside = Object.values(part.outcomes).reduce((sum, one) => sum + one, 0);
      if (number <= part.last) return bySteps ? curve[place][1] + (part.steps * (number - part.first + 1)) / Math.max(1, part.last - part.first + 1) : Math.min(trials + number - part.first + 1, hunt.trials_run);
      trials += inside;
    }
    return at[at.length - 1];
  };
  const firsts = [...firstNumbers().values()].sort((a, b) => a - b);
  const types = { x: [0], y: [0] };
  firsts.forEach((number, place) => { types.x.push(stepsAt(number)); types.y.push(place + 1); });
  types.x.push(at[at.length - 1]);
  types.y.push(firsts.length);
  const title = bySteps ? "simulated steps" : "trials";
  const ticks = (most) => (most < 6 ? { dtick: 1 } : { tickformat: ",d", nticks: 6 });
  draw($("discovery"), [
    { x: at, y: curve.map((one) => one[2]), name: "crashes", mode: "lines", line: { color: css("--crash"), width: 2 } },
    { ...types, name: "crash types", mode: "lines", yaxis: "y2", line: { color: css("--accent"), width: 2, shape: "hv", dash: "dash" } },
  ], { xaxis: { title, rangemode: "tozero" }, yaxis: { title: "crashes", rangemode: "tozero", ...ticks(hunt.crashed_trials) }, yaxis2: { title: { text: "crash types" }, overlaying: "y", side: "right", rangemode: "tozero", showgrid: false, automargin: true, ...ticks(firsts.length) } },
  `Crashes and crash types over ${title}: ${plural(hunt.crashed_trials, "crash", "crashes")}, ${plural(firsts.length, "type", "types")}`);
  const outcomes = [...new Set(hunt.parts.flatMap((part) => Object.keys(part.outcomes)))].sort();
  const plain = ["survived", "finished", "invalid"];
  outcomes.sort((a, b) => plain.includes(b) - plain.includes(a));
  const size = Math.max(1, Math.ceil(hunt.parts.length / 30)), groups = [];
  for (let place = 0; place < hunt.parts.length; place += size) groups.push(hunt.parts.slice(place, place + size));
  const most = Math.max(...groups.map((group) => group.reduce((sum, part) => sum + Object.values(part.outcomes).reduce((all, one) => all + one, 0), 0)));
  const tones = { survived: "--fine", finished: "--done", invalid: "--line", collision: "--crash", off_road: "--ego" };
  draw($("outcomes"), outcomes.map((outcome, place) => ({
    type: "bar", name: spelled(outcome), x: groups.map((group) => group[0].first), width: groups.map((group) => group[group.length - 1].last - group[0].first + 1), offset: 0,
    y: groups.map((group) => group.reduce((sum, part) => sum + (part.outcomes[outcome] ?? 0), 0)), marker: { color: css(tones[outcome] ?? PALETTE[place % PALETTE.length]) },
  })), { barmode: "stack", bargap: 0, xaxis: { title: "trial" }, yaxis: { title: "trials", ...(most < 6 ? { dtick: 1 } : { tickformat: ",d", nticks: 6 }) } }, `Outcomes over the hunt: ${Object.entries(hunt.outcomes).map(([name, number]) => `${name} ${number}`).join(", ")}`);
}

/* The trials that charts draw as dots: all crashes, and of the others an even share. Each dot costs 0.1 ms and more of
   the browser, and more than these cover each other. The sample itself keeps more, for its figures and for a click. */
const MAX_DOTS = 1000, GOLDEN = (Math.sqrt(5) - 1) / 2;
let drawn = [];
function chooseDots() {
  const others = points.filter((one) => !one.crash);
  let share = 1;
  const isDrawn = (one) => (one.number * GOLDEN) % 1 < share;
  while (others.filter(isDrawn).length > MAX_DOTS) share /= 2;
  drawn = points.filter((one) => one.crash || isDrawn(one));
}

const about = (one) => spelled([`trial ${one.number}: ${one.outcome}`, one.danger === null ? "" : `criticality ${formatCriticality(one.danger)}`, one.disturbances ? plural(one.disturbances, "disturbance", "disturbances") : "", one.origin && `from ${one.origin}`, ...Object.entries(one.values).map(([name, value]) => `${name} ${short(value)}${units[name] ? ` ${units[name]}` : ""}`)].filter((part) => part).join("\n")).replaceAll("\n", "<br>");
function drawTrials() {
  chooseDots();
  const measured = drawn.filter((one) => one.danger !== null || one.crash), origins = [...new Set(points.map((one) => one.origin))].sort();
  $("criticality-figure").hidden = !measured.length;
  if (measured.length) {
    const traces = origins.map((origin, place) => {
      const own = measured.filter((one) => one.origin === origin && !one.crash);
      return { type: "scatter", mode: "markers", name: spelled(origin || "trials"), x: own.map((one) => one.number), y: own.map((one) => one.danger), customdata: own.map((one) => one.number), text: own.map(about), hovertemplate: "%{text}<extra></extra>", marker: { color: css(origin ? PALETTE[place % PALETTE.length] : "--fine"), size: 5, opacity: 0.6 } };
    });
    const crashed = measured.filter((one) => one.crash);
    traces.push({ type: "scatter", mode: "markers", name: "crash", x: crashed.map((one) => one.number), y: crashed.map(() => 1.05), customdata: crashed.map((one) => one.number), text: crashed.map(about), hovertemplate: "%{text}<extra></extra>", marker: { color: css("--crash"), size: 7, symbol: "x-thin", line: { color: css("--crash"), width: 1.5 } } });
    draw($("criticality"), traces, { xaxis: { title: "trial" }, yaxis: { title: "criticality", range: [-0.03, 1.1] } }, `Criticality of ${plural(measured.length, "trial", "trials")} over their numbers`, pickOf);
  }
  $("origins-figure").hidden = origins.length < 2;
  if (origins.length > 1) {
    const plain = points.filter((one) => !one.crash || shares.share === 1), last = Math.max(1, ...points.map((one) => one.number)), bins = 24;
    const counts = origins.map(() => new Array(bins).fill(0));
    for (const one of plain) counts[origins.indexOf(one.origin)][Math.min(bins - 1, Math.floor((bins * one.number) / (last + 1)))]++;
    const sums = counts[0].map((_, bin) => counts.reduce((sum, own) => sum + own[bin], 0));
    draw($("origins"), origins.map((origin, place) => ({ type: "scatter", mode: "lines", stackgroup: "one", name: spelled(origin || "none"), x: counts[place].map((_, bin) => ((bin + 0.5) * last) / bins), y: counts[place].map((number, bin) => (sums[bin] ? (100 * number) / sums[bin] : 0)), line: { color: css(PALETTE[place % PALETTE.length]), width: 0.5 } })), { xaxis: { title: "trial" }, yaxis: { title: "share in %", range: [0, 100] } }, "Share of the trials that each strategy proposed");
  }
  const some = drawn.length < hunt.trials_run ? `The dots are ${count(drawn.length)} of ${count(hunt.trials_run)} trials: ${shares.crash_share < 1 ? "an even share of the crashes and of the others" : "all crashes, and an even share of the others"}.` : "";
  setText($("thinned"), some);
}

const varying = () => hunt.columns.filter((name) => new Set(points.map((one) => String(one.values[name]))).size > 1);
function drawArguments() {
  const names = points.length ? varying() : [];
  $("arguments-section").hidden = !points.length;
  if (!points.length) return;
  for (const [id, place] of [["across", 0], ["up", 1]]) {
    const known = [...names, "criticality", "trial"];
    renew(id, known, () => {
      $(id).replaceChildren(...known.map((name) => make("option", units[name] ? `${name} (${units[name]})` : name, "", { value: name })));
      $(id).value = known.includes(chosen[id]) ? chosen[id] : known[Math.min(place, known.length - 1)];
    });
  }
  const valueOf = (one, name) => (name === "criticality" ? (one.crash ? 1 : one.danger) : name === "trial" ? one.number : one.values[name]);
  const [across, up] = [$("across").value, $("up").value], byDanger = $("colour").value === "danger";
  const titled = (name) => spelled(units[name] ? `${name} (${units[name]})` : name);
  const axis = (name) => ({ title: titled(name), ...(points.every((one) => typeof valueOf(one, name) === "number" || valueOf(one, name) === null) ? {} : { type: "category" }) });
  const trace = (own, more) => ({ type: "scatter", mode: "markers", x: own.map((one) => valueOf(one, across)), y: own.map((one) => valueOf(one, up)), customdata: own.map((one) => one.number), text: own.map(about), hovertemplate: "%{text}<extra></extra>", ...more });
  const traces = byDanger
    ? [trace(drawn, { name: "criticality", showlegend: false, marker: { size: 6, color: drawn.map((one) => (one.crash ? 1 : one.danger ?? 0)), cmin: 0, cmax: 1, colorscale: "Cividis", colorbar: { title: { text: "criticality" }, thickness: 12 } } })]
    : Object.keys(COLORS).reverse().map((category) => [category, drawn.filter((one) => one.category === category)]).filter(([, own]) => own.length).map(([category, own]) => trace(own, { name: category, marker: { color: css(COLORS[category]), size: category === "no crash" ? 5 : 8, opacity: category === "no crash" ? 0.55 : 0.95, symbol: category === "no crash" ? "circle" : category === "software fault" ? "diamond" : "x" } }));
  draw($("scatter"), traces, { xaxis: axis(across), yaxis: axis(up) }, `${plural(drawn.length, "trial", "trials")} by ${across} and ${up}, coloured by ${byDanger ? "criticality" : "outcome"}`, pickOf);
  drawWhenNear($("parallel"), () => drawParallel(names));
}

/* Parallel coordinates on a canvas: those of plotly need WebGL and a script made from text, which the page forbids. */
const parallel = { names: [], axes: new Map(), drag: null };
function drawParallel(names) {
  $("parallel-figure").hidden = names.length < 2;
  if (names.length < 2) return;
  const canvas = $("parallel"), ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d"), bottom = height - 22, left = 34, right = width - 34, apart = (right - left) / (names.length - 1);
  context.scale(ratio, ratio);
  context.font = "12px system-ui";
  /* Names that are too long for one row are written in two rows in turns. */
  const rows = names.every((name) => context.measureText(name).width < apart - 6) ? 1 : 2, top = 20 + 14 * rows;
  parallel.names = names;
  parallel.axes = new Map(names.map((name, place) => {
    const values = points.map((one) => one.values[name]).filter((value) => value !== undefined), numeric = values.every((value) => typeof value === "number");
    const known = numeric ? [] : [...new Set(values.map(String))].sort();
    const low = numeric ? values.reduce((a, b) => Math.min(a, b)) : 0, high = numeric ? values.reduce((a, b) => Math.max(a, b)) : known.length - 1;
    const number = (value) => (value === undefined ? null : numeric ? value : known.indexOf(String(value)));
    return [name, { x: left + ((right - left) * place) / (names.length - 1), low, high, numeric, known, number, y: (value) => bottom - ((bottom - top) * (value - low)) / (high - low || 1), value: (y) => low + ((high - low) * (bottom - y)) / (bottom - top) }];
  }));
  const kept = (one) => [...brushes].every(([name, [from, to]]) => {
    const axis = parallel.axes.get(name), value = axis?.number(one.values[name]);
    return axis === undefined || (value !== null && value >= from && value <= to);
  });
  const inside = points.filter(kept), faint = css("--line");
  const stroke = (own, color, alpha, thick) => {
    context.strokeStyle = color;
    context.globalAlpha = alpha;
    context.lineWidth = thick;
    for (const one of own) {
      context.beginPath();
      let down = false;
      for (const axis of parallel.axes.values()) {
        const index = [...parallel.axes.values()].indexOf(axis), value = axis.number(one.values[names[index]]);
        if (value === null) { down = false; continue; }
        context[down ? "lineTo" : "moveTo"](axis.x, axis.y(value));
        down = true;
      }
      context.stroke();
    }
  };
  const every = Math.max(1, Math.ceil(inside.length / 1500)), calm = inside.filter((one) => !one.crash);
  if (brushes.size) stroke(points.filter((one) => !kept(one)).slice(0, 400), faint, 0.6, 1);
  stroke(calm.filter((_, place) => place % every === 0), css("--fine"), calm.length > 300 ? 0.25 : 0.5, 1);
  stroke(inside.filter((one) => one.crash), css("--crash"), 0.8, 1.3);
  context.globalAlpha = 1;
  for (const [name, axis] of parallel.axes) {
    context.strokeStyle = css("--faint");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(axis.x, top);
    context.lineTo(axis.x, bottom);
    context.stroke();
    context.fillStyle = css("--text");
    context.textAlign = axis.x < left + 20 ? "left" : axis.x > right - 20 ? "right" : "center";
    const at = context.textAlign === "left" ? 4 : context.textAlign === "right" ? width - 4 : axis.x;
    const place = names.indexOf(name);
    context.fillText(name, at, 12 + 14 * (place % rows), rows * apart - 6);
    context.fillStyle = css("--faint");
    context.fillText(axis.numeric ? short(axis.high) : axis.known[axis.known.length - 1], at, top - 6);
    context.fillText(axis.numeric ? short(axis.low) : axis.known[0], at, height - 6);
    if (brushes.has(name)) {
      const [from, to] = brushes.get(name);
      context.fillStyle = css("--accent");
      context.globalAlpha = 0.35;
      context.fillRect(axis.x - 6, axis.y(to), 12, Math.max(3, axis.y(from) - axis.y(to)));
      context.globalAlpha = 1;
    }
  }
  const crashed = inside.filter((one) => one.crash).length;
  setText($("brushed"), brushes.size ? `${plural(inside.length, "trial", "trials")} in these ranges, ${count(crashed)} crashed. Click an axis to remove its range.` : "Drag along an axis to keep the trials in a range, or set the ranges below.");
  renew("ranges", names.map((name) => [name, parallel.axes.get(name).low, parallel.axes.get(name).high, brushes.get(name) ?? null]), () => {
    if ($("ranges").contains(document.activeElement)) return shown.delete("ranges");
    $("ranges").replaceChildren(...names.filter((name) => parallel.axes.get(name).numeric).map((name) => {
      const axis = parallel.axes.get(name), box = make("fieldset"), given = brushes.get(name) ?? [axis.low, axis.high];
      box.append(make("legend", name));
      const inputs = ["from", "to"].map((side, place) => {
        const label = make("label", `${side} `), input = make("input", undefined, "", { type: "number", step: "any" });
        input.value = Number(given[place].toPrecision(6));
        input.onchange = () => {
          const [from, to] = inputs.map((one) => Number(one.value));
          if (from <= axis.low && to >= axis.high) brushes.delete(name); else brushes.set(name, [from, to]);
          drawParallel(parallel.names);
        };
        label.append(input);
        box.append(label);
        return input;
      });
      return box;
    }));
    return undefined;
  });
}
{
  const canvas = $("parallel"), at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.onpointerdown = (event) => {
    const [x, y] = at(event), near = [...parallel.axes].sort((a, b) => Math.abs(a[1].x - x) - Math.abs(b[1].x - x))[0];
    if (!near || Math.abs(near[1].x - x) > 40) return;
    parallel.drag = { name: near[0], axis: near[1], from: y };
    brushes.delete(near[0]);
    canvas.setPointerCapture(event.pointerId);
  };
  canvas.onpointermove = (event) => {
    if (!parallel.drag) return;
    const { name, axis, from } = parallel.drag, y = at(event)[1];
    if (Math.abs(y - from) > 3) brushes.set(name, [axis.value(y), axis.value(from)].sort((a, b) => a - b));
    drawParallel(parallel.names);
  };
  canvas.onpointerup = canvas.onpointercancel = () => { parallel.drag = null; drawParallel(parallel.names); };
}

/* A trial that was chosen: its crash, or how to run its arguments again. */
function pick(number) {
  const crash = crashes.find((one) => one.trial === number && !one.near_miss) ?? crashes.find((one) => one.trial === number);
  if (crash) { location.href = link(crash.id).href; return; }
  const one = byNumber.get(number), panel = $("picked");
  panel.hidden = false;
  if (!one) { panel.replaceChildren(make("p", `Trial ${number} is not in the plots. Run: crashhunt trials ${quoted(hunt.path)}`)); return; }
  const asked = { maxSteps: hunt.max_steps, scenario: hunt.scenario, agents: hunt.agents, scenarioArguments: hunt.scenario_columns, disturb: hunt.settings.disturbances };
  const command = commandAgain(asked, one.values), box = make("div", undefined, "command");
  box.append(make("span", "run its arguments again, with other seeds"), make("code", command), copyButton(command, `the arguments of trial ${number}`));
  const facts = make("dl");
  facts.append(...[["outcome", one.outcome], ["steps", one.steps], ["criticality", formatCriticality(one.danger)], ["disturbances", one.disturbances], ["least time to collision with any actor", one.ttc === null ? "-" : `${one.ttc.toFixed(1)} s`], ["came from", [one.origin, one.parent === null ? "" : `trial ${one.parent}`].filter((part) => part).join(", ") || "-"], ...Object.entries(one.values).map(([name, value]) => [name, `${short(value)}${units[name] ? ` ${units[name]}` : ""}`])].flatMap(([name, value]) => [make("dt", name), make("dd", value, "mono")]));
  panel.replaceChildren(make("h3", `Trial ${number}`), facts, box);
  panel.scrollIntoView({ block: "nearest" });
}

function pickOf([one]) { if (one?.customdata !== undefined) pick(one.customdata); }

/* Where the crashes were */
/* The density of crashes on a grid around them: each adds a bell of a fiftieth of their extent, from 4 m to 25 m. */
function densityOf(crashed) {
  const around = (values, margin) => [values.reduce((a, b) => Math.min(a, b)) - margin, values.reduce((a, b) => Math.max(a, b)) + margin];
  const xs = crashed.map((one) => one.x), ys = crashed.map((one) => one.y), [w, e] = around(xs, 0), [s, n] = around(ys, 0);
  const bell = Math.min(25, Math.max(4, Math.max(e - w, n - s) / 50)), [west, east] = around(xs, 3 * bell), [south, north] = around(ys, 3 * bell);
  const cell = Math.max(bell / 3, Math.max(east - west, north - south) / 400), reach = Math.ceil((3 * bell) / cell);
  const places = (from, to) => Array.from({ length: Math.ceil((to - from) / cell) + 1 }, (_, place) => from + place * cell);
  const x = places(west, east), y = places(south, north), z = y.map(() => new Array(x.length).fill(0));
  for (const one of crashed) {
    const column = Math.round((one.x - west) / cell), row = Math.round((one.y - south) / cell);
    for (let j = Math.max(0, row - reach); j <= Math.min(y.length - 1, row + reach); j++) {
      for (let i = Math.max(0, column - reach); i <= Math.min(x.length - 1, column + reach); i++) z[j][i] += Math.exp(-((x[i] - one.x) ** 2 + (y[j] - one.y) ** 2) / (2 * bell ** 2));
    }
  }
  return { x, y, z };
}
function drawMap() {
  $("where-section").hidden = !road || !road.points.length;
  if ($("where-section").hidden) return;
  const areas = (outlines, more) => {
    const x = [], y = [];
    for (const outline of outlines) {
      for (let place = 0; place < outline.length; place += 2) { x.push(outline[place]); y.push(outline[place + 1]); }
      x.push(outline[0], null);
      y.push(outline[1], null);
    }
    return { type: "scatter", mode: "lines", x, y, fill: "toself", hoverinfo: "skip", showlegend: false, ...more };
  };
  const crashed = road.points.filter((one) => !one.near_miss), near = road.points.filter((one) => one.near_miss), types = [...new Set(crashed.map((one) => one.type ?? one.outcome))].sort();
  $("near-box").hidden = !near.length;
  /* Plotly cuts a legend that is wider than the chart. */
  const wrapped = (text) => ($("map").clientWidth < 600 ? text.replace(/(.{20,34})\s/g, "$1<br>") : text);
  /* Plotly draws a density below the roads, so they are translucent then. */
  const isDense = $("density").checked && crashed.length > 1;
  const traces = [areas(road.obstacles, { fillcolor: css("--building"), line: { width: 0 } }), areas(road.lanes, { fillcolor: css("--road") + (isDense ? "55" : ""), line: { color: css("--mark"), width: 1 } })];
  if (isDense) traces.push({ type: "heatmap", ...densityOf(crashed), colorscale: [[0, "rgba(0,0,0,0)"], [1, css("--crash")]], opacity: 0.7, showscale: false, hoverinfo: "skip", zsmooth: "best" });
  /* One dot for each place and type, with its number of crashes. */
  const places = (own) => [...Map.groupBy(own, (one) => `${Math.round(one.x)} ${Math.round(one.y)}`).values()];
  const dots = (own, more) => ({ type: "scatter", mode: "markers", x: own.map((one) => one.x), y: own.map((one) => one.y), customdata: own.map((one) => one.id), text: own.map((one) => spelled(`${one.id}: ${one.type ?? one.outcome}`)), hovertemplate: "%{text}<extra></extra>", ...more });
  types.forEach((type, place) => {
    const groups = places(crashed.filter((one) => (one.type ?? one.outcome) === type));
    const words = (group) => spelled(group.length === 1 ? `${group[0].id}: ${type}` : `${group.length} crashes: ${type}; first ${group[0].id}`);
    traces.push(dots(groups.map((group) => group[0]), { mode: "markers+text", text: groups.map((group) => (group.length > 1 ? String(group.length) : "")), textposition: "top center", hovertext: groups.map(words), hovertemplate: "%{hovertext}<extra></extra>", name: wrapped(spelled(type)), marker: { color: place ? css(PALETTE[place % PALETTE.length]) : css("--crash"), size: groups.map((group) => Math.min(24, 8 + 3 * Math.sqrt(group.length))), symbol: ["circle", "square", "diamond", "triangle-up", "cross"][place % 5], line: { color: css("--card"), width: 1 } } }));
  });
  if ($("near").checked && near.length) traces.push(dots(near, { name: "near misses", marker: { color: css("--faint"), size: 8, symbol: "circle-open" } }));
  /* The chart begins with the crashes, not with all roads of the map. */
  const span = (values) => { const low = Math.min(...values), high = Math.max(...values), half = Math.max(40, 0.6 * (high - low)); return [(low + high) / 2 - half, (low + high) / 2 + half]; };
  const [across, up] = [span(road.points.map((one) => one.x)), span(road.points.map((one) => one.y))];
  draw($("map"), traces, { xaxis: { title: "x in m", range: across, showgrid: false, zeroline: false }, yaxis: { title: "y in m", range: up, scaleanchor: "x", showgrid: false, zeroline: false }, dragmode: "pan" }, `Map of ${plural(crashed.length, "crash", "crashes")}`, (clicked) => {
    const crash = clicked.find((one) => one.customdata)?.customdata;
    if (crash) location.href = link(crash).href;
  });
}
function zoomMap(factor) {
  const { xaxis, yaxis } = $("map")._fullLayout, scaled = (range) => { const middle = (range[0] + range[1]) / 2; return range.map((end) => middle + (end - middle) * factor); };
  Plotly.relayout($("map"), factor ? { "xaxis.range": scaled(xaxis.range), "yaxis.range": scaled(yaxis.range) } : { "xaxis.autorange": true, "yaxis.autorange": true });
}
$("zoom-in").onclick = () => zoomMap(0.6);
$("zoom-out").onclick = () => zoomMap(1 / 0.6);
$("zoom-all").onclick = () => zoomMap(0);

/* With --allow-control: a second click stops the hunt, as Ctrl-C does. */
let controls = false;
mayControl().then((allowed) => { controls = allowed; if (hunt) showControl(); }).catch(() => {});
function showControl() { $("control").hidden = !(controls && hunt.state === "running"); }
$("stop").onclick = async () => {
  if ($("stop").dataset.asked !== "true") {
    $("stop").dataset.asked = "true";
    $("stop").textContent = "Click again to stop the hunt";
    return;
  }
  $("stop").dataset.asked = "false";
  $("stop").textContent = "Stop the hunt";
  try {
    await post(`${API}/stop`);
    setText($("stopped"), "The hunt is ending. Its command resumes it.");
  } catch (error) { setText($("stopped"), error.message); }
};

/* Live */
const loaded = window.Plotly ? Promise.resolve() : new Promise((resolve) => { document.querySelector('script[src^="/static/plotly.js"]').addEventListener("load", resolve); });
function drawAll() {
  if (!hunt || !window.Plotly) return;
  drawProgress();
  drawTrials();
  drawArguments();
  drawMap();
}
async function showWeights() {
  const found = await get(`${API}/importance`);
  if (!found) return;
  if (JSON.stringify(units) !== JSON.stringify(found.units)) {
    units = found.units;
    drawArguments();
  }
  $("weights-figure").hidden = !found.importance.length;
  $("weights").replaceChildren(...window.importanceBars(found.importance));
}
let trialsSeen = -1, crashesSeen = "", mapSeen = "";
const getTrials = () => get(`${API}/trials?since=${cursor}`, { always: true }), getCrashes = () => get(`${API}/crashes`);
async function refresh() {
  /* The first time all are asked for at once, as none needs the answer of another. An error is told where it is awaited.
     These answers may be older than that of the hunt, so that the next turn asks for what is new in them. */
  const [trialsAsked, crashesAsked] = trialsSeen < 0 ? [getTrials(), getCrashes()] : [];
  for (const one of [trialsAsked, crashesAsked]) one?.catch(() => {});
  let data;
  try { data = await get(API); } catch (error) {
    if (error instanceof Refused && error.status === 404) { setText($("state"), "gone"); $("state").className = "state error"; }
    throw error;
  }
  if (data) {
    hunt = data;
    showHunt();
    showKinds();
    showCrashes();
  }
  if (!hunt) return;
  let changed = Boolean(data);
  if (hunt.trials_run !== trialsSeen || hunt.damaged) {
    const found = await (trialsAsked ?? getTrials());
    if (found.replace) { points = []; byNumber.clear(); }
    points.push(...found.points);
    for (const one of found.points) byNumber.set(one.number, one);
    cursor = found.cursor;
    shares = found;
    trialsSeen = trialsAsked ? 0 : hunt.trials_run;
    changed ||= found.replace || found.points.length > 0;
  }
  const key = `${hunt.crashes} ${hunt.state} ${hunt.trials_run}`;
  if (key !== crashesSeen) {
    const found = await (crashesAsked ?? getCrashes());
    if (found) {
      crashes = found.crashes;
      setText($("pending"), found.pending ? `${plural(found.pending, "crash is", "crashes are")} still being analysed` : found.pending_near_misses ? `${plural(found.pending_near_misses, "near miss is", "near misses are")} still being analysed` : "");
      if (!found.pending && !found.pending_near_misses && !crashesAsked) crashesSeen = key;
      showCrashes();
      showKinds();
      changed = true;
    } else crashesSeen = key;
    const saved = crashes.map((one) => `${one.id} ${one.type} ${one.x}`).join();
    if (saved && saved !== mapSeen) {
      road = (await get(`${API}/map`)) ?? road;
      mapSeen = saved;
    }
  }
  if (changed) {
    await loaded;
    drawAll();
  }
  if (document.body.dataset.complete !== "true" || changed) drawTheRest();
  document.body.dataset.complete = "true";
}
let weighedAt = 0;
async function turn() {
  await refresh();
  /* Reads nothing but the sample; often enough for a figure that changes slowly. */
  if (hunt && points.length >= 40 && now() - weighedAt > (weighedAt ? 30 : 0)) {
    weighedAt = now();
    await showWeights();
  }
}
for (const id of ["over", "across", "up", "colour", "crash-filter"]) {
  if (CHOICES[id]) $(id).value = chosen[id];
  $(id).onchange = () => { choose(id, $(id).value); if (id === "crash-filter") showCrashes(); else drawAll(); };
}
for (const id of ["density", "near"]) {
  $(id).checked = chosen[id] === "1";
  $(id).onchange = () => { choose(id, $(id).checked ? "1" : ""); drawMap(); };
}
$("crash-words").value = chosen["crash-words"];
$("crash-words").oninput = () => { choose("crash-words", $("crash-words").value); showCrashes(); };
$("pick").onsubmit = (event) => { event.preventDefault(); pick(Number($("trial-number").value)); };
window.addEventListener("resize", () => { if (hunt && points.length) drawParallel(parallel.names); });
onScheme(drawAll);
poll(turn, 2000);
