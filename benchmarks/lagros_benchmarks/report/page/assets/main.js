// What is chosen above holds for the table, the figures and the episodes.
byId("title").textContent = DATA.title;
byId("command").textContent = DATA.command || "";
byId("made").textContent = DATA.made ? `Made with ${DATA.made}.` : "";
const CASES = DATA.conditions.map((one, index) => ({ ...one, index }));
const distinct = (name, among) => [...new Set(among.map((one) => one[name]))];
const showTable = DATA.rows.length ? makeTable() : null;
const choosePlayer = makePlayer();
for (const id of ["results", "figures"]) byId(id).hidden = !DATA.rows.length;
byId("key").append(...(DATA.rows.length ? DATA.series.map((series) => el("li", {}, swatch(series), series.label)) : []));

const fields = [["kind", "Disturbance", (value) => value], ["bound", "Bound d̄", String], ["agents", "Agents", (value) => value]];
const selects = {};
for (const [name, label, text] of fields) {
  const values = distinct(name, CASES);
  if (values.length < 2) continue;
  const [node, select] = choice(label, name, values.map((value) => [value, text(value)]), () => chosen(name));
  selects[name] = select;
  byId("choice").append(node);
}
const every = el("input", { type: "checkbox", id: "all", onchange: () => chosen() });
if (CASES.length > 1) byId("choice").append(el("label", { class: "check", for: "all" }, every, "table of all conditions"));
else byId("choice").hidden = true;
byId("choice").addEventListener("submit", (event) => event.preventDefault());

const fits = (one, but) => fields.every(([name]) => name === but || !selects[name] || String(one[name]) === selects[name].value);
function chosen(changed) {
  // "none" has no bound: what was changed last stays, the rest follows.
  let found = CASES.find((one) => fits(one));
  if (!found) {
    found = CASES.find((one) => String(one[changed]) === selects[changed].value) || CASES[0];
    for (const [name] of fields) if (selects[name]) selects[name].value = found[name];
  }
  if (showTable) {
    showTable(every.checked ? null : found.index);
    drawCharts(found.index);
  }
  choosePlayer(found.index);
}
// First where there is most to see: the last bound of the first kind.
const begin = CASES.filter((one) => one.kind === CASES[0].kind && one.agents === CASES[0].agents).pop();
for (const [name] of fields) if (selects[name]) selects[name].value = begin[name];
chosen("kind");
