// Tables whose columns sort when their heads are pressed, and whose first column filters.
"use strict";

function cellValue(row, column) {
  const text = row.cells[column].textContent.trim();
  const number = parseFloat(text.replace("−", "-"));
  return Number.isNaN(number) ? text : number;
}

function sortTable(table, column, descending) {
  const body = table.tBodies[0];
  const missing = (value) => value === "–" || value === "";
  const compare = (a, b) => {
    const [u, v] = [cellValue(a, column), cellValue(b, column)];
    if (missing(u) || missing(v)) return missing(u) - missing(v); // what does not exist is last either way
    const order = typeof u === "number" && typeof v === "number" ? u - v : String(u).localeCompare(String(v));
    return descending ? -order : order;
  };
  body.append(...[...body.rows].sort(compare));
  for (const [i, head] of [...table.tHead.rows[0].cells].entries()) {
    if (i === column) head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  }
}

function addFilter(table) {
  const rows = [...table.tBodies[0].rows];
  const values = [...new Set(rows.map((row) => row.cells[0].textContent))];
  if (values.length < 2 || values.length === rows.length) return;
  const bar = document.createElement("div");
  bar.className = "filter";
  for (const value of ["all", ...values]) {
    const chip = document.createElement("button");
    chip.className = "chip";
    chip.textContent = value;
    chip.setAttribute("aria-pressed", value === "all");
    chip.onclick = () => {
      for (const row of rows) row.hidden = value !== "all" && row.cells[0].textContent !== value;
      for (const other of bar.children) other.setAttribute("aria-pressed", other === chip);
    };
    bar.append(chip);
  }
  table.parentElement.before(bar);
}

function makeSortable(table) {
  for (const [column, head] of [...table.tHead.rows[0].cells].entries()) {
    let button = head.querySelector("button");
    if (!button) {
      button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
    }
    button.onclick = () => sortTable(table, column, head.getAttribute("aria-sort") === "ascending");
  }
}

for (const table of document.querySelectorAll("table.sortable")) {
  addFilter(table);
  makeSortable(table);
}
for (const table of document.querySelectorAll(".md-typeset table")) makeSortable(table); // of the documentation's site
