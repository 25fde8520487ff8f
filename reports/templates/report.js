"use strict";

// Sorting: a header's button sorts by its column, and again the other way round. Cells without a key
// (failed, or a parameter that the technique lacks) come last both ways.
for (const table of document.querySelectorAll("table.sortable")) {
  const headers = [...table.tHead.rows[0].cells];
  headers.forEach((header, column) => {
    header.querySelector("button").addEventListener("click", () => {
      const descending = header.getAttribute("aria-sort") === "ascending";
      for (const other of headers) other.removeAttribute("aria-sort");
      header.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const numeric = header.classList.contains("number");
      const keyOf = (row) => row.cells[column].dataset.sort;
      const rows = [...table.tBodies[0].rows];
      rows.sort((a, b) => {
        const [x, y] = [keyOf(a), keyOf(b)];
        if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
        const order = numeric ? Number(x) - Number(y) : x.localeCompare(y);
        return descending ? -order : order;
      });
      table.tBodies[0].append(...rows);
    });
  });
}

// Filtering: every word must occur in the row.
const filter = document.getElementById("filter");
if (filter) {
  const rows = [...document.getElementById("measurement-table").tBodies[0].rows];
  const shown = filter.parentElement.querySelector("output");
  const apply = () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of rows) {
      // With spaces between cells, which textContent would join.
      const text = [...row.cells].map((cell) => cell.textContent).join(" ").toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
    shown.textContent = words.length ? `${rows.filter((row) => !row.hidden).length} of ${rows.length}` : "";
  };
  filter.addEventListener("input", apply);
  apply(); // a reload may keep what was typed
}

// Enlarging a picture.
const enlarged = document.getElementById("enlarged");
for (const button of document.querySelectorAll("button.enlarge")) {
  button.addEventListener("click", () => {
    const [from, to] = [button.querySelector("img"), enlarged.querySelector("img")];
    to.src = from.src;
    to.alt = from.alt;
    enlarged.showModal();
  });
}
if (enlarged) enlarged.addEventListener("click", (event) => { if (event.target === enlarged) enlarged.close(); });

// Printing: charts are drawn anew at the width of the paper, since they would be cut otherwise.
const PAPER_PX = 680; // A4 or Letter, upright, less the margins of @page in report.css
const charts = () => document.querySelectorAll(".js-plotly-plot");
addEventListener("beforeprint", () => {
  for (const chart of charts()) Plotly.relayout(chart, { autosize: false, width: PAPER_PX });
});
addEventListener("afterprint", () => {
  for (const chart of charts()) Plotly.relayout(chart, { autosize: true, width: null });
});
