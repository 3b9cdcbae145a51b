// How far a measurement is, and how long it will take: by earlier ones of the part, else by the steps that are done.

import { t } from "../texts/texts.js";

/** Share of the whole time that each step takes, as on the samples; in their order. */
const STEPS = [
  ["photos", 0.02], ["features", 0.2], ["matching", 0.13], ["placing", 0.09], ["matching again", 0.06], ["adjusting", 0.15],
  ["finding the part", 0.02], ["reading photos", 0.03], ["fitting the CAD", 0.1], ["components", 0.15], ["datums", 0.02], ["uncertainty", 0.03],
];
const MIN_SHARE = 0.1, MIN_S = 10; // before, nothing is foretold from the steps

/** Share of the measurement that is done, 0 to 1; null where the step is unknown. */
export function shareDone({ step, done, total }) {
  const index = STEPS.findIndex(([name]) => name === step);
  if (index < 0) return null;
  const before = STEPS.slice(0, index).reduce((sum, [, share]) => sum + share, 0);
  return before + STEPS[index][1] * (total ? Math.min(1, done / total) : 0);
}

/** How long the measurement of a job will still take, s; null where that cannot be told. */
export function secondsLeft({ state, measuring_s: s, expected_s: expected }) {
  if (s === null || s === undefined) return null;
  const share = shareDone(state), bySteps = share >= MIN_SHARE && s > MIN_S ? (s * (1 - share)) / share : null;
  return expected > s ? expected - s : bySteps;
}

/** The time left in words. */
export function leftText(job) {
  const left = secondsLeft(job);
  if (left === null) return t("job.left_unknown");
  return left < 60 ? t("job.left_soon") : t("job.left", { minutes: Math.ceil(left / 60) });
}
