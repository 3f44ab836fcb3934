"use strict";
// Filters and sorts the tables of class "filterable"; without it they are plain tables.
for (const holder of document.querySelectorAll(".filterable")) {
  const table = holder.querySelector("table");
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const heads = [...table.tHead.rows[0].cells];
  const text = (row, column) => row.cells[column].textContent;
  const bar = document.createElement("form");
  const count = document.createElement("output");
  const chosen = new Map();
  bar.className = "filter-bar";

  const show = () => {
    let shown = 0;
    for (const row of rows) {
      row.hidden = [...chosen].some(([column, select]) => select.value && text(row, column) !== select.value);
      shown += row.hidden ? 0 : 1;
    }
    count.textContent = `${shown} of ${rows.length} rows`;
  };

  heads.forEach((head, column) => {
    if (head.dataset.kind === "choice") {
      const label = document.createElement("label");
      const select = document.createElement("select");
      const values = [...new Set(rows.map((row) => text(row, column)))].sort();
      select.append(new Option("all", ""), ...values.map((value) => new Option(value, value)));
      select.addEventListener("change", show);
      label.append(`${head.textContent} `, select);
      bar.append(label);
      chosen.set(column, select);
    }
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      const sign = down ? -1 : 1;
      const value = (row) => {
        const number = parseFloat(text(row, column).replace("<", ""));
        return Number.isNaN(number) ? -Infinity : number;
      };
      const compare = head.dataset.kind === "number"
        ? (a, b) => value(a) - value(b) || 0
        : (a, b) => text(a, column).localeCompare(text(b, column));
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      rows.sort((a, b) => sign * compare(a, b));
      body.append(...rows);
    });
    head.replaceChildren(button);
  });

  bar.append(count);
  bar.addEventListener("submit", (event) => event.preventDefault());
  holder.before(bar);
  show();
}
