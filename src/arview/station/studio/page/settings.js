// Role, colour and tolerances of the selected components.

import { field, find, make, numberInput, shown } from "./dom.js";

const ROLES = [["inspect", "inspected"], ["base", "base"], ["ignore", "ignored"]];

/** The value that all share, or undefined. */
const shared = (rows, key) => rows.every((row) => row[key] === rows[0][key]) ? rows[0][key] : undefined;

export class Settings {
  constructor(store) {
    this.store = store;
    this.form = find("settings");
    this.form.addEventListener("submit", (event) => event.preventDefault());
    store.on("part selection", () => this.#show());
  }

  #show() {
    const rows = this.store.part.components.filter((one) => this.store.selection.has(one.name));
    if (!rows.length) {
      this.form.replaceChildren(make("p", { class: "hint" }, "Select components here or in the view to set their role and tolerances. Ctrl and Shift select several."));
      return;
    }
    const { assembly } = this.store, title = assembly ? `${assembly.split("/").at(-1)}/*` : rows.length === 1 ? rows[0].name : `${rows.length} components`;
    const size = rows.length === 1 ? rows[0].size_mm.map((one) => shown(one, 1)).join(" × ") + " mm" : assembly ? `${rows.length} components` : "";
    this.form.replaceChildren(
      make("h2", {}, title, make("small", {}, size)),
      field("Role", this.#roles(shared(rows, "role"))),
      field("Colour", this.#color(shared(rows, "color"))),
      field("Position ± mm", this.#number("position_tolerance_mm", shared(rows, "position_tolerance_mm"), rows)),
      field("Angle ± °", this.#number("angle_tolerance_deg", shared(rows, "angle_tolerance_deg"), rows)),
    );
  }

  #roles(role) {
    const select = make("select", { "data-key": "role", title: "The base carries the others and is not judged; what is ignored is not in the picture", onchange: () => this.#set("role", select.value) },
      role === undefined ? make("option", { value: "" }, "(several)") : null,
      ROLES.map(([value, text]) => make("option", { value }, text)));
    select.value = role ?? "";
    return select;
  }

  #color(color) {
    const input = make("input", { type: "color", "data-key": "color", onchange: () => this.#set("color", input.value) });
    input.value = color ?? "#888888";
    return input;
  }

  #number(key, value, rows) {
    const isMixed = value === undefined && rows.length > 1;
    return numberInput({ value, min: "0", "data-key": key, placeholder: isMixed ? "(several)" : "none", onValue: (number) => this.#set(key, number) });
  }

  /** Set a key for the selection; a whole assembly gets one table with a pattern. */
  async #set(key, value) {
    const { store } = this, names = [...store.selection];
    if (store.assembly && !/[[\]?*]/.test(store.assembly)) {
      const isDone = await store.edit({ kind: "component", names: [`${store.assembly}/*`], key, value });
      // A component's own table outweighs the pattern.
      const others = names.filter((name) => store.component(name)[key] !== value);
      if (isDone && others.length) await store.edit({ kind: "component", names: others, key, value });
    } else await store.edit({ kind: "component", names, key, value });
  }
}
