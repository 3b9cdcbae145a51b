// Verdicts as signs with words: never a colour alone.

import { icon, make } from "../icons.js";
import { t } from "../texts/texts.js";

export const ORDER = ["fail", "undecided", "not_measured", "measured", "pass"];

/** Icon and class of a verdict; of a job without one, of its stage. */
export function verdictSign(verdict, stage = "") {
  const kind = ORDER.includes(verdict) ? verdict : stage === "failed" ? "error" : "busy";
  return make("span", `sign ${ORDER.includes(verdict) ? verdict : "none"}`, [icon(kind)]);
}

/** The word of a verdict. */
export const verdictWord = (verdict) => t(`job.verdict.${ORDER.includes(verdict) ? verdict : "none"}`);

/** Number of components by verdict, the most severe first: [[verdict, count], …]. */
export const counts = (components) => ORDER.flatMap((verdict) => {
  const count = components.filter((one) => one.verdict === verdict).length;
  return count ? [[verdict, count]] : [];
});

/** Components, the most severe first. */
export const bySeverity = (components) => [...components].sort((a, b) => ORDER.indexOf(a.verdict) - ORDER.indexOf(b.verdict) ||
  (b.distance_mm ?? 0) - (a.distance_mm ?? 0) || a.name.localeCompare(b.name, undefined, { numeric: true }));
