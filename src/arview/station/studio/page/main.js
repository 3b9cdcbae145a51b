// The page: connects the store, the tree, the 3D view and the tabs.

import { ask, post } from "./api.js";
import { find, icon, make } from "./dom.js";
import { Picker } from "./picker.js";
import { Settings } from "./settings.js";
import { EDITING, Store } from "./store.js";
import { DatumsTab } from "./tabs/datums.js";
import { PartTab } from "./tabs/part.js";
import { PhotosTab } from "./tabs/photos.js";
import { RangeTab, declare } from "./tabs/range.js";
import { SymmetriesTab } from "./tabs/symmetries.js";
import { TextTab } from "./tabs/text.js";
import { TrialTab } from "./tabs/trial.js";
import { ICONS, ViewsTab, sign } from "./tabs/views.js";
import { Tabs } from "./tabs.js";
import { Tree } from "./tree.js";
import { Dots } from "./view/dots.js";
import { Marks } from "./view/marks.js";
import { Shell } from "./view/shell.js";
import { Stage } from "./view/stage.js";
import { Views, pictureOf, verdictOf, wordsOfView } from "./views.js";

history.replaceState(null, "", location.pathname); // the token stays out of bookmarks and shared links
for (const element of document.querySelectorAll("[data-icon]")) element.prepend(icon(element.dataset.icon));

const store = new Store(), stage = new Stage(find("canvas"));
find("no-webgl").hidden = Boolean(stage.renderer);
const marks = new Marks(stage, find("marks"));
const shell = new Shell(stage, find("handles"), { onDrag: (range) => tabs.of("Range").show(range), onDrop: (range) => declare(store, range) });
const dots = new Dots(stage, find("overlay"), { onHover: peek, onChoose: (index) => {
  if (tabs.current === "Views") tabs.of("Views").reveal(index);
} });
const picker = new Picker(store, stage, marks);
const tabs = new Tabs(find("tabs"), find("panels"), showTab);
new Tree(store);
new Settings(store);
tabs.add(PartTab, store);
tabs.add(DatumsTab, store);
tabs.add(RangeTab, store);
tabs.add(ViewsTab, store, (index) => dots.mark(index));
tabs.add(SymmetriesTab, store);
tabs.add(PhotosTab, store, () => {
  const before = shell.radius;
  showExtras();
  if (tabs.current === "Photos" && Math.abs(shell.radius - before) > 1) stage.reach(reach());
});
tabs.add(TrialTab, store);
tabs.add(TextTab, store);

/* --- the 3D view ---------------------------------------------------------------------------------------- */

let isIgnoredShown = false, loaded = "";

const indexOf = (name) => store.part.components.findIndex((one) => one.name === name);

function showComponents() {
  const solid = [], ghost = [];
  for (const { index, name, role } of store.part.components) {
    if (role === "ignore" || store.hidden.has(name)) ghost.push(index);
    else solid.push(index);
  }
  const open = new Set(isIgnoredShown ? [...solid, ...ghost] : solid);
  stage.isOpen = (index) => open.has(index);
  stage.show({ hexes: store.part.components.map((one) => one.color), solid: isIgnoredShown ? [...open] : solid, ghost: isIgnoredShown ? [] : ghost });
}

function showSelection() {
  stage.show({ selected: [...store.selection].map(indexOf).filter((index) => index >= 0) });
}

/** The coarse mesh comes first where the full one is large. */
async function loadMesh() {
  const { model_hash: hash, components, unit } = store.part, key = JSON.stringify([components.map((one) => [one.name, one.faces, one.size_mm]), unit]);
  if (key === loaded) return;
  loaded = key;
  find("loading").hidden = false;
  const isLarge = components.reduce((sum, one) => sum + one.faces, 0) > 150_000;
  stage.clearMesh("coarse");
  stage.clearMesh("full");
  for (const query of isLarge ? ["?coarse=1", ""] : [""]) {
    const buffer = await store.during("Loading the CAD", async () => (await ask(`/api/mesh${query}`)).arrayBuffer());
    if (!buffer) store.setReady();
    if (!buffer || loaded !== key) return;
    stage.setMesh(buffer);
    marks.show(store.part);
    find("loading").hidden = true;
    performance.mark(query ? "arview:coarse" : "arview:full", { detail: hash });
  }
  store.setReady();
}

