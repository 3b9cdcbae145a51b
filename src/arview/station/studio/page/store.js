// What the page knows: the part, the selection, what is hovered. Views listen to it.

import { get, post } from "./api.js";

export const EDITING = "Checking the part";

/** Events: "part" (edited), "selection", "hover", "visibility", "trouble" (detail: text), "busy" (detail: labels). */
export class Store extends EventTarget {
  part = null;
  selection = new Set();
  /** Path of the assembly that was selected as a whole, or null. */
  assembly = null;
  hovered = null;
  hidden = new Set();
  /** Kept once the CAD is drawn: what takes long waits for it. */
  ready = new Promise((done) => { this.setReady = done; });
  #queue = Promise.resolve();
  #busy = new Map();
  #nextJob = 0;

  on(types, listener) {
    for (const type of types.split(" ")) this.addEventListener(type, (event) => listener(event.detail));
  }

  emit(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  async load() {
    this.#take(await get("/api/part"));
  }

  /** Carry out an edit; false when it was refused, with the reason shown. */
  edit(change) {
    return this.#changed("/api/edit", change);
  }

  undo() {
    return this.part.can_undo ? this.#changed("/api/undo") : Promise.resolve(false);
  }

  redo() {
    return this.part.can_redo ? this.#changed("/api/redo") : Promise.resolve(false);
  }

  save() {
    return this.#changed("/api/save");
  }

  /** Select components by name. */
  select(names, assembly = null) {
    this.selection = new Set(names);
    this.assembly = assembly;
    this.emit("selection");
  }

  hover(name) {
    if (name === this.hovered) return;
    this.hovered = name;
    this.emit("hover");
  }

  /** Hide or show components in the 3D view; the part file is not touched. */
  setHidden(names, isHidden) {
    for (const name of names) isHidden ? this.hidden.add(name) : this.hidden.delete(name);
    this.emit("visibility");
  }

  component(name) {
    return this.part.components.find((one) => one.name === name);
  }

  /** Run a job; while it lasts its label is shown. Failures are shown, and give null. */
  async during(label, job) {
    const id = this.#nextJob++;
    this.#busy.set(id, label);
    this.emit("busy", [...this.#busy.values()]);
    try {
      return await job();
    } catch (error) {
      this.tell(error);
      return null;
    } finally {
      this.#busy.delete(id);
      this.emit("busy", [...this.#busy.values()]);
    }
  }

  tell(error) {
    this.emit("trouble", error instanceof Error ? error.message : error);
  }

  /** Edits go one after the other. */
  #changed(path, json = {}) {
    const step = this.#queue.then(() => this.during(EDITING, () => post(path, json)));
    this.#queue = step;
    return step.then((part) => {
      if (part) this.#take(part);
      else this.emit("part"); // controls go back to what holds
      return Boolean(part);
    });
  }

  #take(part) {
    this.part = part;
    this.emit("part");
  }
}
