"use strict";
// Tables sort by the column whose name is clicked: down, then up.
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const value = (row, k) => {
    const cell = row.cells[k];
    if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
    const text = cell.textContent.trim();
    const number = Number(text.replace("< ", "").replaceAll("−", "-"));
    return text === "" || Number.isNaN(number) ? text : number;
  };
  const order = (a, b) =>
    typeof a === "number" && typeof b === "number"
      ? (Number.isNaN(a) - Number.isNaN(b)) || a - b
      : String(a).localeCompare(String(b), "en", { numeric: true });
  heads.forEach((head, k) => {
    if ([...body.rows].every((row) => row.cells[k].classList.contains("number")))
      head.classList.add("number");
    head.firstElementChild.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") === "descending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const rows = [...body.rows].sort((a, b) => order(value(a, k), value(b, k)));
      body.append(...(up ? rows : rows.reverse()));
    });
  });
}
// Figures are drawn for the window; paper is narrower.
const plots = () => document.querySelectorAll(".js-plotly-plot");
addEventListener("beforeprint", () => {
  for (const plot of plots()) Plotly.relayout(plot, { width: 680 });
});
addEventListener("afterprint", () => {
  for (const plot of plots()) Plotly.relayout(plot, { autosize: true, width: null });
});
