// Tables whose columns sort when their heads are pressed.
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

// those of the report, and of the documentation's site
for (const table of document.querySelectorAll("table.sortable, .md-typeset table")) {
  for (const [column, head] of [...table.tHead.rows[0].cells].entries()) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.onclick = () => sortTable(table, column, head.getAttribute("aria-sort") === "ascending");
  }
}
