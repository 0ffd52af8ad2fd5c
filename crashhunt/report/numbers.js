/* Numbers of the report and of the dashboard, in the form of `format_number` in Python; arguments as bars and commands. */
function formatNumber(value) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  if (size < 999999.5 && (Number.isInteger(value) || size >= 999.5)) return Math.round(value).toLocaleString("en");
  if (size >= 0.0001 && size < 999.5) return String(Number(value.toPrecision(3)));
  const [digits, power] = value.toExponential(2).split("e");
  return `${Number(digits)}e${Number(power)}`;
}
/* Two decimals, as in texts and tables. */
function formatCriticality(value) { return typeof value === "number" && Number.isFinite(value) ? value.toFixed(2) : "-"; }
function formatPercent(share) { return `${formatNumber(100 * share)} %`; }

function quoted(text) { return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`; }
/* The command that runs the arguments of a trial again, with other seeds. */
function commandAgain({ maxSteps, scenario, agents, scenarioArguments, disturb }, values) {
  const words = ["crashhunt", "run", "again", "0", "100", String(maxSteps), "--scenario", scenario], drivers = Object.entries(agents);
  for (const [id, agent] of drivers) words.push("--agent", drivers.length > 1 ? `${id}=${agent}` : agent);
  for (const [name, value] of Object.entries(values)) words.push(scenarioArguments.includes(name) ? "--set" : "--arg", `${name}=${value}`);
  if (disturb) words.push("--disturb", disturb);
  return words.map(quoted).join(" ");
}

/* The share that each argument explains, with its interval. */
function importanceBars(importance) {
  const part = (tag, className, text = "") => Object.assign(document.createElement(tag), { className, textContent: text });
  return importance.flatMap(({ name, share, low, high }) => {
    const box = part("div", "weight"), bar = part("div", "bar"), span = part("div", "span");
    bar.style.width = `${100 * share}%`;
    span.style.left = `${100 * low}%`;
    span.style.width = `${100 * (high - low)}%`;
    box.append(bar, span);
    return [part("span", "", name), box, part("span", "", `${formatPercent(share)} (${formatPercent(low)} to ${formatPercent(high)})`)];
  });
}
