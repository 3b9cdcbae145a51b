// Tab "Photos": where to stand, what each component is seen from, and the U to be expected against its tolerance.

import { get } from "../api.js";
import { delayed, icon, make } from "../dom.js";

export class PhotosTab {
  title = "Photos";

  /** onPlan(photos or null) tells of the places to be drawn. */
  constructor(store, panel, onPlan) {
    Object.assign(this, { store, onPlan, count: 24 });
    this.output = make("output", {}, "24");
    this.slider = make("input", { type: "range", min: "4", max: "96", step: "1", "aria-label": "Number of photos", oninput: () => {
      this.output.textContent = this.slider.value;
      this.refresh();
    } });
    this.slider.value = "24";
    this.facts = make("p", { class: "facts" });
    this.rows = make("tbody");
    const head = ["component", "photos", "spread", "expected U", "tolerance"].map((text) => make("th", { scope: "col" }, text));
    panel.append(make("label", { class: "field slider" }, make("span", {}, "Photos"), this.slider, this.output), this.facts,
      make("div", { class: "table" }, make("table", {}, make("thead", {}, make("tr", {}, head)), this.rows)));
    this.refresh = delayed(() => this.#plan(), 350);
    store.on("part", () => {
      this.plan = null;
      if (this.isOpen) this.refresh();
    });
    store.on("selection hover", () => this.#mark());
  }

  open() {
    if (!this.plan) this.refresh();
  }

  async #plan() {
    const count = Number(this.slider.value);
    const plan = await this.store.during("Planning photos", () => get(`/api/photos?count=${count}`));
    if (!plan || count !== Number(this.slider.value)) return;
    this.plan = plan;
    const rings = [...new Set(plan.photos.map((one) => Math.round(one.elevation_deg)))].sort((a, b) => a - b);
    this.facts.textContent = `Stand ${Math.round(plan.distance_mm)} mm from the middle of the part, evenly round it, alternately ${rings.map((one) => `${one}°`).join(" and ")} above it.`;
    this.rows.replaceChildren(...plan.components.map((row) => this.#row(row, count)));
    this.onPlan(plan);
    this.#mark();
  }

  #row(row, count) {
    const component = this.store.component(row.name), tolerance = component?.role === "inspect" ? component.position_tolerance_mm : null;
    const u = row.expected_U_mm, isWide = tolerance !== null && (u === null || u > tolerance / 4);
    const verdict = tolerance === null ? null : icon(isWide ? "warning" : "pass");
    const element = make("tr", {
      class: isWide ? "is-wide" : "", title: row.remark || (isWide ? "U is more than a quarter of the tolerance" : ""), "data-name": row.name,
      onpointerenter: () => this.store.hover(row.name), onpointerleave: () => this.store.hover(null), onclick: () => this.store.select([row.name]),
    }, make("th", { scope: "row" }, row.name), make("td", {}, `${row.photos.length}/${count}`), make("td", {}, `${Math.round(row.spread_deg)}°`),
    make("td", {}, u === null ? "–" : `${u.toFixed(3)} mm`), make("td", {}, verdict, tolerance === null ? "–" : `±${tolerance} mm`));
    return row.remark ? (element.firstChild.append(make("small", {}, row.remark)), element) : element;
  }

  /** Mark the row of what is hovered or selected. */
  #mark() {
    for (const row of this.rows.children) row.classList.toggle("is-hovered", row.dataset.name === this.store.hovered || this.store.selection.has(row.dataset.name));
  }
}