function showTab(name, before) {
  const isOutside = (tab) => ["Range", "Views", "Photos"].includes(tab);
  showExtras();
  if (!store.part || (isOutside(name) === isOutside(before) && name !== "Photos" && before !== "Photos")) return;
  stage.reach(reach());
}

/** Radius, mm, of what the open tab shows. */
function reach() {
  return ["Range", "Views", "Photos"].includes(tabs.current) ? 1.1 * shell.radius : stage.radius;
}

/** What the open tab shows around the part. */
function showExtras() {
  const { part, views } = store, tab = tabs.current;
  if (!part) return;
  const isShell = ["Range", "Views", "Photos"].includes(tab), plan = tabs.of("Photos").plan;
  const planned = plan && { ...part.view_range, distance_mm: [plan.distance_mm, plan.distance_mm] };
  shell.show(isShell ? (tab === "Photos" && planned) || part.view_range : null, tab === "Range");
  const signs = { Views: () => (views?.views ?? []).map((view) => ({ direction: view.direction, sign: view.weak })),
    Range: () => (store.isAssessing ? [] : views?.views ?? []).map((view) => ({ direction: view.direction, sign: view.weak })),
    Photos: () => (plan?.photos ?? []).map((one) => ({ direction: one.direction, sign: "photo" })) };
  dots.show(signs[tab]?.() ?? [], isShell ? shell.radius : 1);
  const keys = { Views: ["fine", "plain", "alike"], Range: ["fine", "plain", "alike"], Photos: ["photo"] }[tab] ?? [];
  const words = { fine: "distinct view", plain: "plain view", alike: "confused view", photo: "photo" };
  find("legend").replaceChildren(...keys.map((key) => sign(key, words[key])));
  find("legend").hidden = !keys.length;
}

/** The picture of the view under the pointer. */
function peek(index, x, y) {
  const figure = find("peek"), isView = index !== null && ["Views", "Range"].includes(tabs.current) && store.views?.views[index];
  dots.mark(index);
  figure.hidden = index === null;
  if (index === null) return;
  figure.querySelector("img").hidden = !isView;
  if (isView) figure.querySelector("img").src = pictureOf(store.views, index);
  const photo = tabs.of("Photos").plan?.photos[index];
  figure.querySelector("figcaption").textContent = isView ? wordsOfView(isView) : photo ? `photo ${index + 1}: azimuth ${Math.round(photo.azimuth_deg)}°, elevation ${Math.round(photo.elevation_deg)}°` : "";
  const width = 230, left = x + width + 30 > stage.width ? x - width - 16 : x + 16;
  figure.style.transform = `translate(${Math.max(4, left)}px, ${Math.max(4, Math.min(y - 40, stage.height - 280))}px)`;
}

window.matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => stage.draw()); // the signs are drawn in its colours
stage.addEventListener("drawn", ({ detail }) => document.dispatchEvent(new CustomEvent("arview:drawn", { detail })));
stage.addEventListener("hover", ({ detail }) => {
  const name = detail.index === null ? null : store.part?.components[detail.index]?.name ?? null;
  store.hover(name);
  const tip = find("hover");
  tip.hidden = !name || !find("peek").hidden || !find("picked").hidden;
  tip.textContent = name ?? "";
  if (name) tip.style.transform = `translate(${detail.x + 14}px, ${detail.y - 26}px)`;
});
stage.addEventListener("click", ({ detail }) => {
  if (detail.isTaken) return;
  picker.close();
  find("hover").hidden = true;
  if (!detail.hit) {
    if (!stage.isComplete) store.tell("The full mesh is still being loaded; faces can be picked in a moment.");
    else store.select([]);
    return;
  }
  const { name } = store.part.components[detail.hit.component], { ctrlKey, metaKey } = detail.event;
  if (ctrlKey || metaKey) {
    const names = new Set(store.selection);
    if (!names.delete(name)) names.add(name);
    store.select(names);
    return;
  }
  store.select([name]);
  picker.open(detail);
});
find("directions").addEventListener("click", ({ target }) => {
  const look = target.closest("button")?.dataset.look;
  if (look === "solid") {
    isIgnoredShown = !isIgnoredShown;
    target.setAttribute("aria-pressed", String(isIgnoredShown));
    showComponents();
  } else if (look) stage.look(look, reach());
});

