/* The page of all hunts. */
import { $, ago, between, count, get, make, now, plural, poll, seconds, setText, sinceNewestKind, sparkline, stateOf } from "/static/common.js";

const COLUMNS = [
  { key: "name", label: "Hunt", text: (row) => row.name },
  { key: "state", label: "State", text: stateOf },
  { key: "scenario", label: "Scenario", text: (row) => row.scenario },
  { key: "trials", label: "Trials", number: true, value: (row) => row.trials_run },
  { key: "speed", label: "Trials/s", number: true, value: (row) => row.rate_per_s },
  { key: "left", label: "Time left", number: true, value: (row) => row.seconds_left ?? -1 },
  { key: "crashes", label: "Crashes", number: true, value: (row) => row.crashed_trials },
  { key: "types", label: "Types", number: true, value: (row) => row.kinds_count ?? -1 },
  { key: "rate", label: "Crash rate per trial", number: true, value: (row) => row.rate?.certain?.high ?? -1 },
  { key: "newest", label: "Since last new type", number: true, value: (row) => -(sinceNewestKind(row) ?? Infinity) },
  { key: "curve", label: "Discovery" },
  { key: "active", label: "Last active", number: true, value: (row) => row.active_at },
];
const rows = new Map(), nodes = new Map(), selected = new Set();
let revision = "";

const query = new URLSearchParams(location.search);
const choice = { text: query.get("q") ?? "", state: query.get("state") ?? "", sort: query.get("sort") ?? "active", down: query.get("order") !== "up", grouped: query.get("group") === "suite" };
$("filter").value = choice.text;
$("state").value = choice.state;
$("grouped").checked = choice.grouped;

function remember() {
  const words = new URLSearchParams();
  if (choice.text) words.set("q", choice.text);
  if (choice.state) words.set("state", choice.state);
  if (choice.sort !== "active") words.set("sort", choice.sort);
  if (!choice.down) words.set("order", "up");
  if (choice.grouped) words.set("group", "suite");
  history.replaceState(null, "", words.size ? `?${words}` : location.pathname);
}


/* The table is made once; a row that changes keeps its node, and the focus in it. */
const table = make("table"), head = make("thead"), body = make("tbody");
table.append(make("caption", "Hunts", "sr"), head, body);
$("table").append(table);
{
  const line = make("tr");
  line.append(make("th", "", "", {}));
  line.firstChild.append(make("span", "Select", "sr"));
  for (const column of COLUMNS) {
    const cell = make("th", undefined, column.number ? "number" : "", { scope: "col" });
    if (column.key === "curve") cell.textContent = column.label;
    else {
      const button = make("button", column.label);
      button.onclick = () => {
        choice.down = choice.sort === column.key ? !choice.down : Boolean(column.number);
        choice.sort = column.key;
        remember();
        arrange();
      };
      cell.append(button);
      column.cell = cell;
    }
    line.append(cell);
  }
  head.append(line);
}

function nodeOf(row) {
  if (nodes.has(row.id)) return nodes.get(row.id);
  const line = make("tr"), cells = {};
  const box = make("input", undefined, "", { type: "checkbox" });
  box.checked = selected.has(row.id);
  box.onchange = () => {
    if (box.checked) selected.add(row.id); else selected.delete(row.id);
    $("compare").disabled = selected.size < 2;
  };
  const first = make("td", undefined, "", { "data-label": "Select" });
  first.append(box);
  line.append(first);
  for (const column of COLUMNS) {
    cells[column.key] = make("td", undefined, column.number ? "number" : "", { "data-label": column.label });
    line.append(cells[column.key]);
  }
  const link = make("a", undefined, "", { href: `/hunts/${row.id}` });
  const sub = make("span", "", "sub");
  cells.name.append(link, sub);
  const state = make("span"), why = make("span", "", "sub");
  cells.state.append(state, why);
  const entry = { line, cells, link, sub, state, why, box, curve: "" };
  nodes.set(row.id, entry);
  return entry;
}

function fill(row) {
  const node = nodeOf(row), { cells } = node;
  setText(node.link, row.name);
  const agents = Object.entries(row.agents), several = agents.length > 1;
  const spelled = (shorten) => agents.map(([id, agent]) => (several ? `${id}: ` : "") + (shorten ? agent.split(":").pop() : agent)).join(", ");
  const tags = [...new Set((row.notes ?? []).flatMap((note) => note.tags))].map((tag) => `#${tag}`);
  setText(node.sub, [spelled(true), ...tags].join(" "));
  node.sub.title = [spelled(false), ...(row.notes ?? []).map((note) => note.text)].filter((part) => part).join("\n");
  node.box.setAttribute("aria-label", `Select ${row.name} to compare`);
  setText(node.state, stateOf(row).split(",")[0]); // a column has the number of crashes
  node.state.className = `state ${row.state}`;
  setText(node.why, row.damaged || row.state === "error" || row.state === "killed" ? row.detail : "");
  setText(cells.scenario, row.scenario);
  setText(cells.trials, row.trials_planned >= row.trials_run && row.trials_planned ? `${count(row.trials_run)} of ${count(row.trials_planned)}` : count(row.trials_run));
  setText(cells.speed, row.rate_per_s ? formatNumber(row.rate_per_s) : "-");
  setText(cells.left, seconds(row.seconds_left));
  setText(cells.crashes, count(row.crashed_trials));
  setText(cells.types, row.kinds_count === null ? "-" : count(row.kinds_count));
  const rate = row.rate;
  setText(cells.rate, rate?.certain ? between(rate) : "-");
  cells.rate.title = rate?.why_not ?? "";
  const drawn = JSON.stringify([row.curve, row.kind_firsts]);
  if (drawn !== node.curve) {
    node.curve = drawn;
    cells.curve.replaceChildren(...(row.curve.length > 1 ? [sparkline(row.curve, row.kind_firsts)] : []));
  }
}

