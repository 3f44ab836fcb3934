// Elements are made of text and nodes alone: no name of a policy is ever read as a tag.
const DATA = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== false && value != null) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter((child) => child != null));
  return node;
}
const el = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
const svg = (tag, attributes, ...children) =>
  fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);

// A choice with its label; `options` are [value, text].
function choice(label, id, options, onchange) {
  const select = el("select", { id, onchange });
  for (const [value, text] of options) select.append(el("option", { value }, text));
  return [el("label", { for: id }, label, select), select];
}

function option(select, options, preferred) {
  const before = preferred ?? select.value;
  select.replaceChildren(...options.map(([value, text]) => el("option", { value }, text)));
  if (options.some(([value]) => String(value) === String(before))) select.value = before;
}

const number = (value) =>
  value == null || !isFinite(value) ? "–" : String(+value.toPrecision(3)).replace("-", "−");

// Line and marker of a policy, for the table and the keys.
function swatch(series) {
  return svg("svg", { class: "swatch", viewBox: "0 0 26 11", "aria-hidden": "true" },
    svg("line", { x1: 0, x2: 26, y1: 5.5, y2: 5.5, stroke: series.colour, "stroke-width": 2.5,
      "stroke-dasharray": series.dashes || null }),
    marker(13, 5.5, series));
}

const marker = (x, y, series) =>
  svg("circle", { cx: x, cy: y, r: 4, stroke: series.colour, "stroke-width": 1.6,
    fill: series.filled ? series.colour : "#fff" });

// What `packed` made of an array: its shape, and its entries one after the other.
function unpacked(given) {
  if (!given) return null;
  const bytes = Uint8Array.from(atob(given.data), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer), values = new Float64Array(bytes.length / 2);
  for (let k = 0; k < values.length; k++) {
    const step = view.getInt16(2 * k, true);
    values[k] = step === -32768 ? NaN : given.low + given.step * (step + 32767);
  }
  return { values, rows: given.shape[0], width: given.shape.slice(1).reduce((a, b) => a * b, 1),
    shape: given.shape };
}
