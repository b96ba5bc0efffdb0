"use strict";
// Sorting, the slice sliders, and what the address says: #slice=12&show=error&sort=tissue.2

const all = (selector, root = document) => [...root.querySelectorAll(selector)];

function key(cell, numeric) {
  const text = cell.textContent.trim();
  if (!numeric) return text;
  const said = cell.dataset.number ?? text.replace("−", "-");
  const number = said === "inf" ? Infinity : parseFloat(said);
  return Number.isNaN(number) ? null : number; // "–" and a status have no number and go last
}

function sortBy(table, column, descending) {
  const head = table.querySelector(`th[data-column="${column}"]`);
  if (!head) return;
  const numeric = head.classList.contains("num");
  const rows = all("tbody tr", table).map((row) => [key(row.cells[column], numeric), row]);
  rows.sort(([a], [b]) => {
    if (a === null || b === null) return (a === null) - (b === null);
    const order = numeric ? (a === b ? 0 : a - b) : a.localeCompare(b);
    return descending ? -order : order;
  });
  table.tBodies[0].append(...rows.map(([, row]) => row));
  all("th", table).forEach((th) => th.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", descending ? "descending" : "ascending");
}

all("th[data-column]").forEach((th) => {
  const button = document.createElement("button");
  button.type = "button";
  button.append(...th.childNodes);
  th.append(button);
});

document.addEventListener("click", (event) => {
  const head = event.target.closest("th[data-column]");
  if (!head) return;
  const last = head.getAttribute("aria-sort");
  const descending = last ? last === "ascending" : head.classList.contains("num");
  sortBy(head.closest("table"), Number(head.dataset.column), descending);
});

const scenes = all("section.scene").map((section) => {
  const images = JSON.parse(section.querySelector("script").textContent);
  const slider = section.querySelector("input[type=range]");
  const scene = { section, images, slider };
  slider.addEventListener("input", () => {
    show(scene, Number(slider.value));
    history.replaceState(null, "", `#slice=${images.z[Number(slider.value)]}`);
  });
  return scene;
});

function show({ section, images, slider }, k) {
  slider.value = k;
  section.querySelector("output").textContent = images.said[k];
  slider.setAttribute("aria-valuetext", images.said[k]);
  for (const image of all("img", section)) {
    const data = images[image.dataset.kind][image.dataset.row ?? "all"][k];
    if (data) image.src = `data:image/png;base64,${data}`;
    else image.removeAttribute("src");
  }
}

function look(kind) {
  for (const body of all(".tiles")) {
    body.classList.toggle("show-volume", kind === "volume");
    body.classList.toggle("show-error", kind === "error");
    body.classList.toggle("one", kind !== "both");
  }
}

function nearest(values, wanted) {
  return values.reduce((best, z, k) => (Math.abs(z - wanted) < Math.abs(values[best] - wanted) ? k : best), 0);
}

function obey() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const slice = parseFloat(asked.get("slice"));
  if (!Number.isNaN(slice)) scenes.forEach((scene) => show(scene, nearest(scene.images.z, slice)));
  const radio = all("input[name=show]").find((input) => input.value === asked.get("show"));
  if (radio) { radio.checked = true; look(radio.value); }
  const [name, column] = (asked.get("sort") ?? "").split(".");
  const table = document.getElementById(`table-${name}`)?.querySelector("table");
  if (table) { table.closest("details")?.setAttribute("open", ""); sortBy(table, Math.abs(column), !(column < 0)); }
}

all("input[name=show]").forEach((radio) => radio.addEventListener("change", () => look(radio.value)));
all("input[name=ring]").forEach((box) => box.addEventListener("change", () => {
  all(".tiles").forEach((tiles) => tiles.classList.toggle("plain", !box.checked));
}));
all("input[name=method]").forEach((box) => box.addEventListener("change", () => {
  all(".tile").filter((tile) => tile.dataset.method === box.value).forEach((tile) => { tile.hidden = !box.checked; });
}));
window.addEventListener("hashchange", obey);
scenes.forEach((scene) => show(scene, scene.images.start));
obey();
