"use strict";
// Tables sort by the column whose name is clicked: descending, then ascending.
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

// The page contains the drawing library as text, which loads fast. It is run once, for the first
// figure that is drawn.
function library() {
  if (window.Plotly !== undefined) return;
  const code = document.createElement("script");
  code.textContent = document.querySelector("[data-library]").textContent;
  document.head.append(code);
}

// A figure is drawn when it comes near the window; the others are drawn when the browser is idle.
const root = document.documentElement;
const boxes = [...document.querySelectorAll("[data-figure]")];
const linked = boxes.filter((box) => box.dataset.linked !== undefined);
// On a touch screen, a swipe over a figure scrolls the page; buttons zoom.
const coarse = matchMedia("(pointer: coarse)").matches;
const config = { responsive: true, displaylogo: false, modeBarButtons: [["toImage", "resetScale2d"]] };
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
const ink = () => ({ "font.color": colour("--quiet") });
const visible = (box) => box.offsetParent !== null;
// The time range that linked figures show; null for all of it.
let shown = null;

function draw(box) {
  if (box.dataset.drawn !== undefined) return;
  box.dataset.drawn = "";
  library();
  const { data, layout } = JSON.parse(box.nextElementSibling.textContent);
  layout.font = { ...layout.font, color: colour("--quiet") };
  if (coarse) layout.dragmode = false;
  const bar = coarse || box.dataset.linked !== undefined ? { displayModeBar: false } : {};
  Plotly.newPlot(box, data, layout, { ...config, ...bar });
  if (box.dataset.linked === undefined) return;
  show(box);
  box.on("plotly_relayout", follow);
}

// Figures of one recording show the same time range.
function follow(change) {
  const range = change["xaxis.range"] ?? [change["xaxis.range[0]"], change["xaxis.range[1]"]];
  if (change["xaxis.autorange"]) shown = null;
  else if (range[0] !== undefined) shown = [...range];
  else return;
  for (const box of linked) if (visible(box)) show(box);
}

function show(box) {
  const now = box.layout?.xaxis;
  if (now === undefined) return;
  if (shown ? !now.autorange && now.range[0] === shown[0] && now.range[1] === shown[1] : now.autorange)
    return;
  Plotly.relayout(box, shown ? { "xaxis.range": [...shown] } : { "xaxis.autorange": true });
}

// By keyboard or buttons: plus and minus zoom in time, arrows move, 0 shows all.
function move(box, name) {
  const [low, high] = box.layout.xaxis.range;
  const middle = (low + high) / 2;
  const half = (high - low) / 2;
  const to = {
    "+": [middle - half / 1.5, middle + half / 1.5],
    "=": [middle - half / 1.5, middle + half / 1.5],
    "-": [middle - half * 1.5, middle + half * 1.5],
    ArrowLeft: [low - half / 4, high - half / 4],
    ArrowRight: [low + half / 4, high + half / 4],
  }[name];
  if (to === undefined && name !== "0") return false;
  Plotly.relayout(box, to === undefined ? { "xaxis.autorange": true } : { "xaxis.range": to });
  return true;
}
for (const box of linked)
  box.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || box.layout === undefined) return;
    if (move(box, event.key)) event.preventDefault();
  });
for (const button of document.querySelectorAll("[data-key]"))
  button.addEventListener("click", () => {
    const box = linked.find(visible);
    if (box === undefined) return;
    draw(box);
    move(box, button.dataset.key);
  });

// Shows the panel of one joint at a time; without this script all panels are visible.
const panels = [...document.querySelectorAll("[data-panel]")];
const choices = [...document.querySelectorAll("input[name=joint]")];
function choose() {
  const chosen = choices.find((choice) => choice.checked);
  if (chosen === undefined) return;
  for (const panel of panels) panel.hidden = panel.dataset.panel !== chosen.value;
  refresh();
}
for (const choice of choices) choice.addEventListener("change", choose);

// Draws the visible figures, at the present width and time range.
function refresh() {
  if (!ready) return;
  for (const box of boxes) {
    if (!visible(box)) continue;
    if (box.layout === undefined) {
      if (box.closest("[data-panel], details")) draw(box);
      continue;
    }
    Plotly.Plots.resize(box);
    if (box.dataset.linked !== undefined) show(box);
  }
}
for (const one of document.querySelectorAll("details")) one.addEventListener("toggle", refresh);

const seen = new IntersectionObserver(
  (entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
  },
  { rootMargin: "300px" },
);
const idle = window.requestIdleCallback ?? ((call) => setTimeout(call, 50));
function drawOne() {
  const box = boxes.find((one) => one.dataset.drawn === undefined && visible(one));
  if (box === undefined) return;
  draw(box);
  idle(drawOne);
}
// Figures wait until the page is loaded and shown; text, tables and links do not need them.
let ready = false;
choose();
addEventListener("load", () =>
  idle(() => {
    ready = true;
    for (const box of boxes) seen.observe(box);
    idle(drawOne);
  }),
);

const drawn = () => boxes.filter((box) => box.layout !== undefined);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  for (const box of drawn()) Plotly.relayout(box, ink());
});
// Figures are drawn for the window. Paper is narrower and white, and shows collapsed content.
const folded = document.querySelectorAll("details:not(.raw)");
addEventListener("beforeprint", () => {
  for (const panel of panels) panel.hidden = false;
  for (const one of folded) one.open = true;
  for (const box of boxes) draw(box);
  for (const box of drawn()) Plotly.relayout(box, { width: 680, "font.color": "#444" });
});
addEventListener("afterprint", () => {
  choose();
  for (const box of drawn()) Plotly.relayout(box, { autosize: true, width: null, ...ink() });
});
