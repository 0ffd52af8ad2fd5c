/* The bars of the report and of the dashboard: the share that each argument explains, with its interval. */
function importanceBars(importance) {
  const part = (tag, className, text = "") => Object.assign(document.createElement(tag), { className, textContent: text });
  const percent = (value) => (100 * value).toFixed(0);
  return importance.flatMap(({ name, share, low, high }) => {
    const box = part("div", "weight"), bar = part("div", "bar"), span = part("div", "span");
    bar.style.width = `${100 * share}%`;
    span.style.left = `${100 * low}%`;
    span.style.width = `${100 * (high - low)}%`;
    box.append(bar, span);
    return [part("span", "", name), box, part("span", "", `${percent(share)} % (${percent(low)} to ${percent(high)} %)`)];
  });
}
