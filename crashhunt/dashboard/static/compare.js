/* Several hunts next to each other: the numbers of `crashhunt compare`, and their curves in one plot. */
import { $, PALETTE, count, css, draw, get, make, onScheme, poll, spelled, table } from "/static/common.js";

let data = null;
const loaded = window.Plotly ? Promise.resolve() : new Promise((resolve) => { document.querySelector('script[src^="/static/plotly.js"]').addEventListener("load", resolve); });

function showTable() {
  const columns = [["Hunt"], ["Trials", "number"], ["Crashes", "number"], ["Crash rate per trial", "number"], ["95 % interval", "number"], ["Median step", "number"], ["Median time to collision", "number"]];
  const lines = data.hunts.map((hunt, place) => {
    const figures = hunt.figures, key = make("span", "", "key"), name = make("span");
    key.style.background = css(PALETTE[place % PALETTE.length]);
    name.append(key, make("a", hunt.name, "", { href: `/hunts/${hunt.id}` }));
    if (figures?.why_not || hunt.problem) name.append(make("span", hunt.problem || `${Number.isFinite(figures.crash_rate) ? "no interval" : "no crash rate"}: ${figures.why_not}`, "sub"));
    if (!figures) return [name, count(hunt.trials_run), count(hunt.crashed_trials), "-", "-", "-", "-"];
    const time_s = figures.median_time_to_collision_s;
    return [name, count(figures.trials), count(figures.crashes), Number.isFinite(figures.crash_rate) ? formatNumber(figures.crash_rate) : "-", figures.interval ? `${formatNumber(figures.interval[0])} to ${formatNumber(figures.interval[1])}` : "-", figures.median_steps_to_crash ?? "-", time_s === null ? "-" : `${time_s.toFixed(1)} s`];
  });
  $("table").replaceChildren(table(columns, lines, "Hunts next to each other"));
  $("verdicts").replaceChildren(...data.pairs.flatMap((pair) => [make("p", pair.verdict), ...(pair.caution ? [make("p", `But ${pair.caution}.`, "faint")] : [])]));
}

function drawCurves() {
  if (!data || !window.Plotly) return;
  $("curves").hidden = !data.hunts.length;
  if (!data.hunts.length) return;
  const axis = Number($("over").value), color = (place) => css(PALETTE[place % PALETTE.length]);
  draw($("crashes"), data.hunts.map((hunt, place) => ({ x: hunt.curve.map((one) => one[axis]), y: hunt.curve.map((one) => one[2]), name: spelled(hunt.name), mode: "lines", line: { color: color(place), width: 2 } })), { xaxis: { title: axis ? "simulated steps" : "trials" }, yaxis: { title: "crashes", rangemode: "tozero" } }, "Crashes of each hunt");
  draw($("types"), data.hunts.map((hunt, place) => ({ x: [0, ...hunt.kind_firsts.map((number) => number + 1), hunt.trials_run], y: [0, ...hunt.kind_firsts.map((_, index) => index + 1), hunt.kind_firsts.length], name: spelled(hunt.name), mode: "lines", line: { color: color(place), width: 2, shape: "hv" } })), { xaxis: { title: "trials" }, yaxis: { title: "crash types", rangemode: "tozero" } }, "Crash types of each hunt");
}

async function refresh() {
  const found = await get(`/api/compare${location.search}`);
  if (found) {
    data = found;
    showTable();
    await loaded;
    drawCurves();
  }
  document.body.dataset.complete = "true";
}
$("over").onchange = drawCurves;
onScheme(() => { if (data) { showTable(); drawCurves(); } });
poll(refresh, 5000);