function fillTimes() {
  for (const row of rows.values()) {
    const { cells } = nodeOf(row), age = sinceNewestKind(row);
    setText(cells.newest, seconds(age));
    setText(cells.active, row.active_at ? ago(now() - row.active_at) : "-");
  }
}

/* A table with a column of dashes would be too wide for some screens. */
function hideTimesLeft() {
  const column = COLUMNS.find((one) => one.key === "left"), isHidden = ![...rows.values()].some((row) => row.seconds_left !== null);
  for (const cell of [column.cell, ...[...nodes.values()].map((node) => node.cells.left)]) cell.hidden = isHidden;
}

function wanted(row) {
  if (choice.state && row.state !== choice.state) return false;
  const text = [row.name, row.scenario, ...Object.values(row.agents), row.detail, ...(row.notes ?? []).flatMap((note) => [note.text, note.crash, ...note.tags])].join(" ").toLowerCase();
  return choice.text.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

function arrange() {
  const column = COLUMNS.find((one) => one.key === choice.sort && one.key !== "curve") ?? COLUMNS[COLUMNS.length - 1];
  const sign = choice.down ? -1 : 1;
  for (const one of COLUMNS) one.cell?.setAttribute("aria-sort", one === column ? (choice.down ? "descending" : "ascending") : "none");
  const compare = (a, b) => {
    const [x, y] = column.value ? [column.value(a), column.value(b)] : [column.text(a), column.text(b)];
    const order = typeof x === "number" ? x - y : x.localeCompare(y, "en", { numeric: true });
    return sign * order || a.name.localeCompare(b.name, "en", { numeric: true });
  };
  const shown = [...rows.values()].filter(wanted).sort(compare);
  const lines = [];
  if (choice.grouped) {
    const groups = new Map();
    for (const row of shown) groups.set(row.suite, [...(groups.get(row.suite) ?? []), row]);
    for (const [suite, members] of groups) {
      const line = make("tr", undefined, "group"), cell = make("th", `${suite || "without a suite"} (${plural(members.length, "hunt", "hunts")})`, "", { colspan: COLUMNS.length + 1, scope: "rowgroup" });
      line.append(cell);
      lines.push(line, ...members.map((row) => nodeOf(row).line));
    }
  } else lines.push(...shown.map((row) => nodeOf(row).line));
  const there = [...body.children];
  if (lines.length !== there.length || lines.some((line, place) => line !== there[place])) {
    const focused = document.activeElement;
    body.replaceChildren(...lines);
    if (focused && body.contains(focused)) focused.focus();
  }
  setText($("shown"), shown.length === rows.size ? plural(rows.size, "hunt", "hunts") : `${count(shown.length)} of ${plural(rows.size, "hunt", "hunts")}`);
}

function fillTotals() {
  const all = [...rows.values()], sum = (name) => all.reduce((total, row) => total + (row[name] || 0), 0);
  const running = all.filter((row) => row.state === "running");
  const counted = all.every((row) => row.kinds_count !== null || !row.crashed_trials); // not in hunts that end at a crash
  const tiles = [["running", count(running.length)], ["hunts", count(all.length)], ["trials", count(sum("trials_run"))], ["trials/s", formatNumber(running.reduce((total, row) => total + row.rate_per_s, 0))], ["crashes", count(sum("crashed_trials"))], ["crash types", counted ? count(sum("kinds_count")) : "-"]];
  const there = $("tiles").children;
  tiles.forEach(([name, value], place) => {
    if (!there[place]) {
      const tile = make("div", undefined, "card tile");
      tile.append(make("b"), make("span", name, "faint"));
      $("tiles").append(tile);
    }
    setText(there[place].firstChild, value);
  });
}

async function refresh() {
  const data = await get(`/api/hunts?since=${revision}`);
  if (data) {
    revision = data.revision;
    for (const row of data.hunts) {
      rows.set(row.id, row);
      fill(row);
    }
    const there = new Set(data.ids);
    for (const id of [...rows.keys()]) if (!there.has(id)) { rows.delete(id); nodes.delete(id); selected.delete(id); }
    setText($("roots"), data.roots.join(", "));
    setText($("places"), data.roots.join(", "));
    $("begin").hidden = rows.size > 0;
    $("hunts").hidden = rows.size === 0;
    hideTimesLeft();
    fillTotals();
    arrange();
  }
  fillTimes();
}

$("filter").oninput = () => { choice.text = $("filter").value; remember(); arrange(); };
$("state").onchange = () => { choice.state = $("state").value; remember(); arrange(); };
$("grouped").onchange = () => { choice.grouped = $("grouped").checked; remember(); arrange(); };
$("compare").onclick = () => { location.href = `/compare?hunts=${[...selected].join(",")}`; };
poll(refresh, 2000);
