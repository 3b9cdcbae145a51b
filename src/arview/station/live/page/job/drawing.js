// The drawing of a rework: the picture of the station, and what it shows in the words of the page.

import { make } from "../icons.js";
import { decimal, t, translated } from "../texts/texts.js";
import { fileOf } from "./api.js";

const LENGTH = /^[\d.]+ ?(mm|°)$/; // texts that are numbers, not names

export class Drawing {
  constructor(job, name) {
    this.picture = make("img", "job-drawing", [], { alt: t("job.drawing", { name }) });
    this.about = make("figcaption", "job-about");
    this.element = make("figure", "job-figure", [this.picture, this.about]);
    this.element.hidden = true;
    this.#load(`${fileOf(job, `rework/${name}.svg`)}?screen=1`);
  }

  async #load(address) {
    const answer = await fetch(address, { credentials: "same-origin" }).catch(() => null); // a station that measures takes its time
    if (!answer?.ok) return; // without a drawing the steps say all
    const drawn = new DOMParser().parseFromString(await answer.text(), "image/svg+xml"), about = drawn.querySelector("metadata")?.textContent;
    for (const one of drawn.querySelectorAll("text")) if (LENGTH.test(one.textContent)) one.textContent = decimal(one.textContent);
    this.picture.src = URL.createObjectURL(new Blob([new XMLSerializer().serializeToString(drawn)], { type: "image/svg+xml" }));
    this.picture.addEventListener("load", () => URL.revokeObjectURL(this.picture.src), { once: true });
    this.about.replaceChildren(...(about ? this.#words(translated(JSON.parse(about))) : []));
    this.element.hidden = false;
  }

  /** What is drawn: the plan with its view, the magnification, and the lines. */
  #words({ text, magnification, u, tolerance, place }) {
    const row = (kind, words) => make("span", "", [make("i", `line ${kind}`), words]);
    return [
      make("span", "first-up", [text]), ...(magnification ? [make("span", "", [t("job.magnified", { times: String(magnification) })])] : []),
      row("design", t("job.line_design")), ...(place ? [row("measured", t("job.line_measured", { point: place }))] : []),
      ...(u ? [row("u", t("job.line_u", { u }))] : []), ...(tolerance ? [row("zone", t("job.line_zone", { tolerance }))] : []),
    ];
  }
}
