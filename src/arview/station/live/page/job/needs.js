// What the photos still lack of each component, drawn on the component in the picture.

import { make } from "../icons.js";
import { t } from "../texts/texts.js";

const APART_PX = 22; // signs nearer to each other than that are drawn once: the one that lacks most

export class Needs {
  #signs = new Map(); // by the index of the component
  #components = [];
  #needs = [];

  /** @param layer element over the picture. @param toScreen (part, point in the model) → [x, y] CSS px, or null. */
  constructor(layer, toScreen) {
    Object.assign(this, { layer, toScreen });
  }

  /** Set the components of the part with this number. */
  setComponents(components, part) {
    this.#components = components;
    this.part = part;
    this.clear();
  }

  /** Set what is lacking: `components` of the advice. */
  set(needs) {
    this.#needs = needs;
    for (const { index, photos, is_enough: isEnough, text } of needs) {
      const sign = this.#signs.get(index) ?? this.#add(index);
      sign.className = `need ${isEnough ? "enough" : photos ? "some" : "none"}`;
      const words = String(photos);
      if (sign.firstChild.textContent !== words) sign.firstChild.textContent = words;
      sign.title = text || t("job.need", { name: this.#components[index]?.name ?? "", photos });
    }
  }

  /** Put the signs where the components are in the picture now. */
  place(isTracked) {
    const taken = [];
    const order = [...this.#needs].sort((a, b) => a.is_enough - b.is_enough || a.photos - b.photos);
    for (const { index } of order) {
      const sign = this.#signs.get(index), component = this.#components[index];
      const at = isTracked && component ? this.toScreen(this.part, component.anchor_in_model) : null;
      const isFree = at && taken.every((other) => Math.hypot(other[0] - at[0], other[1] - at[1]) > APART_PX);
      sign.hidden = !isFree;
      if (!isFree) continue;
      taken.push(at);
      sign.style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px)`;
    }
  }

  clear() {
    for (const sign of this.#signs.values()) sign.remove();
    this.#signs.clear();
    this.#needs = [];
  }

  #add(index) {
    const sign = make("span", "need", [make("b", "", [""])]);
    this.#signs.set(index, sign);
    this.layer.append(sign);
    return sign;
  }
}
