// The buttons for zoom over the picture.

import { icon } from "../icons.js";
import { t } from "../texts/texts.js";

export class ZoomControls {
  #shown = "";

  /** @param box element with the buttons #zoom-in, #zoom-out and #zoom-fit. */
  constructor(box, stage) {
    Object.assign(this, { box, stage });
    [this.fit, this.out, this.in] = ["fit", "out", "in"].map((name) => box.querySelector(`#zoom-${name}`));
    this.in.addEventListener("click", () => this.step(1));
    this.out.addEventListener("click", () => this.step(-1));
    this.fit.addEventListener("click", () => this.reset());
  }

  step(direction) {
    this.stage.viewport.step(direction);
    this.stage.moved();
  }

  /** The whole picture, or the parts where that is more. */
  reset() {
    this.stage.viewport.reset();
    this.stage.moved();
  }

  /** Show what the buttons do now. */
  show() {
    const { viewport } = this.stage, isWhole = viewport.zoom < 1.01;
    const willFollow = isWhole && viewport.isManual && viewport.canFollow && this.stage.isFollowing;
    const key = `${isWhole}${willFollow}${viewport.zoom.toFixed(1)}`;
    if (key === this.#shown) return;
    this.#shown = key;
    const word = t(willFollow ? "view.zoom_auto" : "view.zoom_fit");
    this.fit.hidden = isWhole && !willFollow;
    this.fit.setAttribute("aria-label", word);
    this.fit.title = word;
    this.fit.querySelector(".sign").replaceChildren(icon(willFollow ? "follow" : "fit"));
    this.out.setAttribute("aria-disabled", String(isWhole));
    this.box.setAttribute("aria-label", t("view.zoom_state", { zoom: viewport.zoom.toFixed(1) }));
  }
}
