// Plotly's figures, drawn when the page is laid out, so that each gets its panel's width.
"use strict";

for (const root of document.querySelectorAll(".curves")) {
  const figure = JSON.parse(root.querySelector("script").textContent);
  Plotly.newPlot(root, figure.data, figure.layout, { responsive: true, displayModeBar: false });
}
