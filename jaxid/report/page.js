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

// The drawing library lies in the page as text, which costs nothing to load, and is run once, for
// the first figure that is drawn.
function library() {
  if (window.Plotly !== undefined) return;
  const code = document.createElement("script");
  code.textContent = document.querySelector("[data-library]").textContent;
  document.head.append(code);
}

// A figure is drawn once it comes near the window, the others when the browser has nothing to do.
const root = document.documentElement;
const boxes = [...document.querySelectorAll("[data-figure]")];
const config = { responsive: true, displaylogo: false, modeBarButtons: [["toImage", "resetScale2d"]] };
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
const ink = () => ({ "font.color": colour("--quiet") });

function draw(box) {
  if (box.dataset.drawn !== undefined) return;
  box.dataset.drawn = "";
  library();
  const { data, layout } = JSON.parse(box.nextElementSibling.textContent);
  layout.font = { ...layout.font, color: colour("--quiet") };
  Plotly.newPlot(box, data, layout, config);
  if (box.dataset.linked !== undefined) box.on("plotly_relayout", (change) => follow(box, change));
}

// Figures of one recording show the same stretch of time.
function follow(box, change) {
  const range = change["xaxis.range"] ?? [change["xaxis.range[0]"], change["xaxis.range[1]"]];
  const whole = change["xaxis.autorange"];
  if (range[0] === undefined && !whole) return;
  for (const other of boxes) {
    if (other === box || other.dataset.linked !== box.dataset.linked) continue;
    draw(other);
    const now = other.layout.xaxis;
    if (whole ? now.autorange : !now.autorange && now.range[0] === range[0] && now.range[1] === range[1])
      continue;
    Plotly.relayout(other, whole ? { "xaxis.autorange": true } : { "xaxis.range": [...range] });
  }
}

// Plus and minus zoom in time, arrows move, 0 shows all.
function key(event) {
  const box = event.currentTarget;
  if (event.ctrlKey || event.metaKey || event.altKey || box.layout === undefined) return;
  const [low, high] = box.layout.xaxis.range;
  const middle = (low + high) / 2;
  const half = (high - low) / 2;
  const to = {
    "+": [middle - half / 1.5, middle + half / 1.5],
    "=": [middle - half / 1.5, middle + half / 1.5],
    "-": [middle - half * 1.5, middle + half * 1.5],
    ArrowLeft: [low - half / 4, high - half / 4],
    ArrowRight: [low + half / 4, high + half / 4],
  }[event.key];
  if (to === undefined && event.key !== "0") return;
  event.preventDefault();
  Plotly.relayout(box, to === undefined ? { "xaxis.autorange": true } : { "xaxis.range": to });
}

const seen = new IntersectionObserver(
  (entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
  },
  { rootMargin: "300px" },
);
for (const box of boxes)
  if (box.dataset.linked !== undefined) box.addEventListener("keydown", key);
const idle = window.requestIdleCallback ?? ((call) => setTimeout(call, 50));
function drawOne() {
  const box = boxes.find((one) => one.dataset.drawn === undefined);
  if (box === undefined) return;
  draw(box);
  idle(drawOne);
}
// Not before the page has loaded and been shown: text, tables and links need no figure.
addEventListener("load", () =>
  idle(() => {
    for (const box of boxes) seen.observe(box);
    idle(drawOne);
  }),
);

const drawn = () => boxes.filter((box) => box.layout !== undefined);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  for (const box of drawn()) Plotly.relayout(box, ink());
});
// Figures are drawn for the window; paper is narrower, white, and shows what is folded away.
const folded = document.querySelectorAll("details:not(.raw)");
addEventListener("beforeprint", () => {
  for (const box of boxes) draw(box);
  for (const box of drawn()) Plotly.relayout(box, { width: 680, "font.color": "#444" });
  for (const one of folded) one.open = true;
});
addEventListener("afterprint", () => {
  for (const box of drawn()) Plotly.relayout(box, { autosize: true, width: null, ...ink() });
});
