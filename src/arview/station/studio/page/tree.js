// The assembly tree: search, selection of several, keyboard. Rows are light, and drawn by the browser only when in sight.

import { find, icon, make } from "./dom.js";

const ROLE_SIGNS = { base: "base", inspect: "", ignore: "ignored" };

/** A node of the tree: {name, path, children, component} with the component's description at leaves. */
function treeOf(components) {
  const root = { name: "", path: [], children: new Map(), component: null };
  for (const component of components) {
    let node = root;
    component.path.forEach((name, depth) => {
      const isLeaf = depth === component.path.length - 1, key = isLeaf ? `\0${component.name}` : name;
      if (!node.children.has(key)) {
        const path = component.path.slice(0, depth + 1);
        node.children.set(key, { name: isLeaf ? component.name : name, path, children: new Map(), component: isLeaf ? component : null });
      }
      node = node.children.get(key);
    });
  }
  return root;
}

const leavesOf = (node) => node.component ? [node.component.name] : [...node.children.values()].flatMap(leavesOf);

export class Tree {
  #rows = []; // {element, node, names, depth} in the order of the tree
  #rowOf = new Map(); // of components, by name
  #closed = new Set();
  #last = null;
  #key = "";

  constructor(store) {
    this.store = store;
    this.element = find("tree");
    this.search = find("search");
    this.search.addEventListener("input", () => this.#build());
    this.element.addEventListener("click", (event) => this.#click(event));
    this.element.addEventListener("keydown", (event) => this.#press(event));
    this.element.addEventListener("pointerover", (event) => store.hover(this.#of(event)?.node.component?.name ?? null));
    this.element.addEventListener("pointerleave", () => store.hover(null));
    store.on("part", () => this.#update());
    store.on("selection", () => this.#mark(true));
    store.on("visibility", () => this.#describe());
    store.on("hover", () => this.#hover());
  }

  #update() {
    const key = JSON.stringify(this.store.part.components.map((one) => one.path));
    if (key !== this.#key) {
      this.#key = key;
      this.#build();
    } else this.#describe();
  }

  #build() {
    const wanted = this.search.value.trim().toLowerCase(), found = this.store.part.components.filter((one) => one.path.join("/").toLowerCase().includes(wanted) || one.name.toLowerCase().includes(wanted));
    this.#rows = [];
    this.#rowOf = new Map();
    const add = (node, depth) => {
      const row = this.#row(node, depth, Boolean(wanted));
      this.#rows.push(row);
      if (node.component) this.#rowOf.set(node.component.name, row);
      if (wanted || !this.#closed.has(node.path.join("/"))) for (const child of node.children.values()) add(child, depth + 1);
    };
    for (const child of treeOf(found).children.values()) add(child, 0);
    this.element.replaceChildren(...this.#rows.map((row) => row.element));
    find("count").textContent = wanted ? `${found.length} of ${this.store.part.components.length}` : `${found.length}`;
    this.#describe();
    this.#mark(false);
  }

  #row(node, depth, isSearch) {
    const names = leavesOf(node), isOpen = isSearch || !this.#closed.has(node.path.join("/"));
    const element = make("div", { class: node.component ? "row leaf" : "row branch", role: "treeitem", "aria-level": String(depth + 1) });
    element.style.paddingLeft = `${6 + 14 * depth}px`;
    if (!node.component) element.setAttribute("aria-expanded", String(isOpen));
    element.append(
      make("span", { class: "twist" }, node.component ? make("i", { class: "swatch" }) : icon("open")),
      make("span", { class: "name" }, node.name),
      make("span", { class: "more" }, node.component ? "" : `${names.length}`),
      make("button", { class: "eye", type: "button", tabindex: "-1", "aria-label": `Hide or show ${node.name}`, title: "Hide or show in the view" }, icon("eye")),
    );
    return { element, node, names, depth };
  }

  /** Bring colours, roles and tolerances of the rows up to date. */
  #describe() {
    const components = new Map(this.store.part.components.map((one) => [one.name, one]));
    for (const { element, node, names } of this.#rows) {
      const isHidden = names.every((name) => this.store.hidden.has(name));
      element.classList.toggle("is-hidden", isHidden);
      if (!node.component) continue;
      const one = node.component = components.get(node.component.name) ?? node.component;
      element.classList.toggle("is-ignored", one.role === "ignore");
      element.classList.toggle("is-base", one.role === "base");
      element.querySelector(".swatch").style.background = one.color;
      const tolerances = [one.position_tolerance_mm && `±${one.position_tolerance_mm}`, one.angle_tolerance_deg && `±${one.angle_tolerance_deg}°`];
      element.querySelector(".more").textContent = one.role === "inspect" ? tolerances.filter(Boolean).join(" ") : ROLE_SIGNS[one.role];
    }
  }

  #mark(isScrolled) {
    let first = null;
    for (const row of this.#rows) {
      const { node, element, names } = row, { selection, assembly } = this.store;
      const isChosen = node.component ? selection.has(node.component.name) : assembly === node.path.join("/") || (names.length > 0 && names.every((name) => selection.has(name)));
      element.setAttribute("aria-selected", String(isChosen));
      if (isChosen && node.component) first ??= element;
    }
    if (isScrolled && first && !this.element.contains(document.activeElement)) first.scrollIntoView({ block: "nearest" });
  }

  #hover() {
    this.hoveredRow?.classList.remove("is-hovered");
    this.hoveredRow = this.#rowOf.get(this.store.hovered)?.element;
    this.hoveredRow?.classList.add("is-hovered");
  }

  #of(event) {
    const element = event.target.closest?.(".row");
    return element ? this.#rows.find((row) => row.element === element) : null;
  }

  #click(event) {
    const row = this.#of(event);
    if (!row) return;
    if (event.target.closest(".eye")) {
      this.store.setHidden(row.names, !row.names.every((name) => this.store.hidden.has(name)));
    } else if (!row.node.component && event.target.closest(".twist")) this.#toggle(row);
    else this.#choose(row, event);
  }

  #toggle(row) {
    const path = row.node.path.join("/");
    if (!this.#closed.delete(path)) this.#closed.add(path);
    this.#build();
    this.#focus(this.#rows.find((one) => one.node.path.join("/") === path && !one.node.component));
  }

  #choose(row, { shiftKey, ctrlKey, metaKey }) {
    if (shiftKey && this.#last) {
      const ends = [this.#indexOf(this.#last), this.#indexOf(row)].sort((a, b) => a - b);
      this.store.select(this.#rows.slice(ends[0], ends[1] + 1).filter((one) => one.node.component).flatMap((one) => one.names));
    } else if (ctrlKey || metaKey) {
      const chosen = new Set(this.store.selection), isOff = row.names.every((name) => chosen.has(name));
      for (const name of row.names) isOff ? chosen.delete(name) : chosen.add(name);
      this.store.select(chosen);
    } else this.store.select(row.names, row.node.component || this.search.value.trim() ? null : row.node.path.join("/"));
    if (!shiftKey) this.#last = row;
    this.#focus(row);
  }

  #indexOf(row) {
    return this.#rows.findIndex((one) => one.node.path.join("/") === row.node.path.join("/") && one.node.component?.name === row.node.component?.name);
  }

  #focus(row) {
    this.current?.classList.remove("is-current");
    this.current = row?.element;
    this.current?.classList.add("is-current");
    if (this.current) {
      this.current.id ||= `row-${Math.random().toString(36).slice(2)}`;
      this.element.setAttribute("aria-activedescendant", this.current.id);
    }
  }

  #press(event) {
    const at = this.#rows.findIndex((row) => row.element === this.current), row = this.#rows[at];
    const go = (index) => {
      const next = this.#rows[Math.max(0, Math.min(this.#rows.length - 1, index))];
      if (!next) return;
      this.#choose(next, event);
      next.element.scrollIntoView({ block: "nearest" });
    };
    const isOpen = row?.element.getAttribute("aria-expanded") === "true";
    if (event.key === "ArrowDown") go(at + 1);
    else if (event.key === "ArrowUp") go(at - 1);
    else if (event.key === "Home") go(0);
    else if (event.key === "End") go(this.#rows.length - 1);
    else if (event.key === "ArrowRight" && row && !row.node.component && !isOpen) this.#toggle(row);
    else if (event.key === "ArrowLeft" && row && !row.node.component && isOpen) this.#toggle(row);
    else if (event.key === "a" && (event.ctrlKey || event.metaKey)) this.store.select(this.#rows.flatMap((one) => one.node.component ? one.names : []));
    else if (event.key === " " && row) this.store.setHidden(row.names, !row.names.every((name) => this.store.hidden.has(name)));
    else return;
    event.preventDefault();
  }
}
