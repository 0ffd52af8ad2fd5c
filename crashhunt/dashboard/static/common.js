/* What the pages of the dashboard share: requests, formats, charts. Texts of hunts only ever become text nodes. */
export const $ = (id) => document.getElementById(id);
export function make(tag, text, className, attributes = {}) {
  const node = document.createElement(tag);
  if (text !== undefined && text !== null) node.textContent = text;
  if (className) node.className = className;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}
export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/* Requests. An answer that has not changed costs no body. */
const TAGS = new Map();
let ahead = 0;
/* The time of the server, in s: the clock of another machine may differ. */
export const now = () => Date.now() / 1000 - ahead;
/* The time since the last new crash type in s, which stands still after the last trial; null if it is unknown. */
export const sinceNewestKind = (row) => (row.newest_kind_at === null ? null : row.state === "running" && !row.phase ? Math.max(0, now() - row.newest_kind_at) : row.newest_kind_s);
export class Refused extends Error {
  constructor(status, error) {
    super([error.message, error.fix].filter((part) => part).join("; "));
    this.status = status;
  }
}
export async function get(path, { always = false } = {}) {
  const headers = !always && TAGS.has(path) ? { "If-None-Match": TAGS.get(path) } : {};
  const answer = await fetch(path, { headers, cache: "no-store", credentials: "same-origin" });
  const served = Number(answer.headers.get("X-Crashhunt-Now"));
  if (served) ahead = Date.now() / 1000 - served;
  if (answer.status === 304) return null;
  const data = await answer.json().catch(() => ({ error: { message: `the server answered ${answer.status}`, fix: "" } }));
  if (!answer.ok) throw new Refused(answer.status, data.error);
  TAGS.set(path, answer.headers.get("ETag"));
  return data;
}

/* Asks again and again while the page is looked at; a failure is said at the top, and the next success removes it. Where
   an answer takes long to get and to draw, the pauses become longer: a page takes time that a hunt on this machine needs. */
const SHARE_OF_TIME = 0.05, LONGEST_PAUSE_MS = 6000;
export function poll(ask, everyMs) {
  let timer = null, running = false;
  const turn = async () => {
    clearTimeout(timer);
    if (running) return;
    running = true;
    const began = performance.now();
    try {
      await ask();
      tell("");
    } catch (error) {
      tell(error instanceof Refused ? error.message : "The dashboard does not answer. It was stopped, or the connection is lost. Trying again.");
    }
    running = false;
    document.body.dataset.polls = String(Number(document.body.dataset.polls || 0) + 1);
    const pauseMs = Math.min((performance.now() - began) / SHARE_OF_TIME, LONGEST_PAUSE_MS);
    if (!document.hidden) timer = setTimeout(turn, Math.max(everyMs, pauseMs));
  };
  document.addEventListener("visibilitychange", () => { if (!document.hidden) turn(); });
  return turn();
}
export function tell(text) {
  const banner = $("banner");
  if (banner.textContent !== text) banner.textContent = text;
  banner.hidden = !text;
}

export async function post(path) {
  const answer = await fetch(path, { method: "POST", headers: { "X-Crashhunt": "1" }, credentials: "same-origin" });
  const data = await answer.json().catch(() => ({ error: { message: `the server answered ${answer.status}`, fix: "" } }));
  if (!answer.ok) throw new Refused(answer.status, data.error);
  return data;
}
/* Whether the dashboard was started with --allow-control. */
export const mayControl = async () => (await get("/api", { always: true })).control;

/* Formats */
export const count = (value) => (value === null || value === undefined ? "-" : value.toLocaleString("en"));
export function seconds(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  const whole = Math.round(value), hours = Math.floor(whole / 3600), minutes = Math.floor(whole / 60) % 60, rest = whole % 60;
  if (hours >= 48) return `${Math.floor(hours / 24)} d ${hours % 24} h`;
  if (hours) return `${hours} h ${minutes} min`;
  return minutes ? `${minutes} min ${rest} s` : `${rest} s`;
}
export function interval(rate) {
  if (!rate) return "";
  if (!rate.certain) return "";
  const { low, high } = rate.certain;
  return `${low > 0 ? `at least ${formatNumber(low)}, ` : ""}at most ${high === null ? "any number" : formatNumber(high)}`;
}
export function between(rate) {
  const { low, high } = rate.certain;
  return low > 0 && high !== null ? `${formatNumber(low)} to ${formatNumber(high)}` : interval(rate);
}
/* One unit is enough for how long ago something was. */
export function ago(value) {
  const units = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]], whole = Math.max(0, Math.round(value));
  const [size, unit] = units.find(([one]) => whole >= one) ?? [1, "s"];
  return `${Math.floor(whole / size)} ${unit} ago`;
}
/* The state in words: a hunt of the state `crashed` has finished, and its crashes are counted. */
export const stateOf = (row) => (row.exported ? "exported" : row.state === "crashed" ? `finished, ${plural(row.crashes, "crash", "crashes")}` : row.state);
export const plural = (number, one, many) => `${count(number)} ${number === 1 ? one : many}`;
export const short = (value) => (typeof value === "number" ? formatNumber(value) : String(value));

export function setText(node, text) {
  const wanted = String(text);
  if (node.textContent !== wanted) node.textContent = wanted;
}

