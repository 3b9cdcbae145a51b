// Tab "Part": name, serial number, up axis, unit; what `arview check` says.

import { get } from "../api.js";
import { delayed, field, icon, make } from "../dom.js";

const UPS = ["x", "y", "z", "-x", "-y", "-z"], UNITS = ["mm", "cm", "m", "inch"];
const SIGNS = { error: "fail", warning: "warning", note: "note" };

export class PartTab {
  title = "Part";

  constructor(store, panel) {
    this.store = store;
    this.fields = make("div", { class: "fields" });
    this.findings = make("ul", { class: "findings", "aria-label": "Findings" });
    panel.append(this.fields, make("h3", {}, "Findings"), this.findings);
    this.refresh = delayed(() => this.#check(), 300);
    store.on("part", () => this.#show());
  }

  open() {
    this.refresh();
  }

  #show() {
    const { part } = this.store, size = part.components.length;
    const text = (key, value) => {
      const input = make("input", { "data-key": key, spellcheck: false, autocomplete: "off", onchange: () => this.#set(key, input.value.trim() || null) });
      input.value = value ?? "";
      return input;
    };
    const choice = (key, value, values, none) => {
      const select = make("select", { "data-key": key, onchange: () => this.#set(key, select.value || null) },
        none ? make("option", { value: "" }, none) : null, values.map((one) => make("option", { value: one }, one)));
      select.value = value ?? "";
      return select;
    };
    this.fields.replaceChildren(
      field("Name", text("name", part.name)), field("Serial number", text("serial", part.serial)),
      field("Up axis", choice("up", part.up, UPS)), field("Unit", choice("unit", part.unit, UNITS, "as the CAD says")),
      make("p", { class: "facts" }, `${part.cad} · ${size} component${size === 1 ? "" : "s"} · diameter ${part.diameter_mm.toFixed(1)} mm`),
      make("p", { class: "facts" }, part.path),
    );
    if (this.isOpen) this.refresh();
  }

  #set(key, value) {
    this.store.edit({ kind: "part", key, value });
  }

  async #check() {
    await this.store.ready;
    const { revision } = this.store.part;
    if (this.revision === revision) return;
    this.revision = revision;
    const answer = await this.store.during("Checking", () => get("/api/findings"));
    if (!answer || this.store.part.revision !== revision) return;
    const rows = answer.findings.map(({ severity, text }) => make("li", { class: severity }, icon(SIGNS[severity] ?? "note"), make("span", {}, make("b", {}, severity), ` ${text}`)));
    this.findings.replaceChildren(...(rows.length ? rows : [make("li", { class: "pass" }, icon("pass"), make("span", {}, "Nothing to remark."))]));
  }
}