/* --- the bar ---------------------------------------------------------------------------------------------- */

function showBar() {
  const { part } = store;
  find("part-name").textContent = part.name;
  document.title = `${part.is_saved ? "" : "● "}${part.name} · arview studio`;
  find("unsaved").hidden = part.is_saved;
  find("undo").disabled = !part.can_undo;
  find("redo").disabled = !part.can_redo;
}

function showVerdict() {
  const { views, isAssessing } = store, chip = find("verdict");
  chip.hidden = false;
  const { kind, words } = isAssessing || !views ? { kind: "busy" } : verdictOf(views);
  chip.className = `chip ${kind}`;
  chip.replaceChildren(...(kind === "busy" ? ["Assessing the views …"] : [icon(ICONS[kind]), make("span", {}, `Views: ${words}`)]));
}

async function save() {
  if (await store.save()) toast(`Saved: ${store.part.path}`, "info");
}

let toastTimer = 0;

function toast(text, kind = "error") {
  const box = find("toast");
  box.hidden = false;
  box.className = kind;
  box.querySelector("span").textContent = text;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => { box.hidden = true; }, kind === "error" ? 12_000 : 5_000);
}

find("toast").querySelector("button").addEventListener("click", () => { find("toast").hidden = true; });
find("undo").addEventListener("click", () => store.undo());
find("redo").addEventListener("click", () => store.redo());
find("save").addEventListener("click", save);
find("verdict").addEventListener("click", () => tabs.open("Views"));
find("export").addEventListener("click", async ({ target }) => {
  const kind = target.closest("[data-kind]")?.dataset.kind;
  if (!kind) return;
  find("export").open = false;
  if (!store.part.is_saved && !(await store.save())) return;
  const answer = await store.during("Writing the file", () => post("/api/export", { kinds: [kind] }));
  if (answer) toast(`Written: ${answer.files.join(", ")}`, "info");
});
document.addEventListener("click", ({ target }) => {
  if (!target.closest("#export")) find("export").open = false;
});
window.addEventListener("beforeunload", (event) => {
  if (store.part && !store.part.is_saved && store.part.can_undo) event.preventDefault();
});
window.addEventListener("keydown", (event) => {
  const isTyping = event.target.closest?.("input:not([type=range]), textarea, select"), isCommand = event.ctrlKey || event.metaKey, key = event.key.toLowerCase();
  if (isCommand && key === "s") save();
  else if (isCommand && !isTyping && key === "z") event.shiftKey ? store.redo() : store.undo();
  else if (isCommand && !isTyping && key === "y") store.redo();
  else if (event.key === "Escape") picker.close();
  else if (key === "f" && !isTyping && !isCommand) stage.look("fit", reach());
  else if (key === "/" && !isTyping) find("search").focus();
  else return;
  event.preventDefault();
});

/* --- listening -------------------------------------------------------------------------------------------- */

store.on("trouble", (text) => toast(text));
store.on("busy", (labels) => {
  find("busy").textContent = labels.length ? `${labels.at(-1)} …` : "";
  document.body.classList.toggle("is-busy", labels.length > 0);
  document.body.classList.toggle("is-editing", labels.includes(EDITING));
});
store.on("part", () => {
  const { part } = store;
  stage.frame(part.center_mm, 0.5 * part.diameter_mm, part.up);
  for (const name of [...store.selection]) if (indexOf(name) < 0) store.selection.delete(name);
  showBar();
  showComponents();
  const before = shell.radius;
  showExtras();
  if (["Range", "Views"].includes(tabs.current) && Math.abs(shell.radius / before - 1) > 0.1) stage.reach(reach());
  marks.show(part);
  loadMesh();
});
store.on("selection", showSelection);
store.on("visibility", showComponents);
store.on("hover", () => stage.show({ hovered: store.hovered === null ? null : indexOf(store.hovered) }));
store.on("views", () => {
  showVerdict();
  showExtras();
});
new Views(store);

store.load().then(() => tabs.open("Part")).catch((error) => {
  find("loading").replaceChildren(make("b", {}, error.message));
});
