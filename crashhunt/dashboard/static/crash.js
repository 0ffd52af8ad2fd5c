/* The page of one crash: the player of the report, and what is said of the crash. */
import { $, copyButton, get, make, mayControl, onScheme, poll, post, setText, tell } from "/static/common.js";

const [, , ID, , CRASH] = location.pathname.split("/"), API = `/api/hunts/${ID}/crashes/${CRASH}`;
$("hunt").href = `/hunts/${ID}`;

function facts(crash) {
  const lineage = crash.lineage.map(([number, origin, danger]) => `trial ${number} (${origin || "no strategy"}${danger === null ? "" : `, criticality ${formatCriticality(danger)}`})`);
  const fault = crash.fault?.findings?.map((one) => `${one.rule}: ${one.words} (${one.source})`) ?? [];
  return [["arguments", crash.arguments], ...(lineage.length ? [["made from", lineage.join(", ")]] : []), ...Object.entries(crash.facts), ...(fault.length ? [["rules", fault.join("\n")]] : []), ["folder", crash.path]];
}

/* The minimized crash of a crash, and the crash that a minimized one was made from. */
function relate(crash) {
  const links = [["minimized crash: ", crash.minimized], ["minimized from ", crash.minimized_from]].filter(([, id]) => id);
  $("related").hidden = !links.length;
  $("related").replaceChildren(...links.flatMap(([words, id]) => [words, make("a", id, "", { href: `/hunts/${ID}/crashes/${encodeURIComponent(id)}` })]));
}

async function begin() {
  let crash;
  try { crash = await get(API, { always: true }); } catch (error) {
    setText($("title"), decodeURIComponent(CRASH));
    tell(error.message ?? String(error));
    document.body.dataset.complete = "true";
    return;
  }
  document.title = `${crash.id} - crashhunt`;
  setText($("title"), crash.id);
  setText($("hunt"), `Hunt ${crash.path.split("/").at(-3)}`);
  for (const id of ["player", "more"]) $(id).hidden = false;
  await window.load(crash);
  $("commands").replaceChildren(...crash.commands.flatMap(([name, command]) => [make("span", name), make("code", command), copyButton(command, name)]));
  $("log").href = `${API}/log`;
  $("export").href = `${API}/export`;
  const output = [crash.run_log, crash.error_log].filter((text) => text).join("\n");
  $("logs").hidden = !output;
  setText($("output"), output);
  relate(crash);
  window.show(crash, facts(crash));
  const neighbours = { "-1": crash.previous, 1: crash.next };
  for (const [id, by] of [["previous", -1], ["next", 1]]) $(id).hidden = !neighbours[by];
  window.anotherCrash = (by) => { if (neighbours[by]) location.href = encodeURIComponent(neighbours[by]); };
  window.addEventListener("resize", window.draw);
  onScheme(window.draw);
  document.body.dataset.complete = "true";
}
/* With --allow-control: commands for the crash, one after the other on the server. */
async function control() {
  if (!(await mayControl())) return;
  $("control").hidden = false;
  const names = [...$("commands").querySelectorAll("span")].map((node) => node.textContent);
  for (const button of document.querySelectorAll("[data-job]")) button.hidden = !names.includes(button.textContent.toLowerCase());
  let ended = 0;
  const refresh = async () => {
    const found = await get(`${API}/jobs`);
    if (!found) return;
    const done = found.jobs.filter((job) => job.state === "ended").length;
    if (done > ended) {
      /* A job such as judge adds to the crash; the player stays where it is. */
      const crash = await get(API, { always: true });
      window.describe(crash, facts(crash));
      relate(crash);
    }
    ended = done;
    $("jobs").replaceChildren(...found.jobs.flatMap((job) => {
      const said = job.state === "ended" ? `ended with exit code ${job.exit_code}` : job.state, output = make("pre", job.output, "log", { tabindex: "0", role: "region", "aria-label": `Output of ${job.name}` });
      return [make("p", `${job.name}: ${said}`), ...(job.output ? [output] : [])];
    }));
  };
  for (const button of document.querySelectorAll("[data-job]")) {
    button.onclick = async () => {
      try { await post(`${API}/jobs/${button.dataset.job}`); await refresh(); } catch (error) { tell(error.message); }
    };
  }
  poll(refresh, 1500);
}
begin().then(control);
