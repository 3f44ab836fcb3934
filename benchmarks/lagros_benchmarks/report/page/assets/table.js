// Lines of text: what is indented is a list below the line before it.
function listed(lines) {
  const found = [];
  for (const line of lines) {
    const last = found[found.length - 1];
    if (!line.startsWith(" ")) found.push(el("p", {}, line));
    else if (line.startsWith("    ") && last?.tagName === "UL") last.lastChild.append(` ${line.trim()}`);
    else if (last?.tagName === "UL") last.append(el("li", {}, line.trim()));
    else found.push(el("ul", {}, el("li", {}, line.trim())));
  }
  return found;
}

// The table: rows of one condition or of all, in the order of the run or of a column.
function makeTable() {
  const head = byId("table").tHead, body = byId("table").tBodies[0];
  const several = DATA.conditions.length > 1;
  const own = several ? [["disturbance", ""], ["d̄", ""]] : [];
  if (several && DATA.conditions.some((one) => one.agents)) own.push(["agents", ""]);
  // The policy first, where it stays while the rest is moved.
  const columns = [DATA.columns[0], ...own, ...DATA.columns.slice(1)];
  const cellsOf = (row) => {
    const one = DATA.conditions[row.condition];
    const where = [one.kind, String(one.bound), one.agents].slice(0, own.length);
    return [DATA.series[row.series].label, ...where, ...row.cells.slice(1)];
  };
  let sorted = null, shown = DATA.rows;

  // The number that a cell begins with; text is compared as text, a dash comes last.
  const key = (cell) => {
    const found = /[−-]?\d+(\.\d+)?(e[+−-]?\d+)?/.exec(cell);
    return found ? Number(found[0].replaceAll("−", "-")) - (cell[0] === "<" ? 1e-9 : 0) : cell;
  };
  const kindOf = (index) => [isText(index) ? "text" : "", index > 0 && index <= own.length ? "where" : ""].join(" ").trim();
  const isText = (index) => index === 0 || columns[index][0] === "disturbance";
  const compare = (index, a, b) => {
    if (isText(index)) return a.localeCompare(b);
    const [one, other] = [key(a), key(b)];
    return typeof one === "string" || typeof other === "string" ? 0 : one - other;
  };
  const missing = (index, cell) => !isText(index) && typeof key(cell) === "string";

  function draw() {
    const rows = shown.map((row) => ({ row, cells: cellsOf(row) }));
    if (sorted) {
      const { index, down } = sorted;
      rows.sort((a, b) => missing(index, a.cells[index]) - missing(index, b.cells[index])
        || (down ? -1 : 1) * compare(index, a.cells[index], b.cells[index]));
    }
    body.replaceChildren(...rows.map(({ row, cells }) => el("tr", {}, ...cells.map((cell, index) =>
      el("td", { class: kindOf(index) || null },
        index === 0 ? swatch(DATA.series[row.series]) : null, cell)))));
    [...head.rows[0].cells].forEach((cell, index) => cell.setAttribute("aria-sort",
      sorted && sorted.index === index ? (sorted.down ? "descending" : "ascending") : "none"));
  }

  function sort(index) {
    // First what is usually asked for: the most of a number, names from A.
    const down = sorted && sorted.index === index ? !sorted.down : !isText(index);
    sorted = { index, down };
    draw();
  }

  head.append(el("tr", {}, ...columns.map(([heading, unit], index) =>
    el("th", { scope: "col", class: kindOf(index) || null },
      el("button", { type: "button", onclick: () => sort(index) },
        el("span", {}, heading), el("small", {}, unit))))));
  byId("legend").textContent = DATA.legend || "";
  return (condition) => {
    byId("table").classList.toggle("one", condition != null);
    shown = DATA.rows.filter((row) => condition == null || row.condition === condition);
    draw();
    const said = condition == null ? [] : DATA.conditions[condition].lines;
    byId("lines").replaceChildren(...listed([...said, ...DATA.lines]));
  };
}