/* A table with a hidden name; on a narrow screen, each cell shows the label of its column. */
export function table(columns, lines, name) {
  const made = make("table"), head = make("thead"), body = make("tbody"), top = make("tr");
  made.append(make("caption", name, "sr"));
  for (const [label, kind] of columns) top.append(make("th", label, kind === "number" ? "number" : "", { scope: "col" }));
  head.append(top);
  for (const cells of lines) {
    const line = make("tr");
    cells.forEach((cell, place) => {
      const [label, kind] = columns[place], data = make("td", undefined, kind === "number" ? "number" : "", { "data-label": label });
      data.append(cell instanceof Node ? cell : String(cell ?? ""));
      line.append(data);
    });
    body.append(line);
  }
  made.append(head, body);
  return made;
}

/* A button that copies a command. */
export function copyButton(text, what) {
  const button = make("button", "Copy", "", { "aria-label": `Copy the command: ${what}` });
  button.onclick = async () => {
    try { await navigator.clipboard.writeText(text); } catch {
      const area = make("textarea", text);
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  };
  return button;
}

/* Crashes (solid) and crash types (dashed) over trials, as a small picture. */
export function sparkline(curve, firsts) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 120 30");
  svg.setAttribute("class", "spark");
  svg.setAttribute("role", "img");
  const last = curve.length ? curve[curve.length - 1] : [0, 0];
  svg.setAttribute("aria-label", `${plural(last[1], "crash", "crashes")} over ${plural(last[0], "trial", "trials")}`);
  const most = Math.max(1, last[0]), high = Math.max(1, last[1]);
  const line = (points, className) => {
    const path = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
    path.setAttribute("points", points.map(([x, y]) => `${(1 + 118 * x).toFixed(1)},${(28 - 26 * y).toFixed(1)}`).join(" "));
    path.setAttribute("class", className);
    svg.append(path);
  };
  if (curve.length > 1) line(curve.map(([trials, crashes]) => [trials / most, crashes / high]), "crashes");
  if (firsts.length) {
    const points = [[0, 0]];
    firsts.forEach((number, place) => points.push([Math.min(1, number / most), place / firsts.length], [Math.min(1, number / most), (place + 1) / firsts.length]));
    points.push([1, 1]);
    line(points, "kinds");
  }
  return svg;
}

/* Charts of plotly. Its labels know some markup, so that every text of a hunt is spelled out first. */
export const spelled = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
export const PALETTE = ["--s1", "--s2", "--s3", "--s4", "--s5", "--s0"];
export function layout(more = {}) {
  const axis = { gridcolor: css("--line"), zerolinecolor: css("--line"), linecolor: css("--line"), automargin: true, title: { standoff: 8 } };
  const { xaxis = {}, yaxis = {}, ...rest } = more;
  const titled = (given) => ({ ...axis, ...given, ...(given.title ? { title: { text: given.title, standoff: 8 } } : {}) });
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: css("--text"), family: "system-ui, sans-serif", size: 12 },
    margin: { l: 50, r: 14, t: 10, b: 44 }, hovermode: "closest", showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    hoverlabel: { bgcolor: css("--card"), bordercolor: css("--line"), font: { color: css("--text") } },
    ...rest, xaxis: titled(xaxis), yaxis: titled(yaxis),
  };
}
export const CONFIG = { responsive: true, displayModeBar: false, displaylogo: false, doubleClick: "reset" };
/* A chart that is out of sight waits: the first view is complete earlier, and a running hunt, whose charts change every
   few seconds, costs little for charts that nobody looks at. A chart that was never drawn is drawn as soon as there is
   time, so that scrolling shows it at once. */
const NEAR_PX = 200, waiting = new Map();
const sight = new IntersectionObserver((seen) => { for (const one of seen) if (one.isIntersecting) drawNow(one.target); }, { rootMargin: `${NEAR_PX}px` });
function drawNow(node) {
  const job = waiting.get(node);
  waiting.delete(node);
  sight.unobserve(node);
  node.dataset.drawn = "true";
  job?.();
}
export function drawWhenNear(node, job) {
  const { top, bottom } = node.getBoundingClientRect();
  waiting.set(node, job);
  if (bottom > -NEAR_PX && top < innerHeight + NEAR_PX) drawNow(node); else sight.observe(node);
}
/* One at a time, so that the page answers in between. */
export function drawTheRest() {
  const node = [...waiting.keys()].find((one) => one.dataset.drawn !== "true");
  if (node) setTimeout(() => { if (waiting.has(node)) drawNow(node); drawTheRest(); }, 50);
}
addEventListener("beforeprint", () => { for (const node of [...waiting.keys()]) drawNow(node); });

export function draw(node, traces, more, name, onClick) {
  node.setAttribute("role", "img");
  node.setAttribute("aria-label", name);
  drawWhenNear(node, () => {
    const isFirst = !node.on;
    Plotly.react(node, traces, layout({ uirevision: "keep", ...more }), CONFIG);
    document.getElementById("js-plotly-tester")?.setAttribute("aria-hidden", "true");
    if (isFirst && onClick) node.on("plotly_click", (event) => onClick(event.points));
  });
}
export function onScheme(redraw) { matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw); }
