// Tables whose columns sort when their heads are pressed: those of the report, and of the documentation's site.
"use strict";

/** Below 0 if one text comes before another; what does not exist is last either way. */
function compared(u, v, descending) {
  const missing = (text) => text === "–" || text === "";
  if (missing(u) || missing(v)) return missing(u) - missing(v);
  const difference = parseFloat(u.replace("−", "-")) - parseFloat(v.replace("−", "-"));
  const order = Number.isNaN(difference) ? u.localeCompare(v) : difference;
  return descending ? -order : order;
}

for (const table of document.querySelectorAll("table.sortable, .md-typeset table")) {
  const [heads, body] = [[...table.tHead.rows[0].cells], table.tBodies[0]];
  for (const [column, head] of heads.entries()) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.onclick = () => {
      const descending = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const text = (row) => row.cells[column].textContent.trim();
      body.append(...[...body.rows].sort((a, b) => compared(text(a), text(b), descending)));
    };
  }
}
